"""Estimated pose of a frame, and the keypoints that it is based on."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.patch_alignment import Pyramid
from cohdc_train.slam.frame import PoseSource
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.optimization.reprojection import Prior


@dataclass(frozen=True)
class FrameFeatures:
    """Keypoints of a frame, and the mask they were extracted with.

    dynamic_mask: [H, W] bool, where no keypoint was used, None where nothing is dynamic; pyramid:
    of the frame's image, None where the keypoints come from optical flow or are not refined.
    """

    features: Features
    dynamic_mask: NDArray[np.bool_] | None
    pyramid: Pyramid | None = None


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of a frame, with the matches and the prior that it is based on.

    T_cw: [4, 4] world to camera, m; matches: map points that the frame observes; num_inliers:
    matches that agree with the pose; reference: the keyframe that observes most of them, None for a
    rough pose; prior: the prediction, where it counted as well; information: [6, 6] inverse
    covariance of the pose by the measurements alone, in the camera frame, 0 until the pose is
    final; source: the map or optical flow; allows_keyframe: whether the frame may become a
    keyframe.
    """

    T_cw: Array
    matches: Matches
    frame_features: FrameFeatures
    num_inliers: int = 0
    reference: Keyframe | None = None
    prior: Prior | None = None
    information: Array = field(default_factory=lambda: np.zeros((6, 6)))
    source: PoseSource = "map"
    allows_keyframe: bool = True

    @property
    def features(self) -> Features:
        """Return the keypoints of the frame."""
        return self.frame_features.features

    @property
    def prior_gradient(self) -> Array:
        """Return the gradient [6] of the prior at the pose, 0 where it did not count."""
        return np.zeros(6) if self.prior is None else self.prior.gradient(self.T_cw)
