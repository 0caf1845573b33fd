"""Keyframe with its pose, its features, and the map points that it observes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.optimization.reprojection import Observations


@dataclass(eq=False)
class Keyframe:
    """Frame in the map, with the points that it observes.

    index: unique number; timestamp: s; T_cw: [4, 4] world to camera, m; point_ids: [n] int64, map
    point of each keypoint or -1; thumbnail: [h, w] float32, zero mean and unit norm, for
    relocalization; min_depth_grid: [h, w] m, of FreeSpaceChecker.min_depth_grid.
    """

    index: int
    timestamp: float
    T_cw: Array
    features: Features
    point_ids: NDArray[np.int64]
    thumbnail: NDArray[np.float32]
    min_depth_grid: NDArray[np.float32]

    def observed_point_ids(self) -> NDArray[np.int64]:
        """Return the ids of the points that the keyframe observes."""
        return self.point_ids[self.point_ids >= 0]

    def center(self) -> Array:
        """Return the position [3] of the camera in the world, m."""
        return np.asarray(-self.T_cw[:3, :3].T @ self.T_cw[:3, 3])


def observations_at(features: Features, keypoints: NDArray[np.int64]) -> Observations:
    """Return the measurements of a frame at the chosen keypoints [m]."""
    sigmas, depth_sigmas = features.sigmas[keypoints], features.scales[keypoints]
    return Observations(
        features.undistorted[keypoints], features.depths[keypoints], sigmas, depth_sigmas
    )
