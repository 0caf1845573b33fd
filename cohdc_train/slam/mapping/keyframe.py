"""Keyframe: a pose, its features, and the map points that it observes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.optimization.reprojection import Observations


@dataclass(eq=False)
class Keyframe:
    """A frame the map keeps.

    index: its number, Map.joined when it joins, not used again; t: s; T_cw: [4, 4] world to camera,
    m; point_ids: [n] int64, the map point of every corner or -1; thumbnail: [h, w] float32, zero
    mean and unit norm, for finding the place again; nearest: [h, w] coarse depth as
    Geometry.nearest gives it, m.
    """

    index: int
    t: float
    T_cw: Array
    features: Features
    point_ids: NDArray[np.int64]
    thumbnail: NDArray[np.float32]
    nearest: NDArray[np.float32]

    def seen_points(self) -> NDArray[np.int64]:
        """Ids of the points this keyframe sees."""
        return self.point_ids[self.point_ids >= 0]

    def center(self) -> Array:
        """[3] position of the camera in the world, m."""
        return np.asarray(-self.T_cw[:3, :3].T @ self.T_cw[:3, 3])


def observations(features: Features, keypoints: NDArray[np.int64]) -> Observations:
    """What a frame measured at some of its corners."""
    sigmas, depth_sigmas = features.sigmas[keypoints], features.scales[keypoints]
    return Observations(
        features.points[keypoints], features.depths[keypoints], sigmas, depth_sigmas
    )
