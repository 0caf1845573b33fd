"""A mask's exact outline with its parts and holes, and back."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cohdc_train.types import FloatArray, IntArray, Mask

CENTER = np.array(
    [0.5, 0.5 + 1e-7]
)  # px; an edge that near a pixel's center goes through it, wherever the grid begins


@dataclass(frozen=True)
class Polygon:
    """One connected part of a mask. outer: [n, 2] px, n >= 3; holes: rings of the same kind inside
    it.
    """

    outer: FloatArray
    holes: tuple[FloatArray, ...] = ()

    @property
    def rings(self) -> tuple[FloatArray, ...]:
        """The outer ring, then the holes."""
        return (self.outer, *self.holes)

    def keyhole(self) -> FloatArray:
        """The part as one ring [n, 2], px: every hole is joined by a bridge of no width, for
        formats without holes.
        """
        return _bridge(self.rings)


def join_polygons(polygons: Sequence[Polygon]) -> FloatArray:
    """All parts as one ring [n, 2], px, joined by bridges of no width, for formats of one ring per
    object.
    """
    return _bridge([polygon.keyhole() for polygon in polygons])


def _bridge(rings: Sequence[FloatArray]) -> FloatArray:
    ring = rings[0]
    for other in rings[1:]:
        gaps = np.linalg.norm(ring[:, None] - other, axis=2)
        i, j = np.unravel_index(int(gaps.argmin()), gaps.shape)
        ring = np.concatenate([ring[: i + 1], other[j:], other[: j + 1], ring[i:]])
    return ring


def trace(mask: Mask) -> list[Polygon]:
    """The outline of a mask [H, W] along the edges of its pixels, one polygon per 8-connected part.

    Filling the polygons gives exactly the mask back (inner corners are cut by half a pixel, which
    reaches no pixel's center); an empty mask has none.
    """
    # a grid of the pixels' corners and centers: every pixel sets its 3 x 3 nodes, so the border
    # runs along pixel edges
    nodes = np.zeros((2 * mask.shape[0] + 1, 2 * mask.shape[1] + 1), np.uint8)
    nodes[1::2, 1::2] = mask
    nodes = cv2.dilate(nodes, np.ones((3, 3), np.uint8))
    found, hierarchy = cv2.findContours(nodes, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    rings = [ring.reshape(-1, 2).astype(np.float64) / 2 for ring in found]
    parents = [] if hierarchy is None else hierarchy.reshape(-1, 4)[:, 3].tolist()
    parts: dict[int, list[FloatArray]] = {
        k: [ring] for k, ring in enumerate(rings) if parents[k] < 0
    }
    for ring, parent in zip(rings, parents, strict=True):
        if parent >= 0:
            parts[parent].append(ring)
    return [Polygon(outer, tuple(holes)) for outer, *holes in parts.values()]


def pixel_borders(mask: Mask) -> list[list[float]] | None:
    """Trace the parts of a mask along the borders of their pixels, as COCO's polygons.

    Every pixel is enlarged to 3 x 3. OpenCV's contour runs through pixel centers, so it then lies
    within half a pixel of the border that it stands for, and rounds to it: the polygons cover
    exactly the mask. `trace` gives fewer vertices, and holes.

    Args:
        mask: [H, W] bool.

    Returns:
        One polygon [x0, y0, x1, y1, ...], px, per 4-connected part; None when a part has a hole.
    """
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    polygons: list[list[float]] = []
    for part in range(1, count):
        large = np.kron((parts == part).astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
        contours, _ = cv2.findContours(large, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        if len(contours) != 1:
            return None
        corners = np.rint((contours[0][:, 0] + 0.5) / 3)
        is_new = np.any(corners != np.roll(corners, 1, axis=0), axis=1)
        polygons.append([float(value) for value in corners[is_new].ravel()])
    return polygons


def rasterize(polygons: Sequence[Polygon], size: tuple[int, int]) -> Mask:
    """Fill polygons by the even-odd rule at pixel centers. size: (height, width), px. Returns
    [height, width] bool.
    """
    if not polygons:
        return np.zeros(size, np.bool_)
    height, width = size
    start, end = edges([ring for polygon in polygons for ring in polygon.rings])
    met = crossings(start, end, CENTER, width)
    place = met.row.clip(0, height) * width + met.column
    hits = np.bincount(place.astype(np.int64), minlength=(height + 1) * width).reshape(
        height + 1, width
    )
    odd = np.bitwise_xor.accumulate(hits[:height].astype(np.uint8), axis=0) & 1
    return odd.view(np.bool_)


def edges(rings: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Where the edges of all rings begin and end: two [E, 2], px. There is a ring at least."""
    if len(rings) == 1:
        (ring,) = rings
        return ring, np.concatenate((ring[1:], ring[:1]))
    return np.concatenate(rings), np.concatenate(
        [part for ring in rings for part in (ring[1:], ring[:1])]
    )


class Crossings(NamedTuple):
    """Where E edges cross the center lines of a grid's columns, N times, edge after edge.

    column, row: [N] whole numbers; the row is that of the first pixel center below.
    first: [E], the first crossing of every edge; run: [E], columns from its start to its end, with
    their sign.
    """

    column: FloatArray
    row: FloatArray
    first: IntArray
    run: IntArray


def crossings(
    start: FloatArray, end: FloatArray, origin: FloatArray, width: int | None = None
) -> Crossings:
    """Crossings of edges [E, 2] -> [E, 2], px, with columns.

    origin: [2] px, the CENTER of the grid's first pixel. width: that the columns are limited to;
    without it no point may lie beside the grid.
    """
    x, to_x = start[:, 0] - origin[0], end[:, 0] - origin[0]
    y = start[:, 1] - origin[1]
    dx, dy = to_x - x, end[:, 1] - start[:, 1]
    left, right = np.ceil(x), np.ceil(to_x)
    if width is not None:
        left, right = left.clip(0, width), right.clip(0, width)
    run = (right - left).astype(np.int64)
    counts = np.abs(run)
    first = counts.cumsum()
    first -= counts
    column = (np.minimum(left, right) - first).repeat(counts)
    column += np.arange(len(column), dtype=np.float64)
    slope = dy / (dx + (dx == 0))
    row = slope.repeat(counts)
    row *= column
    row += (y - x * slope).repeat(counts)
    return Crossings(column, np.ceil(row, out=row), first, run)


def count_vertices(polygons: Sequence[Polygon]) -> int:
    """How many vertices polygons have together."""
    return sum(len(ring) for polygon in polygons for ring in polygon.rings)
