"""Trajectory smoothing: equal to dense least squares, exact on known paths."""

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
    """stamps, true T_cw, measured T_cw off by sigma m and rad in every direction, and their
    information.

    pace: of the swaying hand; at .25 it speeds up by .2 m/s^2, at 1 by 2.5.
    """
    rng = np.random.default_rng(seed)
    truth = inverse(np.concatenate([camera_path(1, later=pace * k) for k in range(frames)]))
    measured = exp_se3(rng.normal(0, sigma, (frames, 6))) @ truth
    return np.arange(frames) / 30, truth, measured, np.tile(np.eye(6) / sigma**2, (frames, 1, 1))


def alone(stamps: Array, poses: Array, information: Array) -> Array:
    """Smoothed, where nothing was expected of any frame."""
    return smoothed(stamps, poses, information, np.zeros((len(poses), 6)))


def smoothed(stamps: Array, poses: Array, information: Array, gradients: Array) -> Array:
    """Smoothed with the default options."""
    tracked = TrackedPoses(stamps, poses, information, gradients)
    return smooth_trajectory(tracked, SmoothingConfig(), MOTION)


def off(poses: Array, truth: Array) -> float:
    """RMS distance of the camera's places, m."""
    return float(np.sqrt(((inverse(poses) - inverse(truth))[:, :3, 3] ** 2).sum(axis=1).mean()))


@given(st.integers(0, 10_000), st.floats(0.002, 0.02))
def test_noise_falls(seed: int, sigma: float) -> None:
    stamps, truth, measured, information = noisy(seed, 60, sigma)
    assert off(alone(stamps, measured, information), truth) < 0.8 * off(measured, truth)


@given(st.integers(0, 10_000), st.floats(0.001, 0.01), st.floats(1.0, 2.0))
def test_a_shaken_camera_is_not_held_to_be_calm(seed: int, sigma: float, pace: float) -> None:
    stamps, truth, measured, information = noisy(seed, 90, sigma, pace)
    assert off(alone(stamps, measured, information), truth) < off(measured, truth)


@given(st.integers(0, 10_000))
def test_it_is_the_least_squares_of_what_was_seen_and_of_changes_of_velocity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 8
    stamps, _, measured, _ = noisy(seed, n, 0.002)
    stamps = stamps + rng.uniform(0, 0.02, n)
    roots = rng.normal(0, 300, (n, 6, 6))
    information = roots @ roots.transpose(0, 2, 1) + 1e4 * np.eye(6)
    rows, right = [], []
    for frame in range(n):
        known = np.linalg.inv(np.linalg.inv(information[frame]) + 4e-6 * np.eye(6))
        row = np.zeros((6, n, 6))
        row[:, frame] = np.linalg.cholesky(known).T
        rows.append(row)
        right.append(np.zeros(6))
    for i in range(1, n - 1):
        a, b = stamps[i] - stamps[i - 1], stamps[i + 1] - stamps[i]
        deviation = ACCELERATION * (a + b) / 2
        row = np.zeros((6, n, 6))
        for frame, share in ((i - 1, 1 / a), (i, -1 / a - 1 / b), (i + 1, 1 / b)):
            row[:, frame] = np.diag(share / deviation)
        ahead, behind = (log_se3(measured[k + 1] @ inverse(measured[k])) for k in (i, i - 1))
        rows.append(row)
        right.append(-(ahead / b - behind / a) / deviation)
    small = np.linalg.lstsq(
        np.concatenate(rows).reshape(-1, 6 * n), np.concatenate(right), rcond=None
    )[0]
    wanted = exp_se3(small.reshape(n, 6)) @ measured
    # One iteration, in which all changes count alike, and information as the frames state it.
    config = SmoothingConfig(iterations=1, min_variance_ratio=1.0)
    tracked = TrackedPoses(stamps, measured, information, np.zeros((n, 6)))
    np.testing.assert_allclose(smooth_trajectory(tracked, config, MOTION), wanted, atol=1e-7)


