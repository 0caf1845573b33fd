"""Map seen from above."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.visualization.point_cloud import PointCloud

_SIDE = 900  # px of the picture's longer side
_BORDER = 20  # px
_ABOVE = 0.4  # m above the cameras from which on things are left out: a ceiling would hide the room
_RED = (230, 40, 40)  # RGB


def render_top_view(cloud: PointCloud, poses: Sequence[Array]) -> NDArray[np.uint8]:
    """A map as seen from above, the way of the camera in red.

    poses: T_wc [4, 4] m, at least one. Up is where the cameras' upper edges point on average; the
    first camera looks to the top of the picture. Returns [H, W, 3] uint8 RGB.
    """
    stack = np.stack(poses)
    up = -stack[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forward = stack[0, :3, 2] - up * (stack[0, :3, 2] @ up)
    forward /= np.linalg.norm(forward) + 1e-12
    axes = np.stack(
        [np.cross(forward, up), -forward], axis=1
    )  # [3, 2] to the right, and down in the picture
    height = cloud.points @ up
    keep = height < (stack[:, :3, 3] @ up).max() + _ABOVE
    points, colors = cloud.points[keep], cloud.colors[keep]
    order = np.argsort(height[keep], kind="stable")  # what lies higher is drawn later
    flat, way = points[order] @ axes, stack[:, :3, 3] @ axes
    low, high = np.quantile(np.concatenate([flat, way]), [0.005, 0.995], axis=0)
    low, high = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
    scale = (_SIDE - 2 * _BORDER) / max(float((high - low).max()), 0.1)
    width, rows = (np.ceil((high - low) * scale).astype(int) + 2 * _BORDER).tolist()
    image = np.full((rows, width, 3), 255, dtype=np.uint8)
    radius = int(np.clip(np.sqrt(rows * width / (len(points) + 1)) / 2, 1, 3))
    columns, lines = np.rint((flat - low) * scale + _BORDER).astype(np.int64).T
    for dx in range(-radius, radius + 1):
        for dy in range(-radius, radius + 1):
            x, y = columns + dx, lines + dy
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < rows)
            image[y[inside], x[inside]] = colors[order][inside]
    path = np.rint((way - low) * scale + _BORDER).astype(np.int32)
    cv2.polylines(image, [path.reshape(-1, 1, 2)], False, _RED, 2, cv2.LINE_AA)
    return image
