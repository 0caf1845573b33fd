"""The points of the map with their colours, and the picture of a map from above."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.io.results import FrameRecord
from cohdc_train.slam.io.sources import View
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.pose import Array
from cohdc_train.slam.tracking.tracker import Tracker

_SEEN_BY = 3  # keyframes that confirm a point
_SIDE = 900  # px of the picture's longer side
_BORDER = 20  # px
_ABOVE = 0.4  # m above the cameras from which on things are left out: a ceiling would hide the room
_RED = (230, 40, 40)  # RGB


@dataclass(frozen=True)
class Cloud:
    """points: [n, 3] in the world, m; colours: [n, 3] uint8 RGB."""

    points: Array
    colours: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


class PointColours:
    """Watches a run and keeps the colours of the map's keyframes' corners (some 3 kB each), for the points they are."""

    def __init__(self) -> None:
        self._colours: dict[float, NDArray[np.uint8]] = {}  # t of a keyframe -> [corners, 3] RGB

    def __call__(self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker) -> None:
        """Note the colours when the frame became a keyframe, and forget those of keyframes that left the map."""
        if record.pose.keyframe and tracker.features is not None:
            columns, rows = np.rint(tracker.features.pixels).astype(np.int64).T
            self._colours[view.t] = view.rgb[rows, columns]
            there = {keyframe.t for keyframe in tracker.map.keyframes}
            self._colours = {t: colours for t, colours in self._colours.items() if t in there}

    def cloud(self, world: Map) -> Cloud:
        """The points that at least three keyframes see (all of them, in a map of fewer), in the last one's colours."""
        colours = np.zeros((world.size, 3), dtype=np.uint8)
        for keyframe in world.keyframes:
            corners = np.flatnonzero(keyframe.point_ids >= 0)
            colours[keyframe.point_ids[corners]] = self._colours[keyframe.t][corners]
        enough = world.seen_by[: world.size] >= max(1, min(_SEEN_BY, len(world.keyframes)))
        return Cloud(world.positions[: world.size][enough], colours[enough])


def from_above(cloud: Cloud, poses: Sequence[Array]) -> NDArray[np.uint8]:
    """A map as seen from above, the way of the camera in red.

    poses: T_wc [4, 4] m, at least one. Up is where the cameras' upper edges point on average; the first camera looks
    to the top of the picture. Returns [H, W, 3] uint8 RGB.
    """
    stack = np.stack(poses)
    up = -stack[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forward = stack[0, :3, 2] - up * (stack[0, :3, 2] @ up)
    forward /= np.linalg.norm(forward) + 1e-12
    axes = np.stack([np.cross(forward, up), -forward], axis=1)  # [3, 2] to the right, and down in the picture
    height = cloud.points @ up
    keep = height < (stack[:, :3, 3] @ up).max() + _ABOVE
    points, colours = cloud.points[keep], cloud.colours[keep]
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
            image[y[inside], x[inside]] = colours[order][inside]
    path = np.rint((way - low) * scale + _BORDER).astype(np.int32)
    cv2.polylines(image, [path.reshape(-1, 1, 2)], False, _RED, 2, cv2.LINE_AA)
    return image
