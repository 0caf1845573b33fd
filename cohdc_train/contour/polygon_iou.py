"""IoU of polygons with an outline, from where their edges cross the columns of pixels."""

from collections.abc import Sequence
from functools import cache, cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.contour.polygons import CENTER, Polygon, crossings, edges
from cohdc_train.types import FloatArray, Int32Array, IntArray, Mask

_PER_PX = 5  # places of a vertex per px: the grid that COCO's tools fill on


class IoUEvaluator:
    """Compares simpler polygons with an outline, on the grid of the outline's bounds.

    Nothing is filled. A crossing with a column's center line has a place, which counts rows down
    the columns one after another. Between the first place and the second, the third and the fourth
    and so on, in their order, lie the pixels inside: the even-odd rule. Places of two outlines
    together enclose the pixels that only one of them has.

    Attributes:
        low: [2] px, upper left of the bounds.
        high: [2] px, lower right of the bounds.
        area: pixels of the outline.
    """

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        """Take the polygons of an outline, as `trace` gives them."""
        rings = [ring for polygon in polygons for ring in polygon.rings]
        start, end = edges(rings)
        axes = np.ascontiguousarray(start.T)
        self.low, self.high = np.floor(axes.min(1)), np.ceil(axes.max(1))
        self._first_center = self.low + CENTER
        self._width, height = (self.high - self.low).astype(int).tolist()
        self._rows = height + 1  # places in a column
        # half the edges of a traced outline run along columns
        across = np.flatnonzero(start[:, 0] != end[:, 0])
        places, _, _ = self._crossed(start.take(across, axis=0), end.take(across, axis=0))
        self._places = np.sort(places)
        self.area = _enclosed(self._places)
        self._sign = _orientation(polygons[0].outer)

    def iou(self, polygons: Sequence[Polygon]) -> float:
        """Return the IoU, 0..1, with polygons within the bounds, filled by the even-odd rule."""
        rings = [ring for polygon in polygons for ring in polygon.rings]
        return self.iou_of_edges(*edges(rings)) if rings else 0.0

    def iou_of_edges(self, start: FloatArray, end: FloatArray) -> float:
        """Return the IoU, 0..1, with closed rings, given as edges [E, 2] -> [E, 2]."""
        return self.approximate_iou(*self.count_pixels(start, end))

    def count_pixels(self, start: FloatArray, end: FloatArray) -> tuple[int, int]:
        """Count the pixels that closed rings cover, and those that only they or the outline have.

        The rings are given as edges [E, 2] -> [E, 2].
        """
        places = self._crossed(start, end)[0]
        both = np.concatenate((self._places, places))
        places.sort()
        both.sort()
        return _enclosed(places), _enclosed(both)

    def approximate_iou(self, covered: float, apart: int) -> float:
        """Return the IoU with polygons that cover so many pixels, of which `apart` differ."""
        return (self.area + covered - apart) / (self.area + covered + apart)

    def count_added_pixels(self, start: FloatArray, end: FloatArray) -> IntArray:
        """Count what edges [E, 2] -> [E, 2] add to the pixels that only one of the two has: [E].

        A constant per column is missing, which is the same for all paths from one point to another.
        It holds for rings that do not cross themselves and keep the orientation of the traced ones.
        """
        places, first, run = self._crossed(start, end)
        alone = np.zeros(len(places) + 1, np.int32)
        self._alone.take(places.astype(np.int64), out=alone[:-1], mode="clip")
        added: IntArray = np.add.reduceat(alone, first) * np.sign(run)
        return added

    @cached_property
    def _alone(self) -> Int32Array:
        """Rows above every place, less twice the outline's pixels above it."""
        hits = np.zeros(self._width * self._rows, np.uint8)
        np.add.at(hits, self._places.astype(np.int64), 1)
        inside = np.bitwise_xor.accumulate(hits) & 1
        alone = np.arange(len(hits), dtype=np.int32)
        alone[1:] -= 2 * np.cumsum(inside[:-1], dtype=np.int32)
        columns = alone.reshape(self._width, self._rows)
        signed: Int32Array = ((columns - columns[:, :1]) * self._sign).ravel()
        return signed

    def _crossed(self, start: FloatArray, end: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the places where edges cross columns, the first of every edge, and its columns."""
        places, row, first, run = crossings(start, end, self._first_center)
        places *= self._rows
        places += row
        return places, first, run

    def snap_to_grid(self, points: FloatArray) -> FloatArray:
        """Return points [..., 2] moved onto the grid of fifths and into the outline's bounds."""
        # exact for traced points, so that halves are rounded the same way everywhere
        placed: FloatArray = points * _PER_PX
        placed += 0.5
        np.floor(placed, out=placed)
        placed /= _PER_PX
        for axis in range(2):
            line = placed[..., axis]
            np.clip(line, self.low[axis], self.high[axis], out=line)
        return placed

    def is_valid(self, polygons: Sequence[Polygon]) -> bool:
        """Return whether no rings cross, and all have the orientation of the outline's rings.

        Holes have the opposite one.
        """
        for polygon in polygons:
            if _orientation(polygon.outer) != self._sign or any(
                _orientation(hole) != -self._sign for hole in polygon.holes
            ):
                return False
        return not rings_cross([ring for polygon in polygons for ring in polygon.rings])


def _enclosed(places: FloatArray) -> int:
    """Count the pixels between places in order."""
    return int(_signs(len(places).bit_length())[: len(places)] @ places)


@cache
def _signs(bits: int) -> FloatArray:
    """Return -1, 1, -1, 1 and so on, 2^bits of them."""
    return np.tile([-1.0, 1.0], 2**bits // 2)


def _orientation(ring: FloatArray) -> int:
    """Return -1 where a ring [n, 2] goes clockwise as seen in an image, else 1."""
    return 1 if cv2.contourArea(ring.astype(np.float32), oriented=True) < 0 else -1


_BLOCK = 1024  # edges compared at a time


def rings_cross(rings: Sequence[FloatArray]) -> bool:
    """Return whether two edges cross, of one ring or of two; rings that only touch do not.

    Exact for points with one decimal.
    """
    if not rings:
        return False
    points = np.rint(10 * np.array(edges(rings))).view(np.complex128)[..., 0]
    blocks = [points[:, i : i + _BLOCK] for i in range(0, points.shape[1], _BLOCK)]
    for k, block in enumerate(blocks):
        for other in blocks[k:]:
            parted = _separates(block, other)
            if np.count_nonzero(
                parted & (parted if other is block else _separates(other, block)).T
            ):
                return True
    return False


def _separates(edges: NDArray[np.complex128], others: NDArray[np.complex128]) -> Mask:
    """Return [m, n]: the lines through edges [2, m] separate the ends of other edges [2, n].

    Points are complex: x + iy.
    """
    start, along = edges[0, :, None], edges[1, :, None] - edges[0, :, None]
    sides = ((others[:, None] - start) * along.conj()).imag
    parted: Mask = sides[0] * sides[1] < 0
    return parted
