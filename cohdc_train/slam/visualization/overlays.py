"""Keypoints and masks drawn over color images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import draw_outline
from cohdc_train.slam.features.keypoints import Features

_GREEN, _RED, _YELLOW = (60, 220, 60), (230, 40, 40), (255, 220, 0)  # RGB


def draw_before(
    rgb: NDArray[np.uint8], features: Features, mask: NDArray[np.bool_] | None
) -> NDArray[np.uint8]:
    """Draw the keypoints of a search without a mask: red on the mask, green elsewhere.

    Args:
        rgb: [H, W, 3].
        features: keypoints of the whole image.
        mask: [H, W] bool, True = dynamic.

    Returns:
        [H, W, 3] RGB.
    """
    rows = np.rint(features.pixels[:, 1]).astype(int)
    columns = np.rint(features.pixels[:, 0]).astype(int)
    on_mask = np.zeros(len(features), dtype=np.bool_) if mask is None else mask[rows, columns]
    image = rgb.copy()
    for x, y, is_masked in zip(columns.tolist(), rows.tolist(), on_mask.tolist(), strict=True):
        cv2.circle(image, (x, y), 2, _RED if is_masked else _GREEN, 1, cv2.LINE_AA)
    return image


def draw_after(
    rgb: NDArray[np.uint8], features: Features, mask: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Draw the keypoints that were kept, and the outline of the mask. Returns [H, W, 3] RGB."""
    image = draw_before(rgb, features, None)
    draw_outline(image, mask, _YELLOW, thickness=2)
    return image
