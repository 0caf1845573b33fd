"""Trace the exact outline of a mask with its parts and holes, and fill it again."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cohdc_train.types import FloatArray, IntArray, Mask

# px; an edge this near to a pixel's center goes through it, wherever the grid begins
CENTER = np.array([0.5, 0.5 + 1e-7])


@dataclass(frozen=True)
class Polygon:
    """One connected part of a mask.

    Attributes:
        outer: [n, 2] px, n >= 3.
        holes: rings of the same kind inside it.
    """

    outer: FloatArray
    holes: tuple[FloatArray, ...] = ()

    @property
    def rings(self) -> tuple[FloatArray, ...]:
        """Outer ring, then the holes."""
        return (self.outer, *self.holes)

    def keyhole(self) -> FloatArray:
        """Return the part as one ring [n, 2], px, for formats without holes.

        Every hole is joined by a bridge of no width.
        """
        return _bridge(self.rings)


def join_polygons(polygons: Sequence[Polygon]) -> FloatArray:
    """Return all parts as one ring [n, 2], px, for formats of one ring per object.

    Parts are joined by bridges of no width.
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
    """Trace the outline of a mask along the edges of its pixels, one polygon per 8-connected part.

    Filling the polygons gives exactly the mask again (inner corners are cut by half a pixel, which
    reaches no pixel's center). An empty mask has none.

    mask: [H, W] bool.
    """
    # Nodes are the pixels' corners and centers. A pixel sets its 3 x 3 nodes, so that the border
    # runs along pixel edges.
    nodes = np.zeros((2 * mask.shape[0] + 1, 2 * mask.shape[1] + 1), np.uint8)
    nodes[1::2, 1::2] = mask
    nodes = cv2.dilate(nodes, np.ones((3, 3), np.uint8))
    found, hierarchy = cv2.findContours(nodes, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    rings = [ring.reshape(-1, 2).astype(np.float64) / 2 for ring in found]
    parents = [] if hierarchy is None else hierarchy.reshape(-1, 4)[:, 3].tolist()
    outer_rings = {k: ring for k, ring in enumerate(rings) if parents[k] < 0}
    parts = {k: [ring] for k, ring in outer_rings.items()}
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
    """Fill polygons by the even-odd rule at pixel centers.

    Args:
        polygons: in px.
        size: (height, width), px.

    Returns:
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
    """Return the beginnings and ends of the edges of all rings, [E, 2] each, px; needs a ring."""
    if len(rings) == 1:
        (ring,) = rings
        return ring, np.concatenate((ring[1:], ring[:1]))
    return np.concatenate(rings), np.concatenate(
        [part for ring in rings for part in (ring[1:], ring[:1])]
    )


class Crossings(NamedTuple):
    """N crossings of E edges with the center lines of a grid's columns, edge after edge.

    Attributes:
        column: [N] whole numbers.
        row: [N] whole numbers, of the first pixel center below.
        first: [E], the first crossing of every edge.
        run: [E], columns from its beginning to its end, signed.
    """

    column: FloatArray
    row: FloatArray
    first: IntArray
    run: IntArray


def crossings(
    start: FloatArray, end: FloatArray, origin: FloatArray, width: int | None = None
) -> Crossings:
    """Return the crossings of edges [E, 2] -> [E, 2], px, with columns.

    Args:
        start: [E, 2] px.
        end: [E, 2] px.
        origin: [2] px, the CENTER of the grid's first pixel.
        width: number of columns; without it no point may lie outside the grid.
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
    """Count the vertices of all polygons."""
    return sum(len(ring) for polygon in polygons for ring in polygon.rings)
