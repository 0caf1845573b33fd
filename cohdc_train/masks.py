"""Paste masks of regions of interest (RoIs) into masks of the whole image.

Training's scores, `cohdc predict` and SLAM share this one paste.
"""

import cv2
import numpy as np

from cohdc_train.types import Float32Array, Mask


def paste_roi_mask(
    roi_mask: Float32Array,
    box: Float32Array,
    size: tuple[int, int],
    threshold: float = 0.5,
) -> Mask:
    """Return the mask of the whole image, [height, width] bool, for one RoI mask.

    Arguments are those of `roi_window`.
    """
    mask = np.zeros(size, dtype=np.bool_)
    window, (top, left) = roi_window(roi_mask, box, size, threshold)
    mask[top : top + window.shape[0], left : left + window.shape[1]] = window
    return mask


def roi_window(
    roi_mask: Float32Array,
    box: Float32Array,
    size: tuple[int, int],
    threshold: float = 0.5,
) -> tuple[Mask, tuple[int, int]]:
    """Return the part of the image's mask that lies in the box, and where it begins.

    A pixel's center is mapped into the RoI grid and sampled bilinearly. Pixels whose center lies
    outside the box do not belong to the mask.

    Args:
        roi_mask: [M, M] probability.
        box: [4] xyxy, px.
        size: (height, width) of the image, px.
        threshold: probability above which a pixel belongs to the mask.

    Returns:
        [h, w] bool, and (row, column) of its first pixel in the image.
    """
    height, width = size
    x0, y0, x1, y1 = (float(v) for v in box)
    # pixels whose center lies inside the box
    left, right = max(int(np.ceil(x0 - 0.5)), 0), min(int(np.ceil(x1 - 0.5)), width)
    top, bottom = max(int(np.ceil(y0 - 0.5)), 0), min(int(np.ceil(y1 - 0.5)), height)
    if right <= left or bottom <= top:
        return np.zeros((0, 0), np.bool_), (0, 0)
    side = roi_mask.shape[0]
    u = ((np.arange(left, right) + 0.5 - x0) / (x1 - x0) * side - 0.5).astype(np.float32)
    v = ((np.arange(top, bottom) + 0.5 - y0) / (y1 - y0) * side - 0.5).astype(np.float32)
    map_u, map_v = np.meshgrid(u, v)
    sampled = cv2.remap(roi_mask, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled > threshold, (top, left)
