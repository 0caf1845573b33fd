"""Correction of keypoints for a rolling shutter."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from plane_world import CAMERA, features_at

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.rolling_shutter import undo_rolling_shutter
from cohdc_train.slam.geometry.se3 import Array, exp_se3, to_local

ROLLING = replace(CAMERA, readout_s=0.02)
speeds = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6)


def rolling_shutter_features(points: Array, twist: Array) -> Features:
    """Measure points with a rolling shutter, each at the time when its own row is read."""
    delay_s = np.zeros(len(points))
    for _ in range(20):  # the row depends on the time, and the time on the row
        local = np.concatenate(
            [
                to_local(exp_se3(twist * t), point[None])
                for t, point in zip(delay_s, points, strict=True)
            ]
        )
        pixels = CAMERA.project(local)
        delay_s = ROLLING.readout_s * (pixels[:, 1] / CAMERA.height - 0.5)
    return features_at(pixels, local[:, 2])


@given(speeds)
def test_corrected_keypoints_equal_those_of_a_global_shutter(speed: list[float]) -> None:
    points = np.random.default_rng(0).uniform([-0.8, -0.6, 1.5], [0.8, 0.6, 3.0], (30, 3))
    twist = np.array(speed)
    measured = rolling_shutter_features(points, twist)
    result = undo_rolling_shutter(measured, ROLLING, twist)
    np.testing.assert_allclose(result.undistorted, CAMERA.project(points), atol=0.03)
    np.testing.assert_allclose(result.depths, points[:, 2], atol=3e-4)
    np.testing.assert_array_equal(
        undo_rolling_shutter(measured, CAMERA, twist).undistorted, measured.undistorted
    )


def test_keypoint_without_depth_moves_as_at_median_depth() -> None:
    points = np.random.default_rng(1).uniform([-0.8, -0.6, 1.9], [0.8, 0.6, 2.1], (30, 3))
    twist = np.array([0.5, 0.3, 0.0, 0.1, 0.6, 0.2])
    measured = rolling_shutter_features(points, twist)
    partly_without_depth = replace(
        measured, depths=np.where(np.arange(30) % 3 == 0, np.nan, measured.depths)
    )
    result = undo_rolling_shutter(partly_without_depth, ROLLING, twist)
    assert np.isnan(result.depths).sum() == 10
    np.testing.assert_allclose(result.undistorted, CAMERA.project(points), atol=0.1)
    without_depth = replace(measured, depths=np.full(30, np.nan))
    np.testing.assert_array_equal(
        undo_rolling_shutter(without_depth, ROLLING, twist).undistorted, measured.undistorted
    )
