"""Dynamic masks and their dilation."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.types import Mask


def grow(mask: Mask, radius: float) -> Mask:
    """[H, W] bool, True within `radius` px of a True pixel of `mask`."""
    if radius <= 0 or not mask.any():
        return mask
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    window = (_reach(rows, radius), _reach(columns, radius))
    distance = cv2.distanceTransform((~mask[window]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    grown = np.zeros_like(mask)
    grown[window] = distance <= radius
    return grown


def _reach(places: NDArray[np.int64], radius: float) -> slice:
    """From the first of rising places to the last, with `radius` more on both sides."""
    margin = int(np.ceil(radius))
    return slice(max(int(places[0]) - margin, 0), int(places[-1]) + margin + 1)
