"""Measurement of keypoints, corrected to the timestamp of their frame."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features, Keypoints
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.features.rolling_shutter import undo_rolling_shutter
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.tracking.motion_model import MotionModel


class FrameMeasurer:
    """Undistorted positions and depths of keypoints, corrected for the camera motion.

    The depth image may be taken later than the color image, and a rolling shutter reads the rows
    one after the other.
    """

    def __init__(self, extractor: OrbExtractor, motion: MotionModel) -> None:
        self._extractor = extractor
        self._motion = motion

    def measure(
        self, keypoints: Keypoints, frame: RGBDFrame, mask: NDArray[np.bool_] | None
    ) -> Features:
        """Measure the keypoints of a frame; depth is refused near the mask [H, W] bool."""
        twist = self._motion.twist
        T_depth_color = None
        if twist is not None and frame.depth_timestamp is not None:
            T_depth_color = exp_se3(twist * (frame.depth_timestamp - frame.timestamp))
        features = self._extractor.measure(keypoints, frame.depth, mask, T_depth_color)
        if twist is None:
            return features
        return undo_rolling_shutter(features, self._extractor.camera, twist)