def test_a_knock_is_rounded_off_for_a_moment_only() -> None:
    """A centimetre from one frame to the next, 9 m/s^2."""
    stamps, truth, _, information = noisy(0, 60, 3e-4)
    truth[30:, 0, 3] += 0.01
    error = np.abs(alone(stamps, truth, information) - truth)[:, :3, 3].max(axis=1)
    assert error.max() < 0.005
    assert error[:24].max() < 0.001
    assert error[36:].max() < 0.001


@given(st.integers(0, 10_000), st.floats(3.0, 20.0), st.floats(1.0, 2.0))
def test_frames_that_know_more_than_they_say_are_believed(
    seed: int, modesty: float, pace: float
) -> None:
    """Before a shaken camera; otherwise they would be smoothed away."""
    stamps, truth, measured, information = noisy(seed, 90, 0.003, pace)
    assert off(alone(stamps, measured, information / modesty**2), truth) < off(measured, truth)


def test_what_was_expected_is_taken_out_again() -> None:
    """A pose drawn half way to where it was expected counts as the pose that was seen."""
    stamps, _, measured, information = noisy(4, 30, 0.005)
    expected = exp_se3(np.array([0.004, -0.002, 0.001, 0.0, 0.0, 0.0])) @ measured[15]
    prior = Prior(expected, information[15])
    drawn, pulls = measured.copy(), np.zeros((30, 6))
    drawn[15] = exp_se3(0.5 * log_se3(expected @ inverse(measured[15]))) @ measured[15]
    pulls[15] = prior.gradient(drawn[15])
    seen = alone(stamps, measured, information)
    taken_out = np.abs(smoothed(stamps, drawn, information, pulls) - seen).max()
    assert taken_out < 3e-4
    assert np.abs(alone(stamps, drawn, information) - seen).max() > 3 * taken_out


def test_the_world_may_lie_anywhere() -> None:
    stamps, _, measured, information = noisy(1, 30, 0.005)
    world = exp_se3(np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6]))
    once = alone(stamps, measured, information)
    np.testing.assert_allclose(
        alone(stamps, measured @ world, information), once @ world, atol=1e-9
    )


def test_frames_on_both_sides_of_a_gap_know_nothing_of_each_other() -> None:
    stamps, _, measured, information = noisy(2, 40, 0.005)
    stamps[20:] += 1.0
    apart = [
        alone(stamps[part], measured[part], information[part])
        for part in (slice(0, 20), slice(20, 40))
    ]
    np.testing.assert_allclose(
        alone(stamps, measured, information), np.concatenate(apart), atol=1e-12
    )


def test_nor_does_one_side_tell_how_calm_the_other_is() -> None:
    stamps, _, measured, information = noisy(2, 40, 0.005)
    measured[:20] = noisy(5, 20, 0.03)[2]
    stamps[20:] += 1.0
    np.testing.assert_allclose(
        alone(stamps, measured, information)[20:],
        alone(stamps[20:], measured[20:], information[20:]),
        atol=1e-12,
    )


@pytest.mark.parametrize("step", [0.0011, 0.033, 0.2])
def test_frames_that_saw_nothing_are_no_fault(step: float) -> None:
    _, _, measured, information = noisy(6, 60, 0.005)
    way = alone(step * np.arange(60), measured, 0 * information)
    assert np.isfinite(way).all()


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_few_frames_stay(frames: int) -> None:
    stamps, _, measured, information = noisy(3, 3, 0.01)
    kept = slice(0, frames)
    np.testing.assert_array_equal(
        alone(stamps[kept], measured[kept], information[kept]), measured[kept]
    )


def test_the_tracker_smooths_its_trajectory_unless_told_not_to() -> None:
    """The poses it gives while it runs are the same."""
    path = camera_path(20)
    views = [render(room(), pose)[:2] for pose in path]
    ways, live = [], []
    for smooths in (True, False):
        slam = Slam(CAMERA, slam_config(300, smoothing__enabled=smooths))
        live.append([track(slam, *view, k / 30).T_wc for k, view in enumerate(views)])
        ways.append(slam.trajectory().poses)
    np.testing.assert_array_equal(live[0], live[1])
    assert 1e-5 < np.abs(ways[0] - ways[1]).max() < 0.02
    true = inverse(path)
    assert off(inverse(ways[0]), true) < off(inverse(ways[1]), true)
