"""Masks as polygons: exact outlines with parts and holes, and outlines of few vertices that keep a floor of IoU.

Points are (x, y) in px with the origin at the corner of the first pixel, as COCO has them: pixel (i, j) is the square
from (j, i) to (j + 1, i + 1) and belongs to a polygon when its centre does (even-odd rule over all rings).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Method = Literal["bisection", "dp", "bas_dp"]

_BISECTIONS = 9  # evaluations of the real-time path


@dataclass(frozen=True)
class Polygon:
    """One connected part of a mask. outer: [n, 2] px, n >= 3; holes: rings of the same kind inside it."""

    outer: FloatArray
    holes: tuple[FloatArray, ...] = ()

    @property
    def rings(self) -> tuple[FloatArray, ...]:
        """The outer ring, then the holes."""
        return (self.outer, *self.holes)

    def keyhole(self) -> FloatArray:
        """The part as one ring [n, 2], px: every hole is joined by a bridge of no width, for formats without holes."""
        ring = self.outer
        for hole in self.holes:
            gaps = np.linalg.norm(ring[:, None] - hole, axis=2)
            i, j = np.unravel_index(int(gaps.argmin()), gaps.shape)
            ring = np.concatenate([ring[: i + 1], hole[j:], hole[: j + 1], ring[i:]])
        return ring


@dataclass(frozen=True)
class BeetleSearch:
    """Parameters of the beetle antennae search, named as the paper's section 2.1.3 names them.

    step: S, length of the first move, px per vertex; attenuation: H, factor on the step after every move; ratio: c, the
    step over the distance between the whiskers; iterations: n, moves per search; seed: of the random directions.
    """

    step: float = 1.0
    attenuation: float = 0.97
    ratio: float = 1.0
    iterations: int = 60
    seed: int = 0


def trace(mask: NDArray[np.bool_]) -> list[Polygon]:
    """The outline of a mask [H, W] along the edges of its pixels, one polygon per 8-connected part.

    Filling the polygons gives exactly the mask back (inner corners are cut by half a pixel, which reaches no pixel's
    centre); an empty mask has none.
    """
    # a grid of the pixels' corners and centres: every pixel sets its 3 x 3 nodes, so the border runs along pixel edges
    nodes = np.zeros((2 * mask.shape[0] + 1, 2 * mask.shape[1] + 1), np.uint8)
    nodes[1::2, 1::2] = mask
    nodes = cv2.dilate(nodes, np.ones((3, 3), np.uint8))
    found, hierarchy = cv2.findContours(nodes, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    rings = [ring.reshape(-1, 2).astype(np.float64) / 2 for ring in found]
    parents = [] if hierarchy is None else hierarchy.reshape(-1, 4)[:, 3].tolist()
    parts: dict[int, list[FloatArray]] = {k: [ring] for k, ring in enumerate(rings) if parents[k] < 0}
    for ring, parent in zip(rings, parents, strict=True):
        if parent >= 0:
            parts[parent].append(ring)
    return [Polygon(outer, tuple(holes)) for outer, *holes in parts.values()]


def rasterize(polygons: Sequence[Polygon], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Fill polygons by the even-odd rule at pixel centres. size: (height, width), px. Returns [height, width] bool."""
    return _fill([ring for polygon in polygons for ring in polygon.rings], size)


def _fill(rings: Sequence[FloatArray], size: tuple[int, int]) -> NDArray[np.bool_]:
    height, width = size
    if not rings:
        return np.zeros(size, np.bool_)
    start = np.concatenate(rings)
    end = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    # columns whose centre line an edge crosses, then the row below each crossing
    left, right = (
        np.ceil(f(start[:, 0], end[:, 0]) - 0.5).clip(0, width).astype(np.int64) for f in (np.minimum, np.maximum)
    )
    counts = right - left
    edge = np.repeat(np.arange(len(start)), counts)
    column = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts - left, counts)
    (x0, y0), (dx, dy) = start[edge].T, (end - start)[edge].T
    row = np.ceil(y0 + (column + 0.5 - x0) * dy / dx - 0.5).clip(0, height).astype(np.int64)
    crossings = np.bincount(row * width + column, minlength=(height + 1) * width).reshape(height + 1, width)
    odd = np.bitwise_xor.accumulate((crossings & 1).astype(np.uint8), axis=0)
    return odd[:height].astype(np.bool_)


def vertices(polygons: Sequence[Polygon]) -> int:
    """How many vertices polygons have together."""
    return sum(len(ring) for polygon in polygons for ring in polygon.rings)


def simplify(
    polygons: Sequence[Polygon],
    iou_floor: float = 0.95,
    method: Method = "bisection",
    epsilon: float = 2.0,
    search: BeetleSearch | None = None,
) -> list[Polygon]:
    """The same outline with fewer vertices.

    iou_floor: the least IoU, 0..1, of the result with the polygons given, both filled at pixel centres. `bisection`
    looks for the largest Douglas-Peucker tolerance that keeps the floor: the real-time path. `bas_dp` goes on from
    there: it drops vertices and moves the rest by beetle antennae search (the paper's equation 2), and keeps the finer
    polygon when the floor cannot be reached. `dp` is plain Douglas-Peucker with the tolerance `epsilon`, px, which
    knows no floor. Parts and holes too small to keep three vertices vanish where the floor allows it.
    """
    if not polygons:
        return []
    if method == "dp":
        return _douglas_peucker(polygons, epsilon)
    target = _Target(polygons)
    finer = _bisect(polygons, iou_floor, target)
    if method == "bisection":
        return finer
    return _drop_and_move(finer, iou_floor, target, search or BeetleSearch())


