"""Masks as run lengths, made of the small window that holds them; and their boundaries."""

from typing import Any

import cv2
import numpy as np
from faster_coco_eval.core import mask as rle
from numpy.typing import NDArray

from cohdc_train.models.cqe_targets import band_of

_STEP = np.ones((3, 3), np.uint8)


def to_rle(segmentation: Any, size: tuple[int, int]) -> Any:
    """Polygons, in px, or compressed RLE -> compressed RLE. size: (height, width) px."""
    if isinstance(segmentation, dict):
        return segmentation
    return rle.merge(rle.frPyObjects(segmentation, *size))


def window_rle(
    window: NDArray[np.bool_], corner: tuple[int, int], size: tuple[int, int]
) -> dict[str, Any]:
    """The compressed RLE of a mask of which only a window [h, w] is known, and nothing lies beside
    it.

    corner: (row, column) of the window's first pixel; size: (height, width) px of the whole mask.
    Equals pycocotools' encoding of the whole mask.
    """
    (height, width), (top, left) = size, corner
    rows = window.shape[0]
    columns = np.zeros(
        (window.shape[1], rows + 2), np.bool_
    )  # a pixel more at both ends, so that no run leaves it
    columns[:, 1:-1] = window.T
    pixels = columns.ravel()
    column, row = np.divmod(np.flatnonzero(pixels[1:] != pixels[:-1]) + 1, rows + 2)
    ends = (left + column) * height + top + row - 1  # where runs begin and end, by turns
    goes_on = np.flatnonzero(
        ends[1:-1:2] == ends[2::2]
    )  # from the last pixel of a column to the first of the next
    ends = np.delete(ends, np.concatenate([2 * goes_on + 1, 2 * goes_on + 2]))
    counts = np.diff(np.concatenate([[0], ends, [height * width]])).tolist()
    if not counts[-1]:
        counts.pop()
    encoded = rle.frPyObjects({"size": [height, width], "counts": counts}, height, width)
    return {"size": [height, width], "counts": encoded["counts"].decode()}


def window_boundary(window: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Boundary IoU's band [h, w] of a mask of which only a window is known: the mask less what is
    left of it eroded.

    size: (height, width) px of the whole mask, whose diagonal tells the band's width. The image's
    edge is contour too.
    """
    if not window.size:
        return window
    eroded = cv2.erode(
        window.view(np.uint8),
        _STEP,
        iterations=band_of(*size),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return np.asarray(window & ~eroded.view(np.bool_))


def boundary_rle(segmentation: Any, size: tuple[int, int]) -> dict[str, Any]:
    """The compressed RLE of the boundary of polygons, in px, or of a compressed RLE. size: (height,
    width) px.
    """
    shape = to_rle(segmentation, size)
    left, top, width, height = (int(v) for v in rle.toBbox(shape))
    window = rle.decode(shape)[top : top + height, left : left + width]
    return window_rle(
        window_boundary(np.ascontiguousarray(window, np.bool_), size), (top, left), size
    )
