"""Run lengths of masks and of their boundaries, from the small window that holds the mask."""

from typing import Any

import cv2
import numpy as np
from faster_coco_eval.core import mask as rle
from numpy.typing import NDArray

from cohdc_train.models.cqe_targets import boundary_band_px

_STEP = np.ones((3, 3), np.uint8)


def to_rle(segmentation: Any, size: tuple[int, int]) -> Any:
    """Encode polygons, px, as compressed RLE; a compressed RLE stays as it is.

    size: (height, width) px.
    """
    if isinstance(segmentation, dict):
        return segmentation
    return rle.merge(rle.frPyObjects(segmentation, *size))


def window_rle(
    window: NDArray[np.bool_], corner: tuple[int, int], size: tuple[int, int]
) -> dict[str, Any]:
    """Encode a mask that is known inside a window and empty outside of it, as compressed RLE.

    The result equals pycocotools' encoding of the whole mask.

    Args:
        window: [h, w] the mask inside the window.
        corner: (row, column) of the window's first pixel.
        size: (height, width) px of the whole mask.
    """
    (height, width), (top, left) = size, corner
    rows = window.shape[0]

    # One empty pixel at both ends of each column, so that no run crosses columns.
    columns = np.zeros((window.shape[1], rows + 2), np.bool_)
    columns[:, 1:-1] = window.T
    pixels = columns.ravel()
    column, row = np.divmod(np.flatnonzero(pixels[1:] != pixels[:-1]) + 1, rows + 2)
    ends = (left + column) * height + top + row - 1  # run starts and run ends, alternating

    # Join runs that continue from the last pixel of a column to the first of the next.
    continues = np.flatnonzero(ends[1:-1:2] == ends[2::2])
    ends = np.delete(ends, np.concatenate([2 * continues + 1, 2 * continues + 2]))
    counts = np.diff(np.concatenate([[0], ends, [height * width]])).tolist()
    if not counts[-1]:
        counts.pop()
    encoded = rle.frPyObjects({"size": [height, width], "counts": counts}, height, width)
    return {"size": [height, width], "counts": encoded["counts"].decode()}


def window_boundary(window: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Compute Boundary IoU's band of a mask that is known inside a window.

    The band is the mask without its erosion; the image's edge is a contour too.

    Args:
        window: [h, w] the mask inside the window.
        size: (height, width) px of the whole mask, whose diagonal determines the band's width.

    Returns:
        [h, w] bool.
    """
    if not window.size:
        return window
    eroded = cv2.erode(
        window.view(np.uint8),
        _STEP,
        iterations=boundary_band_px(*size),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return np.asarray(window & ~eroded.view(np.bool_))


def boundary_rle(segmentation: Any, size: tuple[int, int]) -> dict[str, Any]:
    """Encode the boundary band of polygons, px, or of a compressed RLE, as compressed RLE.

    size: (height, width) px.
    """
    shape = to_rle(segmentation, size)
    left, top, width, height = (int(v) for v in rle.toBbox(shape))
    window = rle.decode(shape)[top : top + height, left : left + width]
    band = window_boundary(np.ascontiguousarray(window, np.bool_), size)
    return window_rle(band, (top, left), size)
