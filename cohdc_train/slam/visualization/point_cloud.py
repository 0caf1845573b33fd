"""The points of the map with their colours, and the picture of a map from above."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.map import Map

_SEEN_BY = 3  # keyframes that confirm a point


@dataclass(frozen=True)
class PointCloud:
    """points: [n, 3] in the world, m; colours: [n, 3] uint8 RGB."""

    points: Array
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


class PointColorRecorder:
    """Watches a run and keeps the colours of the map's keyframes' corners (some 3 kB each), for the
    points they are.
    """

    def __init__(self) -> None:
        self._colors: dict[float, NDArray[np.uint8]] = {}  # t of a keyframe -> [corners, 3] RGB

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Note the colours when the frame became a keyframe, and forget those of keyframes that
        left the map.
        """
        if result.is_keyframe and result.features is not None:
            columns, rows = np.rint(result.features.pixels).astype(np.int64).T
            self._colors[frame.timestamp] = frame.rgb[rows, columns]
            there = {keyframe.t for keyframe in point_map.keyframes}
            self._colors = {t: colors for t, colors in self._colors.items() if t in there}

    def cloud(self, world: Map) -> PointCloud:
        """The points that at least three keyframes see (all of them, in a map of fewer), in the
        last one's colours.
        """
        colors = np.zeros((world.size, 3), dtype=np.uint8)
        for keyframe in world.keyframes:
            keypoints = np.flatnonzero(keyframe.point_ids >= 0)
            colors[keyframe.point_ids[keypoints]] = self._colors[keyframe.t][keypoints]
        enough = world.num_observations[: world.size] >= max(1, min(_SEEN_BY, len(world.keyframes)))
        return PointCloud(world.positions[: world.size][enough], colors[enough])
