"""How well polygons cover an outline, told edge by edge."""

from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.contour.polygons import FloatArray, IntArray, Polygon, crossings, edges, rasterize

GRID = 0.2  # px, between places for a vertex: one decimal in a file, and the grid that COCO's tools fill on


class Coverage:
    """The filled outline that simpler ones are compared with, on the grid of its bounds.

    What a simple ring covers is a sum over its edges: below every crossing with a column's centre line, the rows (its
    area) and the pixels of the outline (what both have in common) count with the edge's direction. So a moved vertex
    changes its own two edges only, and nothing is filled. Rings must keep the orientation they were traced in.
    """

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        points = np.concatenate([polygon.outer for polygon in polygons])
        self.low, self.high = np.floor(points.min(0)), np.ceil(points.max(0))
        width, height = (self.high - self.low).astype(int).tolist()
        self._size = (height, width)
        self._filled = self._fill(polygons)
        self.area = int(np.count_nonzero(self._filled))
        sums = cv2.integral(self._filled.view(np.uint8))  # of the pixels above and left of each corner
        self._above = np.ascontiguousarray(sums[:, 1:] - sums[:, :-1]).ravel()  # pixels of it above, per row and column
        x, y = polygons[0].outer.T
        turn = x @ np.roll(y, -1) - y @ np.roll(x, -1)  # to the right along the bottom where it is negative
        self._sign = -1 if turn > 0 else 1

    @cached_property
    def _alone(self) -> NDArray[np.int32]:
        """Rows above less twice the outline's pixels above, per row and column."""
        height, width = self._size
        alone: NDArray[np.int32] = np.repeat(np.arange(height + 1, dtype=np.int32), width) - 2 * self._above
        return alone

    def difference(self, start: FloatArray, end: FloatArray) -> IntArray:
        """What edges [E, 2] -> [E, 2] add to the pixels that only one of the two has, less a constant: [E]."""
        edge, place, _, direction = self._crossed(start, end)
        return np.bincount(edge, direction * self._alone[place], len(start)).astype(np.int64)

    def sums(self, polygons: Sequence[Polygon]) -> tuple[int, int]:
        """Area covered and area in common of polygons without crossing rings, px."""
        rings = [ring for polygon in polygons for ring in polygon.rings]
        if not rings:
            return 0, 0
        return self.between(*edges(rings))

    def between(self, start: FloatArray, end: FloatArray) -> tuple[int, int]:
        """The same of closed rings, given as edges [E, 2] -> [E, 2]."""
        _, place, row, direction = self._crossed(start, end)
        return int(direction @ row), int(direction @ self._above[place])

    def _crossed(self, start: FloatArray, end: FloatArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Crossings of edges with the columns: the edge, the place in the tables, the row, the sign it counts by."""
        edge, row, column, direction = crossings(start - self.low, end - self.low, self._size)
        return edge, row * self._size[1] + column, row, direction * self._sign

    def nearest(self, points: FloatArray) -> FloatArray:
        """Points [..., 2] moved onto the GRID and into the outline's bounds."""
        local = np.round((points - self.low) / GRID) * GRID
        placed: FloatArray = self.low + np.clip(local, 0, self.high - self.low)
        return placed

    def iou(self, polygons: Sequence[Polygon]) -> float:
        """IoU of polygons without crossing rings that lie within the bounds, 0..1."""
        return self.ratio(*self.sums(polygons))

    def ratio(self, covered: int, common: int) -> float:
        """IoU of two areas, px; 0 where the rings are turned inside out."""
        return common / (self.area + covered - common) if covered > 0 else 0.0

    def keep(self, polygons: Sequence[Polygon], iou_floor: float) -> bool:
        """Whether polygons whose `iou` keeps the floor do so when they are filled, and no ring crosses another."""
        rings = [ring for polygon in polygons for ring in polygon.rings]
        if crossing(rings):
            return False
        if len(rings) == 1:  # then the sum over the edges is what is filled
            return True
        filled = self._fill(polygons)
        common = int(np.count_nonzero(filled & self._filled))
        return self.ratio(int(np.count_nonzero(filled)), common) >= iou_floor

    def _fill(self, polygons: Sequence[Polygon]) -> NDArray[np.bool_]:
        moved = [Polygon(p.outer - self.low, tuple(hole - self.low for hole in p.holes)) for p in polygons]
        return rasterize(moved, self._size)


_MOST_PAIRS = 1 << 20  # of edges compared at a time


def crossing(rings: Sequence[FloatArray]) -> bool:
    """Whether two edges cross, of one ring or of two; rings that only touch do not."""
    if not rings:
        return False
    start, end = edges(rings)
    low, high = np.minimum(start, end), np.maximum(start, end)
    rows = max(1, _MOST_PAIRS // len(start))
    for first in range(0, len(start), rows):
        near = np.ones((min(rows, len(start) - first), len(start)), np.bool_)
        for axis in (0, 1):
            near &= low[first : first + rows, None, axis] <= high[None, :, axis]
            near &= high[first : first + rows, None, axis] >= low[None, :, axis]
        i, j = np.nonzero(near)
        i += first
        i, j = i[i < j], j[i < j]
        a, b, c, d = start[i], end[i], start[j], end[j]
        apart = _side(a, b, c) * _side(a, b, d) < 0
        if (apart & (_side(c, d, a) * _side(c, d, b) < 0)).any():
            return True
    return False


def _side(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    u, v = b - a, c - a
    return np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
