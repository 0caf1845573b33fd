"""Dynamic masks and their dilation."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.types import Mask


def dilate_mask(mask: Mask, radius: float) -> Mask:
    """Set all pixels within `radius` px of a True pixel.

    Args:
        mask: [H, W] bool.
        radius: px, Euclidean; at 0 and below the mask itself is returned.

    Returns:
        [H, W] bool.
    """
    if radius <= 0 or not mask.any():
        return mask
    # The distance transform costs most, so it runs on the mask's bounding box only.
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    window = (_with_margin(rows, radius), _with_margin(columns, radius))
    outside = (~mask[window]).astype(np.uint8)
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_5)
    dilated = np.zeros_like(mask)
    dilated[window] = distance <= radius
    return dilated


def _with_margin(indices: NDArray[np.int64], radius: float) -> slice:
    """Return the range of rising indices, extended by the radius on both sides."""
    margin = int(np.ceil(radius))
    return slice(max(int(indices[0]) - margin, 0), int(indices[-1]) + margin + 1)
