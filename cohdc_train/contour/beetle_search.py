"""Beetle antennae search over the vertices of an outline (paper 2.1.3, equation 2)."""

from collections.abc import Iterable

import numpy as np

from cohdc_train.contour.beetle_parameters import BeetleSearch
from cohdc_train.contour.polygon_iou import IoUEvaluator
from cohdc_train.contour.polygons import Polygon, count_vertices
from cohdc_train.contour.vertex_swarm import VertexSwarm
from cohdc_train.types import IntArray

_MAX_VERTICES = 2000  # after bisection; an outline of more is not searched
_DROP_ONE_OF = 8  # vertices, at first
_TRY_ONE_OF = 10  # vertices, before the search ends


def search_vertices(
    finer: list[Polygon], iou_floor: float, evaluator: IoUEvaluator, search: BeetleSearch
) -> list[Polygon]:
    """Drop vertices and move the others while the floor of the IoU is kept.

    Of an outline with many vertices several are dropped together, until that fails. When no vertex
    can be dropped, all move for a higher IoU. Then there is another round, which ends the search
    when it drops nothing.

    Args:
        finer: polygons that keep the floor.
        iou_floor: smallest IoU, 0..1.
        evaluator: compares polygons with the outline.
        search: parameters.

    Returns:
        The last polygons that keep the floor and do not cross themselves.
    """
    if count_vertices(finer) > _MAX_VERTICES:
        return finer
    rng = np.random.default_rng(search.seed)
    swarm, moved = VertexSwarm(finer, evaluator, search.pairs), False

    def without_one_of(choices: Iterable[tuple[IntArray, int]]) -> "VertexSwarm | None":
        for dropped, added in choices:
            fewer = swarm.without(dropped, added)
            if fewer.move_until_valid(iou_floor, search, rng) and evaluator.is_valid(
                fewer.polygons()
            ):
                return fewer
        return None

    while (count := swarm.count // _DROP_ONE_OF) > 1 and (
        fewer := without_one_of(swarm.joint_removals(count))
    ):
        swarm = fewer
    while True:
        tries = 1 if moved else max(search.tries, swarm.count // _TRY_ONE_OF)
        if fewer := without_one_of(swarm.cheapest_removals(tries)):
            swarm, moved = fewer, False
            continue
        better = swarm if moved else swarm.moved(search, rng)
        if moved or better.iou() < swarm.iou() or not evaluator.is_valid(better.polygons()):
            return swarm.polygons()
        swarm, moved = better, True