class _Target:
    """The filled outline that simpler ones are compared with, cropped to its bounds."""

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        points = np.concatenate([polygon.outer for polygon in polygons])
        self.low, self.high = np.floor(points.min(0)), np.ceil(points.max(0))
        width, height = (self.high - self.low).astype(int).tolist()
        self._size = (height, width)
        self._filled = self._fill(polygons)
        self._area = np.count_nonzero(self._filled)

    def _fill(self, polygons: Sequence[Polygon]) -> NDArray[np.bool_]:
        return _fill([ring - self.low for polygon in polygons for ring in polygon.rings], self._size)

    def iou(self, polygons: Sequence[Polygon]) -> float:
        """IoU of polygons that lie within the bounds with the target, 0..1."""
        filled = self._fill(polygons)
        both = np.count_nonzero(filled & self._filled)
        union = self._area + np.count_nonzero(filled) - both
        return both / union if union else 1.0


def _douglas_peucker(polygons: Sequence[Polygon], epsilon: float) -> list[Polygon]:
    def reduce(ring: FloatArray) -> FloatArray:
        return cv2.approxPolyDP(ring.astype(np.float32), epsilon, True).reshape(-1, 2).astype(np.float64)

    reduced = []
    for polygon in polygons:
        outer, *holes = (reduce(ring) for ring in polygon.rings)
        if len(outer) >= 3:
            reduced.append(Polygon(outer, tuple(hole for hole in holes if len(hole) >= 3)))
    return reduced


def _bisect(polygons: Sequence[Polygon], iou_floor: float, target: _Target) -> list[Polygon]:
    best = list(polygons)
    points = np.concatenate([polygon.outer for polygon in polygons])
    low, high = 0.0, 0.1 * float(np.linalg.norm(np.ptp(points, axis=0)))
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        coarser = _douglas_peucker(polygons, middle)
        if target.iou(coarser) >= iou_floor:
            low = middle
            best = min(best, coarser, key=vertices)  # the IoU does not fall evenly, so a later one may have more
        else:
            high = middle
    return best


def _drop_and_move(finer: list[Polygon], iou_floor: float, target: _Target, search: BeetleSearch) -> list[Polygon]:
    """Drop a vertex and move the others, again and again while the floor is reached; the last that reached it."""
    rng = np.random.default_rng(search.seed)
    while coarser := _one_dropped(finer):
        coarser = _moved_by_beetle(coarser, iou_floor, target, search, rng)
        if target.iou(coarser) < iou_floor:
            break
        finer = coarser
    return finer


def _one_dropped(polygons: list[Polygon]) -> list[Polygon]:
    """Without the vertex whose triangle with its neighbours is smallest; [] when every ring is a triangle."""
    rings = [ring for polygon in polygons for ring in polygon.rings]
    areas = {k: _triangle_areas(ring) for k, ring in enumerate(rings) if len(ring) > 3}
    if not areas:
        return []
    k = min(areas, key=lambda k: float(areas[k].min()))
    rings[k] = np.delete(rings[k], int(areas[k].argmin()), axis=0)
    return _rebuilt(polygons, rings)


def _triangle_areas(ring: FloatArray) -> FloatArray:
    a, b = np.roll(ring, 1, axis=0) - ring, np.roll(ring, -1, axis=0) - ring
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def _rebuilt(polygons: list[Polygon], rings: list[FloatArray]) -> list[Polygon]:
    left = iter(rings)
    return [Polygon(next(left), tuple(next(left) for _ in polygon.holes)) for polygon in polygons]


def _moved_by_beetle(
    polygons: list[Polygon],
    iou_floor: float,
    target: _Target,
    search: BeetleSearch,
    rng: np.random.Generator,
) -> list[Polygon]:
    """Move all vertices together, k = 2V parameters, until the floor is reached or n moves are made.

    Equation 2, f(x) = 1 - IoU. Its second line uses `step` where the right whisker stands; both whiskers are d_0 / 2
    from the head here. The head stays at the best position seen, where the paper's walks on from a worse one: with as
    many as 2V parameters and a random direction most moves are for the worse.
    """
    rings = [ring for polygon in polygons for ring in polygon.rings]
    cuts = np.cumsum([len(ring) for ring in rings])[:-1]

    def shape(x: FloatArray) -> list[Polygon]:
        return _rebuilt(polygons, np.split(x.reshape(-1, 2), cuts))

    best, best_iou = np.concatenate(rings).ravel(), target.iou(polygons)
    low, high = np.tile(target.low, best.size // 2), np.tile(target.high, best.size // 2)
    step = search.step * np.sqrt(best.size / 2)  # a unit direction shares the step among all vertices
    for _ in range(search.iterations):
        if best_iou >= iou_floor:
            break
        direction = rng.normal(size=best.size)
        direction /= np.linalg.norm(direction)
        d_0 = step / search.ratio
        f_left, f_right = (1 - target.iou(shape(best + side * d_0 * direction / 2)) for side in (1, -1))
        x = np.clip(best - step * direction * np.sign(f_left - f_right), low, high)
        here = target.iou(shape(x))
        if here > best_iou:
            best, best_iou = x, here
        step *= search.attenuation
    return shape(best)
