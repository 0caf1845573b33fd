"""Outlines: exact tracing with parts and holes, the floor of the IoU, the vertex search."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cohdc_train.contour import (
    METHODS,
    BeetleSearch,
    ContourMethod,
    Polygon,
    count_vertices,
    join_polygons,
    rasterize,
    simplify,
    trace,
)
from cohdc_train.contour.polygon_iou import IoUEvaluator, rings_cross

SIZE = (96, 128)
SEEDS = st.integers(0, 2**32 - 1)
WITH_FLOOR = [method for method in METHODS if method != "dp"]
FLOORS = st.sampled_from([0.8, 0.9, 0.95, 0.99, 1.0])


def blob(seed: int, size: tuple[int, int] = SIZE) -> NDArray[np.bool_]:
    """Return smoothed noise above its 70th percentile: several parts with holes and bays."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=size), (0, 0), 6)
    return np.asarray(noise > np.quantile(noise, 0.7))


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def test_one_pixel_is_a_unit_square() -> None:
    mask = np.zeros((5, 7), bool)
    mask[2, 4] = True
    (polygon,) = trace(mask)
    assert {tuple(point) for point in polygon.outer.tolist()} == {(4, 2), (5, 2), (5, 3), (4, 3)}
    assert polygon.holes == ()


def test_ring_has_a_hole() -> None:
    mask = np.ones((6, 6), bool)
    mask[2:4, 1:5] = False
    (polygon,) = trace(mask)
    assert len(polygon.outer) == 4
    (hole,) = polygon.holes
    assert hole.min(0).tolist() == [1, 2]
    assert hole.max(0).tolist() == [5, 4]
    assert np.array_equal(rasterize([polygon], (6, 6)), mask)


def test_empty_mask_has_no_outline() -> None:
    assert trace(np.zeros(SIZE, bool)) == []
    assert simplify([]) == []
    assert not rasterize([], SIZE).any()


