"""Reduce outlines to few vertices: Douglas-Peucker, Visvalingam, and BAS-DP (paper 2.1.3)."""

from collections.abc import Callable, Sequence
from heapq import heapify, heappop, heappush
from math import exp, hypot
from typing import Literal, get_args

import cv2
import numpy as np

from cohdc_train.contour.beetle_parameters import BeetleSearch
from cohdc_train.contour.beetle_search import search_vertices
from cohdc_train.contour.polygon_iou import IoUEvaluator
from cohdc_train.contour.polygons import Polygon, count_vertices
from cohdc_train.contour.tolerance_search import ToleranceBracket
from cohdc_train.types import FloatArray

ContourMethod = Literal["bisection", "bas_dp", "dp", "visvalingam"]
METHODS: tuple[ContourMethod, ...] = get_args(ContourMethod)
Reduction = Callable[[FloatArray, float], FloatArray]

_MAX_EVALUATIONS = 9  # of tolerances; three or four are usual
_FINEST, _COARSEST = 0.25, 0.1  # tolerances: px, and share of the diagonal
_FINER = 0.9
_LOST = 0.175  # area lost per px of tolerance and px of outline, roughly


def simplify(
    polygons: Sequence[Polygon],
    iou_floor: float = 0.95,
    method: ContourMethod = "bisection",
    epsilon: float = 2.0,
    search: BeetleSearch | None = None,
) -> list[Polygon]:
    """Return outlines of fewer vertices.

    `bisection` looks for the largest Douglas-Peucker tolerance that keeps the floor, for real time.
    `visvalingam` does so with Visvalingam and Whyatt's triangles. `bas_dp` continues from
    bisection: it drops vertices and moves the rest by beetle antennae search (the paper's equation
    2), and keeps the finer polygon when the floor cannot be reached. `dp` is plain Douglas-Peucker
    with a fixed tolerance, without a floor.

    Except for `dp`, rings of a result do not cross themselves or each other; where a coarser one
    would, the finer one stays. Small parts and holes vanish where the floor allows it.

    Args:
        polygons: as `trace` gives them.
        iou_floor: smallest IoU, 0..1, of the result with the polygons given, both filled at pixel
            centers; not for `dp`.
        method: one of METHODS.
        epsilon: the tolerance of `dp`, px.
        search: parameters of `bas_dp`.

    Raises:
        ValueError: there is no such method.
    """
    if method not in METHODS:
        raise ValueError(f"contour method {method!r}; there are {', '.join(METHODS)}")
    if not polygons:
        return []
    if method == "dp":
        return _reduce_rings(polygons, _douglas_peucker, epsilon)
    evaluator = IoUEvaluator(polygons)
    finer = _bisect(
        polygons,
        iou_floor,
        evaluator,
        _visvalingam if method == "visvalingam" else _douglas_peucker,
    )
    if method != "bas_dp":
        return finer
    return search_vertices(finer, iou_floor, evaluator, search or BeetleSearch())


def _bisect(
    polygons: Sequence[Polygon], iou_floor: float, evaluator: IoUEvaluator, reduce: Reduction
) -> list[Polygon]:
    """Return the result with the fewest vertices among tolerances that keep the floor.

    It is the outline itself if none does.
    """
    length = sum(
        cv2.arcLength(ring.astype(np.float32), True)
        for polygon in polygons
        for ring in polygon.rings
    )
    coarsest = max(_COARSEST * hypot(*(evaluator.high - evaluator.low)), 2 * _FINEST)
    bracket = ToleranceBracket.of(_FINEST, coarsest, 1 - iou_floor, _LOST * length / evaluator.area)
    kept: list[list[Polygon]] = []
    for _ in range(_MAX_EVALUATIONS):
        coarser = _reduce_rings(polygons, reduce, exp(bracket.at))
        iou = evaluator.iou(coarser)
        if iou >= iou_floor:
            kept.append(coarser)
        if not bracket.add(1 - iou, count_vertices(coarser), iou >= iou_floor):
            break
    # The IoU does not fall evenly, so that a later one may have more vertices.
    for coarser in sorted(kept, key=count_vertices):
        if evaluator.is_valid(coarser):
            return coarser
    epsilon = exp(bracket.low.at)
    while kept and (epsilon := epsilon * _FINER) > _FINEST:  # rings cross: refine
        coarser = _reduce_rings(polygons, reduce, epsilon)
        if evaluator.iou(coarser) >= iou_floor and evaluator.is_valid(coarser):
            return coarser
    return list(polygons)


def _reduce_rings(polygons: Sequence[Polygon], reduce: Reduction, epsilon: float) -> list[Polygon]:
    reduced = []
    for polygon in polygons:
        outer, *holes = (reduce(ring, epsilon) for ring in polygon.rings)
        if len(outer) >= 3:
            reduced.append(Polygon(outer, tuple(hole for hole in holes if len(hole) >= 3)))
    return reduced


def _douglas_peucker(ring: FloatArray, epsilon: float) -> FloatArray:
    return cv2.approxPolyDP(ring.astype(np.float32), epsilon, True)[:, 0].astype(np.float64)


def _visvalingam(ring: FloatArray, epsilon: float) -> FloatArray:
    """Drop vertices whose triangle with their neighbors is below epsilon^2, smallest first."""
    area = epsilon**2
    x: list[float] = ring[:, 0].tolist()
    y: list[float] = ring[:, 1].tolist()
    count = len(ring)
    before, after = [*range(-1, count - 1)], [*range(1, count), 0]
    before[0] = count - 1

    def triangle(i: int) -> float:
        a, b = before[i], after[i]
        twice: float = abs((x[a] - x[i]) * (y[b] - y[i]) - (y[a] - y[i]) * (x[b] - x[i]))
        return twice / 2

    heap = [(triangle(i), i) for i in range(count)]
    heapify(heap)
    size = {i: value for value, i in heap}
    while heap and len(size) > 2:
        value, i = heappop(heap)
        if size.get(i) != value:  # removed, or its area has changed
            continue
        if value >= area:
            break
        del size[i]
        a, b = before[i], after[i]
        after[a], before[b] = b, a
        for j in (a, b):
            size[j] = max(triangle(j), value)  # never smaller than one removed before
            heappush(heap, (size[j], j))
    return ring[sorted(size)] if len(size) > 2 else ring[:0]
