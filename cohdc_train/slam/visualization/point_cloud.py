"""Colored point clouds, and the colors of map points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import DenseCloudConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.map import Map


@dataclass(frozen=True)
class PointCloud:
    """Colored points.

    Attributes:
        points: [n, 3] in the world, m.
        colors: [n, 3] uint8 RGB.
    """

    points: Array
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)


class PointColorRecorder:
    """Observer of a run that records the color of each keypoint of the keyframes (3 kB each)."""

    def __init__(self, config: DenseCloudConfig = DenseCloudConfig()) -> None:
        """Start without colors. config: which points `cloud` returns."""
        self._min_observations = config.min_observations
        self._colors: dict[float, NDArray[np.uint8]] = {}  # timestamp -> [keypoints, 3] RGB

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Record the colors of a new keyframe, and forget keyframes that left the map."""
        if result.is_keyframe and result.features is not None:
            columns, rows = np.rint(result.features.pixels).astype(np.int64).T
            self._colors[frame.timestamp] = frame.rgb[rows, columns]
            in_map = {keyframe.timestamp for keyframe in point_map.keyframes}
            self._colors = {t: colors for t, colors in self._colors.items() if t in in_map}

    def cloud(self, point_map: Map) -> PointCloud:
        """Return the map points that enough keyframes observe, with the color in the last one.

        In a map of fewer keyframes all of these must observe a point.
        """
        size = point_map.size
        colors = np.zeros((size, 3), dtype=np.uint8)
        for keyframe in point_map.keyframes:
            keypoints = np.flatnonzero(keyframe.point_ids >= 0)
            colors[keyframe.point_ids[keypoints]] = self._colors[keyframe.timestamp][keypoints]
        needed = max(1, min(self._min_observations, len(point_map.keyframes)))
        is_confirmed = point_map.num_observations[:size] >= needed
        return PointCloud(point_map.positions[:size][is_confirmed], colors[is_confirmed])
