"""Image of a map seen from above."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.visualization.point_cloud import PointCloud

_SIDE = 900  # px of the image's longer side
_BORDER = 20  # px
_MAX_ABOVE_CAMERA_M = 0.4  # higher points are skipped: a ceiling would hide the room
_MIN_EXTENT_M = 0.1
_SHOWN_QUANTILES = (0.005, 0.995)  # outliers beyond them may fall outside the image
_RED = (230, 40, 40)  # RGB


def render_top_view(cloud: PointCloud, poses: Sequence[Array]) -> NDArray[np.uint8]:
    """Draw a cloud from above, with the trajectory in red.

    Up is the mean direction of the cameras' upper edges; the first camera looks to the top of the
    image.

    Args:
        cloud: points of the map.
        poses: T_wc [4, 4] m, at least one.

    Returns:
        [H, W, 3] uint8 RGB.
    """
    T_wc = np.stack(poses)
    up, axes = _view_axes(T_wc)
    height = cloud.points @ up
    is_shown = height < (T_wc[:, :3, 3] @ up).max() + _MAX_ABOVE_CAMERA_M
    order = np.argsort(height[is_shown], kind="stable")  # higher points are drawn later
    points = cloud.points[is_shown][order] @ axes
    colors = cloud.colors[is_shown][order]
    path = T_wc[:, :3, 3] @ axes

    low, high = np.quantile(np.concatenate([points, path]), _SHOWN_QUANTILES, axis=0)
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    extent = max(float((high - low).max()), _MIN_EXTENT_M)
    scale = (_SIDE - 2 * _BORDER) / extent
    width, rows = (np.ceil((high - low) * scale).astype(int) + 2 * _BORDER).tolist()
    image = np.full((rows, width, 3), 255, dtype=np.uint8)

    _draw_points(image, np.rint((points - low) * scale + _BORDER).astype(np.int64), colors)
    line = np.rint((path - low) * scale + _BORDER).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [line], False, _RED, 2, cv2.LINE_AA)
    return image


def _view_axes(T_wc: Array) -> tuple[Array, Array]:
    """Return the direction up [3], and the image's axes to the right and down [3, 2]."""
    up = -T_wc[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forward = T_wc[0, :3, 2] - up * (T_wc[0, :3, 2] @ up)
    forward /= np.linalg.norm(forward) + 1e-12
    return up, np.stack([np.cross(forward, up), -forward], axis=1)


def _draw_points(
    image: NDArray[np.uint8], pixels: NDArray[np.int64], colors: NDArray[np.uint8]
) -> None:
    """Draw points as squares whose size depends on how many there are."""
    rows, width = image.shape[:2]
    radius = int(np.clip(np.sqrt(rows * width / (len(pixels) + 1)) / 2, 1, 3))
    columns, lines = pixels.T
    for dx in range(-radius, radius + 1):
        for dy in range(-radius, radius + 1):
            x, y = columns + dx, lines + dy
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < rows)
            image[y[inside], x[inside]] = colors[inside]
