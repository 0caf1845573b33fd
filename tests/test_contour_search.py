"""Parts of the two searches: the bracket of tolerances, and the vertex swarm."""

from math import exp, log

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cohdc_train.contour import BeetleSearch, Polygon, count_vertices, rasterize, simplify, trace
from cohdc_train.contour.polygon_iou import IoUEvaluator, rings_cross
from cohdc_train.contour.tolerance_search import ToleranceBracket
from cohdc_train.contour.vertex_swarm import VertexSwarm

SIZE = (96, 128)


def two_discs(radius: float) -> NDArray[np.bool_]:
    """Return a disc of 30 px and a second disc."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    big, small = (x - 40) ** 2 + (y - 48) ** 2 < 30**2, (x - 100) ** 2 + (y - 48) ** 2 < radius**2
    return np.asarray(big | small)


@given(st.floats(0.5, 20), st.floats(0.5, 2), st.floats(0.3, 3), st.floats(0.001, 0.3))
@settings(max_examples=100, deadline=None)
def test_bracket_closes_on_the_tolerance_that_reaches_the_floor(
    right: float, power: float, wrong: float, allowed: float
) -> None:
    """The loss is a power of the tolerance, and the first guess is wrong by a factor.

    The number of vertices never ends the search.
    """
    bracket = ToleranceBracket.of(0.25, 40.0, allowed, wrong * allowed / right)
    tried = 0
    while True:
        tried += 1
        lost = allowed * (exp(bracket.at) / right) ** power
        kept = exp(bracket.low.at)
        if not bracket.add(lost, round(1e6 / exp(bracket.at)), lost <= allowed):
            break
        assert exp(bracket.low.at) >= kept
    assert tried <= 12
    assert exp(bracket.low.at) <= right
    gap = log(right) - bracket.low.at
    assert power * gap <= 0.08 or gap <= 0.06, (
        "neither is the floor all but reached nor the bracket narrow"
    )


def test_bracket_ends_when_its_ends_differ_by_one_vertex() -> None:
    bracket = ToleranceBracket.of(0.25, 40.0, 0.05, 0.05)
    assert bracket.add(0.02, 12, True)
    assert not bracket.add(0.09, 11, False)


@given(st.lists(st.integers(3, 9), min_size=1, max_size=4), st.integers(0, 20))
@settings(max_examples=60, deadline=None)
def test_vertices_that_move_together_are_no_neighbors(sizes: list[int], first: int) -> None:
    rings = []
    for k, size in enumerate(sizes):
        angle = np.arange(size) * 2 * np.pi / size
        rings.append(np.stack([10 + 20 * k + 8 * np.cos(angle), 10 + 8 * np.sin(angle)], axis=1))
    polygons = [Polygon(ring) for ring in rings]
    swarm = VertexSwarm(polygons, IoUEvaluator(polygons), pairs=4)
    moved = set()
    for k in range(max(sizes)):
        for index in swarm._turns(first + k):
            assert not set(swarm._after[index].tolist()) & set(index.tolist())
            moved |= set(index.tolist())
    assert moved == set(range(sum(sizes)))


@given(st.floats(4, 25), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_sum_of_f_counts_differing_pixels(radius: float, seed: int) -> None:
    """It holds through moves and drops of one vertex, of several and of a whole part."""
    mask, rng = two_discs(radius), np.random.default_rng(seed)
    outline = trace(mask)
    evaluator = IoUEvaluator(outline)
    swarm = VertexSwarm(simplify(outline, 0.97), evaluator, pairs=4)
    for k, together in enumerate((3, 1, 2)):
        swarm.move(2.0, (2.0, 1.0)[k % 2], k, rng)
        choices = swarm.joint_removals(together) if together > 1 else swarm.cheapest_removals(1)
        if choices:
            swarm = swarm.without(*choices[0])
    polygons = swarm.polygons()
    if evaluator.is_valid(polygons):
        assert swarm._apart == (rasterize(polygons, SIZE) ^ mask).sum()
        assert swarm.approximate_iou() == pytest.approx(swarm.iou(), abs=0.01)


def test_small_part_is_dropped_and_large_part_stays() -> None:
    """Bisection keeps the small one, as it has more than two vertices."""
    small, large = trace(two_discs(4)), trace(two_discs(12))
    assert len(simplify(small, 0.95)) == 2
    assert len(simplify(small, 0.95, "bas_dp")) == 1
    assert len(simplify(large, 0.95, "bas_dp")) == 2


def test_moves_after_the_last_drop_raise_the_iou() -> None:
    """The IoU rises above the floor with the same vertices."""
    mask = two_discs(25)
    polygons = trace(mask)
    spare = [
        IoUEvaluator(polygons).iou(simplify(polygons, floor, "bas_dp")) - floor
        for floor in (0.93, 0.95, 0.97)
    ]
    assert min(spare) >= 0
    assert max(spare) > 0.005


def test_search_without_moves_only_drops_vertices() -> None:
    polygons = trace(two_discs(25))
    simpler = simplify(polygons, 0.95, "bas_dp", search=BeetleSearch(n=0))
    corners = {tuple(p) for polygon in polygons for p in polygon.outer.tolist()}
    assert {tuple(p) for polygon in simpler for p in polygon.outer.tolist()} <= corners


@pytest.mark.parametrize("c", [1.0, 2.0])
def test_whiskers_of_any_length_keep_the_floor(c: float) -> None:
    mask = two_discs(25)
    simpler = simplify(trace(mask), 0.97, "bas_dp", search=BeetleSearch(c=c))
    filled = rasterize(simpler, SIZE)
    assert (filled & mask).sum() / (filled | mask).sum() >= 0.97
    assert count_vertices(simpler) < count_vertices(simplify(trace(mask), 0.97))


def test_crossings_are_found_between_blocks_of_edges() -> None:
    angle = np.arange(3000) * 2 * np.pi / 3000
    circle = np.round(np.stack([np.cos(angle), np.sin(angle)], axis=1) * 5000) / 10
    assert not rings_cross([circle])
    assert not rings_cross([circle, circle * 0.9])
    assert rings_cross([circle, circle + np.array([30.0, 17.3])])
