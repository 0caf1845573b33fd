"""Trajectory smoothing against dense least squares and on known paths."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plane_world import CAMERA, camera_path, render, room, slam_config, track

from cohdc_train.slam.config import MotionModelConfig, SmoothingConfig
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3
from cohdc_train.slam.optimization.reprojection import Prior
from cohdc_train.slam.optimization.trajectory_smoothing import TrackedPoses, smooth_trajectory
from cohdc_train.slam.system import Slam

MOTION = MotionModelConfig()
ACCELERATION = np.repeat(MOTION.acceleration_sigma, 3)


def noisy(
    seed: int, frames: int, sigma: float, pace: float = 0.25
) -> tuple[Array, Array, Array, Array]:
    """Return timestamps, true T_cw, measured T_cw, and their information.

    sigma: noise of the measured poses, m and rad per axis; pace: speed of the handheld camera,
    whose acceleration is 0.2 m/s^2 at 0.25 and 2.5 m/s^2 at 1.
    """
    rng = np.random.default_rng(seed)
    truth = inverse(np.concatenate([camera_path(1, later=pace * k) for k in range(frames)]))
    measured = exp_se3(rng.normal(0, sigma, (frames, 6))) @ truth
    return np.arange(frames) / 30, truth, measured, np.tile(np.eye(6) / sigma**2, (frames, 1, 1))


def smoothed_without_prior(stamps: Array, poses: Array, information: Array) -> Array:
    """Smooth poses that no motion prior has affected."""
    return smoothed(stamps, poses, information, np.zeros((len(poses), 6)))


def smoothed(stamps: Array, poses: Array, information: Array, gradients: Array) -> Array:
    """Smooth poses with the default options."""
    tracked = TrackedPoses(stamps, poses, information, gradients)
    return smooth_trajectory(tracked, SmoothingConfig(), MOTION)


def position_error(poses: Array, truth: Array) -> float:
    """Return the RMS error of the camera positions, m."""
    return float(np.sqrt(((inverse(poses) - inverse(truth))[:, :3, 3] ** 2).sum(axis=1).mean()))


@given(st.integers(0, 10_000), st.floats(0.002, 0.02))
def test_smoothing_reduces_noise(seed: int, sigma: float) -> None:
    stamps, truth, measured, information = noisy(seed, 60, sigma)
    assert position_error(
        smoothed_without_prior(stamps, measured, information), truth
    ) < 0.8 * position_error(measured, truth)


@given(st.integers(0, 10_000), st.floats(0.001, 0.01), st.floats(1.0, 2.0))
def test_smoothing_improves_shaken_camera(seed: int, sigma: float, pace: float) -> None:
    stamps, truth, measured, information = noisy(seed, 90, sigma, pace)
    assert position_error(
        smoothed_without_prior(stamps, measured, information), truth
    ) < position_error(measured, truth)


@given(st.integers(0, 10_000))
def test_smoothing_equals_dense_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 8
    stamps, _, measured, _ = noisy(seed, n, 0.002)
    stamps = stamps + rng.uniform(0, 0.02, n)
    roots = rng.normal(0, 300, (n, 6, 6))
    information = roots @ roots.transpose(0, 2, 1) + 1e4 * np.eye(6)
    rows, right = [], []
    for frame in range(n):
        information_with_floor = np.linalg.inv(np.linalg.inv(information[frame]) + 4e-6 * np.eye(6))
        row = np.zeros((6, n, 6))
        row[:, frame] = np.linalg.cholesky(information_with_floor).T
        rows.append(row)
        right.append(np.zeros(6))
    for i in range(1, n - 1):
        a, b = stamps[i] - stamps[i - 1], stamps[i + 1] - stamps[i]
        deviation = ACCELERATION * (a + b) / 2
        row = np.zeros((6, n, 6))
        for frame, coefficient in ((i - 1, 1 / a), (i, -1 / a - 1 / b), (i + 1, 1 / b)):
            row[:, frame] = np.diag(coefficient / deviation)
        ahead, behind = (log_se3(measured[k + 1] @ inverse(measured[k])) for k in (i, i - 1))
        rows.append(row)
        right.append(-(ahead / b - behind / a) / deviation)
    corrections = np.linalg.lstsq(
        np.concatenate(rows).reshape(-1, 6 * n), np.concatenate(right), rcond=None
    )[0]
    expected = exp_se3(corrections.reshape(n, 6)) @ measured
    # One iteration, in which all changes have the same weight, with the stated information.
    config = SmoothingConfig(iterations=1, min_variance_ratio=1.0)
    tracked = TrackedPoses(stamps, measured, information, np.zeros((n, 6)))
    np.testing.assert_allclose(smooth_trajectory(tracked, config, MOTION), expected, atol=1e-7)


def test_jump_is_smoothed_only_locally() -> None:
    """The camera jumps by 1 cm from one frame to the next, at 9 m/s^2."""
    stamps, truth, _, information = noisy(0, 60, 3e-4)
    truth[30:, 0, 3] += 0.01
    error = np.abs(smoothed_without_prior(stamps, truth, information) - truth)[:, :3, 3].max(axis=1)
    assert error.max() < 0.005
    assert error[:24].max() < 0.001
    assert error[36:].max() < 0.001


@given(st.integers(0, 10_000), st.floats(3.0, 20.0), st.floats(1.0, 2.0))
def test_understated_information_is_corrected(seed: int, factor: float, pace: float) -> None:
    """The motion of a shaken camera is not smoothed away."""
    stamps, truth, measured, information = noisy(seed, 90, 0.003, pace)
    assert position_error(
        smoothed_without_prior(stamps, measured, information / factor**2), truth
    ) < position_error(measured, truth)


def test_motion_prior_is_removed_before_smoothing() -> None:
    """A pose half way to its prediction counts as the measured pose."""
    stamps, _, measured, information = noisy(4, 30, 0.005)
    predicted = exp_se3(np.array([0.004, -0.002, 0.001, 0.0, 0.0, 0.0])) @ measured[15]
    prior = Prior(predicted, information[15])
    fused, gradients = measured.copy(), np.zeros((30, 6))
    fused[15] = exp_se3(0.5 * log_se3(predicted @ inverse(measured[15]))) @ measured[15]
    gradients[15] = prior.gradient(fused[15])
    expected_poses = smoothed_without_prior(stamps, measured, information)
    remaining = np.abs(smoothed(stamps, fused, information, gradients) - expected_poses).max()
    assert remaining < 3e-4
    assert (
        np.abs(smoothed_without_prior(stamps, fused, information) - expected_poses).max()
        > 3 * remaining
    )


def test_smoothing_is_independent_of_world_frame() -> None:
    stamps, _, measured, information = noisy(1, 30, 0.005)
    world = exp_se3(np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6]))
    once = smoothed_without_prior(stamps, measured, information)
    np.testing.assert_allclose(
        smoothed_without_prior(stamps, measured @ world, information), once @ world, atol=1e-9
    )


def test_frames_before_and_after_gap_are_smoothed_separately() -> None:
    stamps, _, measured, information = noisy(2, 40, 0.005)
    stamps[20:] += 1.0
    apart = [
        smoothed_without_prior(stamps[part], measured[part], information[part])
        for part in (slice(0, 20), slice(20, 40))
    ]
    np.testing.assert_allclose(
        smoothed_without_prior(stamps, measured, information), np.concatenate(apart), atol=1e-12
    )


def test_noise_is_estimated_separately_before_and_after_gap() -> None:
    stamps, _, measured, information = noisy(2, 40, 0.005)
    measured[:20] = noisy(5, 20, 0.03)[2]
    stamps[20:] += 1.0
    np.testing.assert_allclose(
        smoothed_without_prior(stamps, measured, information)[20:],
        smoothed_without_prior(stamps[20:], measured[20:], information[20:]),
        atol=1e-12,
    )


@pytest.mark.parametrize("step", [0.0011, 0.033, 0.2])
def test_frames_without_information_give_finite_poses(step: float) -> None:
    _, _, measured, information = noisy(6, 60, 0.005)
    smoothed_poses = smoothed_without_prior(step * np.arange(60), measured, 0 * information)
    assert np.isfinite(smoothed_poses).all()


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_fewer_than_three_frames_stay_unchanged(frames: int) -> None:
    stamps, _, measured, information = noisy(3, 3, 0.01)
    kept = slice(0, frames)
    np.testing.assert_array_equal(
        smoothed_without_prior(stamps[kept], measured[kept], information[kept]), measured[kept]
    )


def test_smoothing_changes_final_trajectory_but_not_live_poses() -> None:
    """The poses returned while tracking are the same with and without smoothing."""
    path = camera_path(20)
    views = [render(room(), pose)[:2] for pose in path]
    trajectories, live = [], []
    for smooths in (True, False):
        slam = Slam(CAMERA, slam_config(300, smoothing__enabled=smooths))
        live.append([track(slam, *view, k / 30).T_wc for k, view in enumerate(views)])
        trajectories.append(slam.trajectory().poses)
    np.testing.assert_array_equal(live[0], live[1])
    assert 1e-5 < np.abs(trajectories[0] - trajectories[1]).max() < 0.02
    true = inverse(path)
    assert position_error(inverse(trajectories[0]), true) < position_error(
        inverse(trajectories[1]), true
    )