@given(SEEDS, st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_tracing_and_filling_gives_any_mask_back(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((int(rng.integers(1, 30)), int(rng.integers(1, 30)))) < share
    assert np.array_equal(rasterize(trace(mask), mask.shape), mask)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_keyhole_rings_fill_like_polygons_with_holes(seed: int) -> None:
    polygons = trace(blob(seed))
    join_polygons = [Polygon(polygon.keyhole()) for polygon in polygons]
    assert np.array_equal(rasterize(join_polygons, SIZE), rasterize(polygons, SIZE))


@pytest.mark.filterwarnings(
    "ignore:__array__ implementation:DeprecationWarning"
)  # pycocotools under numpy 2
def test_coco_tools_fill_our_rings_alike() -> None:
    mask_tools = pytest.importorskip(
        "pycocotools.mask", reason="pycocotools comes with the train extra"
    )
    mask = blob(3)
    rings = [polygon.keyhole().ravel().tolist() for polygon in trace(mask)]
    theirs = mask_tools.decode(mask_tools.merge(mask_tools.frPyObjects(rings, *SIZE)))
    assert np.array_equal(theirs.astype(bool), mask)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_filling_follows_pixel_centers(seed: int) -> None:
    triangle = np.random.default_rng(seed).uniform(-5, 45, (3, 2))
    filled = rasterize([Polygon(triangle)], (40, 40))
    y, x = np.mgrid[:40, :40] + 0.5
    sides = []
    for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        sides.append((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]))
    inside = (np.min(sides, axis=0) > 0) | (np.max(sides, axis=0) < 0)
    assert np.array_equal(filled, inside)


@given(SEEDS, FLOORS, st.sampled_from(WITH_FLOOR))
@settings(max_examples=40, deadline=None)
def test_floor_holds_and_vertices_fall(seed: int, floor: float, method: ContourMethod) -> None:
    mask = blob(seed)
    polygons = trace(mask)
    simpler = simplify(polygons, floor, method, search=BeetleSearch(n=3))
    assert iou(rasterize(simpler, SIZE), mask) >= floor
    assert count_vertices(simpler) <= count_vertices(polygons)


@given(SEEDS, st.integers(0, 20), st.integers(0, 20), st.sampled_from(METHODS))
@settings(max_examples=25, deadline=None)
def test_moved_mask_has_the_moved_polygon(
    seed: int, dx: int, dy: int, method: ContourMethod
) -> None:
    mask = blob(seed)
    moved = np.zeros((SIZE[0] + 20, SIZE[1] + 20), bool)
    moved[dy : dy + SIZE[0], dx : dx + SIZE[1]] = mask
    search = BeetleSearch(n=3)
    here, there = (
        simplify(trace(mask), method=method, search=search),
        simplify(trace(moved), method=method, search=search),
    )
    assert len(here) == len(there)
    for a, b in zip(here, there, strict=True):
        for ring, moved_ring in zip(a.rings, b.rings, strict=True):
            assert np.allclose(ring + np.array([dx, dy]), moved_ring, atol=1e-9)


def test_vertex_search_needs_fewer_vertices_than_bisection() -> None:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    disc = (x - 60) ** 2 + (y - 48) ** 2 < 40**2
    polygons = trace(disc)
    bisected, searched = simplify(polygons, 0.97), simplify(polygons, 0.97, "bas_dp")
    assert count_vertices(searched) < count_vertices(bisected) < count_vertices(polygons) / 4
    assert iou(rasterize(searched, SIZE), disc) >= 0.97


def test_same_seed_same_polygon() -> None:
    polygons = trace(blob(4))
    first, again = (
        simplify(polygons, 0.9, "bas_dp", search=BeetleSearch(seed=5)) for _ in range(2)
    )
    assert all(np.array_equal(a.outer, b.outer) for a, b in zip(first, again, strict=True))


def test_fixed_tolerance_ignores_iou_floor() -> None:
    polygons = trace(blob(5))
    coarse, fine = (
        simplify(polygons, 1.0, "dp", epsilon=6),
        simplify(polygons, 1.0, "dp", epsilon=1),
    )
    assert count_vertices(coarse) < count_vertices(fine) < count_vertices(polygons)


def cross_somewhere(rings: list[NDArray[np.float64]]) -> bool:
    """Return whether two edges cross in a point inside both; compares all pairs."""
    edges = [
        (a, b)
        for ring in rings
        for a, b in zip(ring.tolist(), np.roll(ring, -1, axis=0).tolist(), strict=True)
    ]

    def side(a: list[float], b: list[float], c: list[float]) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    return any(
        side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
        for k, (a, b) in enumerate(edges)
        for c, d in edges[:k]
    )


@given(SEEDS, FLOORS, st.sampled_from(WITH_FLOOR))
@settings(max_examples=30, deadline=None)
def test_rings_do_not_cross_and_keep_orientation(
    seed: int, floor: float, method: ContourMethod
) -> None:
    """Holes have the opposite orientation of their outer ring."""
    simpler = simplify(trace(blob(seed)), floor, method, search=BeetleSearch(n=3))
    assert not cross_somewhere([ring for polygon in simpler for ring in polygon.rings])

    def turn(ring: NDArray[np.float64]) -> float:
        return float(
            np.sign(
                np.sum(ring[:, 0] * np.roll(ring[:, 1], -1) - ring[:, 1] * np.roll(ring[:, 0], -1))
            )
        )

    assert len({turn(polygon.outer) for polygon in simpler}) <= 1
    assert all(turn(hole) == -turn(polygon.outer) for polygon in simpler for hole in polygon.holes)


def test_rings_cross_for_bow_tie_but_not_for_touching_squares() -> None:
    square = np.array([[0, 0], [4, 0], [4, 4], [0, 4]], float)
    assert not rings_cross([square])
    assert rings_cross([square[[0, 2, 1, 3]]])
    assert rings_cross([square, square + 1])
    assert not rings_cross([square, square + np.array([4, 0])])  # a side in common


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_iou_by_crossings_equals_iou_by_filling(seed: int) -> None:
    """It holds for rings that cross themselves, too."""
    mask = blob(seed)
    evaluator, rng = IoUEvaluator(polygons := trace(mask)), np.random.default_rng(seed)
    low, high = evaluator.low, evaluator.high
    tangled = [Polygon(rng.uniform(low, high, (7, 2))) for _ in range(2)]
    for coarser in (simplify(polygons, method="dp", epsilon=3), tangled):
        assert evaluator.iou(coarser) == iou(rasterize(coarser, SIZE), mask)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_added_pixels_of_edges_equal_change_by_moved_vertex(seed: int) -> None:
    """The pixels that only one of outline and polygon has, counted by filling."""
    mask = blob(seed)
    evaluator, rng = IoUEvaluator(trace(mask)), np.random.default_rng(seed)
    low, high = evaluator.low, evaluator.high
    a, b = (evaluator.snap_to_grid(low + (high - low) * share) for share in ([0, 0.5], [1, 0.5]))
    heads = evaluator.snap_to_grid(rng.uniform((low[0], (low[1] + high[1]) / 2), high, (5, 2)))
    apart = [(rasterize([Polygon(np.array([a, b, head]))], SIZE) ^ mask).sum() for head in heads]
    turn = -1 if cv2.contourArea(trace(mask)[0].outer.astype(np.float32), oriented=True) < 0 else 1
    start, end = np.repeat(b[None], 5, 0), np.repeat(a[None], 5, 0)
    assert cv2.contourArea(np.array([a, b, high], np.float32), oriented=True) > 0
    added = evaluator.count_added_pixels(start, heads) + evaluator.count_added_pixels(heads, end)
    assert np.array_equal(turn * (added - added[0]), np.subtract(apart, apart[0]))


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_turned_mask_has_the_turned_outline(seed: int) -> None:
    mask = blob(seed)
    turned = trace(np.rot90(mask))  # (x, y) goes to (y, width - x)
    points = {tuple(p) for polygon in trace(mask) for ring in polygon.rings for p in ring.tolist()}
    assert {(y, SIZE[1] - x) for x, y in points} == {
        tuple(p) for polygon in turned for ring in polygon.rings for p in ring.tolist()
    }


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_one_ring_for_all_parts_fills_like_the_parts(seed: int) -> None:
    polygons = trace(blob(seed))
    assert np.array_equal(
        rasterize([Polygon(join_polygons(polygons))], SIZE), rasterize(polygons, SIZE)
    )


def odd_masks() -> dict[str, NDArray[np.bool_]]:
    y, x = np.mgrid[:60, :80]
    line = np.zeros((60, 80), bool)
    line[30, 5:70] = True
    diagonal = np.eye(60, 80, dtype=bool)
    return {
        "line": line,
        "diagonal": diagonal,
        "full frame": np.ones((60, 80), bool),
        "checkerboard": (x + y) % 2 == 0,
        "200 parts": (x % 5 < 2) & (y % 4 < 2),
        "ring of one pixel": (np.maximum(abs(x - 40), abs(y - 30)) == 20),
    }


@pytest.mark.parametrize("name", odd_masks())
@pytest.mark.parametrize("method", METHODS)
def test_odd_masks_have_outlines_that_keep_the_floor(name: str, method: ContourMethod) -> None:
    mask = odd_masks()[name]
    polygons = trace(mask)
    simpler = simplify(polygons, 0.9, method, epsilon=0.25)
    assert iou(rasterize(simpler, mask.shape), mask) >= 0.9
    assert count_vertices(simpler) <= count_vertices(polygons)
    if name == "full frame":
        assert count_vertices(simpler) == 4


def test_huge_mask_is_traced_and_simplified() -> None:
    """A step that is quadratic in pixels would take minutes for 8000 x 8000 px."""
    mask = np.zeros((8000, 8000), bool)
    cv2.ellipse(view := mask.view(np.uint8), (4000, 4000), (3500, 2000), 30, 0, 360, 1, -1)
    simpler = simplify(trace(mask), 0.97, "bas_dp")
    assert count_vertices(simpler) < 40
    filled = rasterize(simpler, mask.shape)
    assert np.count_nonzero(filled & mask) / np.count_nonzero(filled | mask) >= 0.97
    assert view.any()


def test_ring_of_wrong_orientation_is_not_valid() -> None:
    mask = np.zeros((4, 4), bool)
    mask[:, 0] = mask[3] = True
    evaluator = IoUEvaluator(trace(mask))
    (outline,) = trace(mask)
    assert evaluator.is_valid([outline])
    assert not evaluator.is_valid([Polygon(outline.outer[::-1])])


def test_hole_must_have_opposite_orientation() -> None:
    mask = np.ones((6, 6), bool)
    mask[2:4, 1:5] = False
    (outline,) = trace(mask)
    evaluator = IoUEvaluator([outline])
    assert evaluator.is_valid([outline])
    assert not evaluator.is_valid([Polygon(outline.outer, (outline.holes[0][::-1],))])


@given(SEEDS, st.sampled_from([0.5, 0.8]))
@settings(max_examples=60, deadline=None)
def test_floor_holds_for_small_masks_too(seed: int, floor: float) -> None:
    """The move of a vertex may turn a small ring inside out."""
    mask = blob(seed)[20:36, 30:46]
    if mask.any():
        assert iou(rasterize(simplify(trace(mask), floor, "bas_dp"), mask.shape), mask) >= floor


def test_unknown_method_is_named() -> None:
    with pytest.raises(
        ValueError, match="contour method 'rdp'; there are bisection, bas_dp, dp, visvalingam"
    ):
        simplify(trace(blob(0)), method="rdp")  # type: ignore[arg-type]


def test_search_parameters_have_the_papers_names() -> None:
    search = BeetleSearch(S=1.0, H=0.5, c=1.0, n=3)
    polygons = trace(blob(6))
    assert count_vertices(simplify(polygons, 0.9, "bas_dp", search=search)) <= count_vertices(
        simplify(polygons, 0.9)
    )
