"""Depth of keypoints from a depth image."""

import cv2
import numpy as np
from numpy.typing import NDArray

_EDGE_PATCH = 2  # px: a depth edge this near to a corner spoils its depth
_EDGE_RELATIVE = 0.04  # of the depth: a larger step inside the patch is an edge


def sample_depth(
    depth: NDArray[np.float32], pixels: NDArray[np.float64], mask: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Depth at corners, refused beside depth edges and beside the mask, where a sensor mixes near
    and far.

    depth: [H, W] m, 0 = none; pixels: [n, 2] px; mask: [H, W], True = dynamic. Returns [n] m, nan
    where refused.
    """
    if len(pixels) == 0:
        return np.zeros(0)
    height, width = depth.shape
    offsets = np.arange(-_EDGE_PATCH, _EDGE_PATCH + 1)
    x, y = np.rint(pixels).astype(np.int64).T
    columns = np.clip(x + offsets[:, None], 0, width - 1)
    rows = np.clip(y + offsets[:, None], 0, height - 1)
    patch = depth.ravel().take(
        (rows[:, None] * width + columns).reshape(-1, len(pixels))
    )  # [25, n]
    center = patch[len(patch) // 2].astype(np.float64)
    far = patch.max(axis=0).astype(np.float64)
    near = np.where(patch > 0, patch, np.float32(np.inf)).min(axis=0).astype(np.float64)
    refused = (center <= 0) | (far - near > _EDGE_RELATIVE * center)
    if mask is not None:
        reach = np.ones((2 * _MASK_BAND + 1, 2 * _MASK_BAND + 1), dtype=np.uint8)
        band = cv2.dilate(mask.astype(np.uint8), reach)
        refused |= band[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] > 0
    return np.where(refused, np.nan, center)


_MASK_BAND = 2  # px beside the mask where depth is refused
