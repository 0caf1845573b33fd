"""Depth of keypoints from a depth image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FeatureConfig


def sample_depth(
    depth: NDArray[np.float32],
    pixels: NDArray[np.float64],
    config: FeatureConfig,
    mask: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Read the depth at keypoints, except near depth edges and near the dynamic mask.

    A sensor mixes near and far surfaces there.

    Args:
        depth: [H, W] m, 0 = no reading.
        pixels: [n, 2] px, distorted.
        config: size of the patch, largest depth step, and margin of the mask.
        mask: [H, W] bool, True = dynamic.

    Returns:
        [n] depth, m; nan where it is refused.
    """
    if len(pixels) == 0:
        return np.zeros(0)
    height, width = depth.shape
    radius = config.depth_patch_radius_px
    offsets = np.arange(-radius, radius + 1)
    x, y = np.rint(pixels).astype(np.int64).T
    columns = np.clip(x + offsets[:, None], 0, width - 1)
    rows = np.clip(y + offsets[:, None], 0, height - 1)
    patch = depth.ravel().take(
        (rows[:, None] * width + columns).reshape(-1, len(pixels))
    )  # [pixels of the patch, n]
    center = patch[len(patch) // 2].astype(np.float64)
    far = patch.max(axis=0).astype(np.float64)
    near = np.where(patch > 0, patch, np.float32(np.inf)).min(axis=0).astype(np.float64)
    refused = (center <= 0) | (far - near > config.max_depth_step_ratio * center)
    if mask is not None:
        side = 2 * config.mask_margin_px + 1
        band = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), dtype=np.uint8))
        refused |= band[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] > 0
    return np.where(refused, np.nan, center)
