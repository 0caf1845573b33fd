"""Correction of a rolling shutter, which reads an image row by row while the camera moves."""

from dataclasses import replace

import numpy as np

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array


def undo_rolling_shutter(features: Features, camera: Camera, twist: Array) -> Features:
    """Move keypoints to where a global shutter halfway through the readout would measure them.

    Keypoints without depth move as if at the median depth of the others.

    Args:
        features: keypoints as measured.
        camera: intrinsics, and the readout time, s.
        twist: [6] velocity of the world in the camera frame, (m/s, rad/s); a point X moves by
            v + omega x X.
    """
    depths = features.depths
    if camera.readout_s == 0 or np.isnan(depths).all():
        return features
    # Time at which each keypoint's row is read, s after the middle row.
    delay_s = camera.readout_s * (features.pixels[:, 1] / camera.height - 0.5)
    assumed_depths = np.where(np.isnan(depths), np.nanmedian(depths), depths)
    local = camera.backproject(features.undistorted, assumed_depths)
    local -= delay_s[:, None] * (twist[:3] + np.cross(twist[3:], local))
    return replace(
        features,
        undistorted=camera.project(local),
        depths=np.where(np.isnan(depths), np.nan, local[:, 2]),
    )
