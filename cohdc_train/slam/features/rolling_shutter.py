"""Correction of a rolling shutter, which reads an image row by row while the camera moves."""

from dataclasses import replace

import numpy as np

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array


def undo_rolling_shutter(features: Features, camera: Camera, twist: Array) -> Features:
    """Return keypoints as a global shutter halfway through the readout would have measured them.

    twist: [6] velocity of the world in the camera's frame, (m/s, rad/s), a point moves by v + omega
    x X. Keypoints without depth move as if at the median depth of the others.
    """
    depths = features.depths
    if camera.readout_s == 0 or np.isnan(depths).all():
        return features
    late = camera.readout_s * (
        features.pixels[:, 1] / camera.height - 0.5
    )  # s after the middle row
    known = np.where(np.isnan(depths), np.nanmedian(depths), depths)
    local = camera.backproject(features.undistorted, known)
    local -= late[:, None] * (twist[:3] + np.cross(twist[3:], local))
    return replace(
        features,
        undistorted=camera.project(local),
        depths=np.where(np.isnan(depths), np.nan, local[:, 2]),
    )
