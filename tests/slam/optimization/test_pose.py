"""Exponential map, Jacobians, pose, RANSAC, and bundle adjustment against known results."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA
from scipy.linalg import expm
from scipy.optimize import least_squares

from cohdc_train.slam.config import RansacConfig
from cohdc_train.slam.geometry.se3 import exp_se3, skew, to_local
from cohdc_train.slam.optimization.bundle_adjustment import (
    Problem,
    adjust,
    local_points,
    measurement_chi2,
)
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.ransac import ransac_pose, rigid_transforms
from cohdc_train.slam.optimization.reprojection import (
    CHI2_DEPTH,
    Observations,
    ReprojectionModel,
    chi_square,
    pose_jacobian,
    residual_jacobian,
    residuals,
)

Array = NDArray[np.float64]
RANSAC = RansacConfig()
REPROJECTION = ReprojectionModel(CAMERA)


def cloud(rng: np.random.Generator, count: int) -> Array:
    """Return points [count, 3] m in view of a camera near the origin."""
    return rng.uniform([-1.0, -0.7, 1.5], [1.0, 0.7, 4.0], size=(count, 3))


def observe(
    T_cw: Array, points: Array, rng: np.random.Generator, noise: float = 0.0
) -> Observations:
    """Measure points with a camera, a fifth of them without depth.

    noise: standard deviation in px, of pixels and of disparity.
    """
    local = to_local(T_cw, points)
    pixels = CAMERA.project(local) + rng.normal(size=(len(points), 2)) * noise
    depths = REPROJECTION.bf / (
        REPROJECTION.bf / local[:, 2] + rng.normal(size=len(points)) * noise
    )
    depths[rng.random(len(points)) < 0.2] = np.nan
    sigmas = rng.choice([[1.0, 1.0], [1.2, 1.2], [1.44, 1.44], [0.8, 1.2]], size=len(points)).T
    return Observations(pixels, depths, *sigmas)


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_exponential_map_is_the_matrix_exponential(values: list[float]) -> None:
    xi = np.array(values)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(xi[3:]), xi[:3]
    np.testing.assert_allclose(exp_se3(xi), expm(generator), atol=1e-8)


@given(st.integers(0, 10_000))
def test_jacobians_equal_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_cw, points = exp_se3(rng.normal(size=6) * 0.1), cloud(rng, 8)
    observations = observe(T_cw, points, rng, noise=2.0)
    local = to_local(T_cw, points)
    derivative = residual_jacobian(local, observations, REPROJECTION)
    by_pose, by_point = pose_jacobian(local, derivative), derivative @ T_cw[:3, :3]

    def error(T: Array, shift: Array) -> Array:
        return residuals(to_local(T, points + shift), observations, REPROJECTION)

    for axis in range(6):
        step = np.eye(6)[axis] * 1e-6
        change = error(exp_se3(step) @ T_cw, np.zeros(3)) - error(
            exp_se3(-step) @ T_cw, np.zeros(3)
        )
        np.testing.assert_allclose(by_pose[:, :, axis], change / 2e-6, rtol=1e-4, atol=1e-3)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-6
        np.testing.assert_allclose(
            by_point[:, :, axis],
            (error(T_cw, step) - error(T_cw, -step)) / 2e-6,
            rtol=1e-4,
            atol=1e-3,
        )


def test_pose_optimization_detects_outliers() -> None:
    rng = np.random.default_rng(1)
    T_cw, points = exp_se3(np.array([0.1, -0.05, 0.2, 0.05, -0.1, 0.02])), cloud(rng, 200)
    observations = observe(T_cw, points, rng, noise=0.1)
    observations.pixels[:30] += rng.uniform(15, 40, size=(30, 2))
    found, inlier = optimize_pose(np.eye(4), points, observations, REPROJECTION)
    assert np.linalg.norm(found[:3, 3] - T_cw[:3, 3]) < 1e-3
    assert not inlier[:30].any()
    assert inlier[30:].all()


def test_point_behind_camera_is_never_inlier() -> None:
    points = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]])
    observations = Observations(
        np.full((2, 2), [CAMERA.cx, CAMERA.cy]), np.full(2, np.nan), np.ones(2), np.ones(2)
    )
    np.testing.assert_array_equal(
        chi_square(np.eye(4), points, observations, REPROJECTION) < CHI2_DEPTH, [False, True]
    )


@given(st.integers(0, 10_000))
def test_rigid_transforms_are_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, source = exp_se3(rng.normal(size=(5, 6))), rng.normal(size=(5, 4, 3))
    target = source @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    np.testing.assert_allclose(rigid_transforms(source, target), T, atol=1e-6)


def test_ransac_survives_sixty_percent_outliers() -> None:
    rng = np.random.default_rng(2)
    T_cw, points = exp_se3(np.array([0.3, -0.2, 0.1, 0.1, -0.2, 0.3])), cloud(rng, 150)
    observations = observe(T_cw, points, rng, noise=0.2)
    observations.pixels[:90] = rng.uniform([0, 0], [320, 240], size=(90, 2))
    found = ransac_pose(
        points, observations, CAMERA, np.random.default_rng(0), RANSAC, hypotheses=256
    )
    assert found is not None
    assert found[1][90:].mean() > 0.9
    assert found[1][:90].mean() < 0.1
    refined, _ = optimize_pose(
        found[0], points[found[1]], observations.take(found[1]), REPROJECTION
    )
    assert np.linalg.norm(refined[:3, 3] - T_cw[:3, 3]) < 0.01


def test_ransac_without_depth_falls_back_to_guess() -> None:
    rng = np.random.default_rng(3)
    points = cloud(rng, 20)
    observations = Observations(
        CAMERA.project(points), np.full(20, np.nan), np.ones(20), np.ones(20)
    )
    assert ransac_pose(points, observations, CAMERA, rng, RANSAC) is None
    found = ransac_pose(points, observations, CAMERA, rng, RANSAC, guess=np.eye(4))
    assert found is not None
    assert found[1].all()


def small_problem(seed: int, outliers: int = 0) -> tuple[Array, Array, Array, Array, Problem]:
    """Build a problem of five cameras, two of them fixed, and 40 points.

    Returns true poses and points, disturbed ones, and the problem.
    """
    rng = np.random.default_rng(seed)
    poses, points = exp_se3(rng.normal(size=(5, 6)) * 0.08), cloud(rng, 40)
    rows = [np.sort(rng.permutation(40)[:30]) for _ in poses]
    observations = [observe(T, points[r], rng, noise=0.3) for T, r in zip(poses, rows, strict=True)]
    everything = Observations(
        np.concatenate([s.pixels for s in observations]),
        np.concatenate([s.depths for s in observations]),
        np.concatenate([s.sigmas for s in observations]),
        np.concatenate([s.depth_sigmas for s in observations]),
    )
    everything.pixels[:outliers] += 60.0
    free = np.array([False, False, True, True, True])
    problem = Problem(np.repeat(np.arange(5), 30), np.concatenate(rows), everything, free)
    start = poses.copy()
    start[free] = exp_se3(rng.normal(size=(3, 6)) * 0.02) @ poses[free]
    return poses, points, start, points + rng.normal(size=points.shape) * 0.03, problem


def test_schur_bundle_adjustment_equals_general_solver() -> None:
    _, _, poses, points, problem = small_problem(4)

    def error(x: Array) -> Array:
        moved = poses.copy()
        moved[problem.free] = exp_se3(x[:18].reshape(3, 6)) @ poses[problem.free]
        local = local_points(moved, x[18:].reshape(-1, 3), problem)
        return residuals(local, problem.observations, REPROJECTION).reshape(-1)

    expected = least_squares(
        error, np.r_[np.zeros(18), points.reshape(-1)], method="lm", xtol=1e-14, ftol=1e-14
    )
    got_poses, got_points = poses, points
    for _ in range(4):  # adjust stops when a step gains less than a thousandth
        got_poses, got_points = adjust(
            got_poses, got_points, problem, REPROJECTION, steps=20, robust=False
        )
    cost = measurement_chi2(got_poses, got_points, problem, REPROJECTION).sum()
    assert cost == pytest.approx(2 * expected.cost, rel=1e-6)
    wanted = exp_se3(expected.x[:18].reshape(3, 6)) @ poses[problem.free]
    np.testing.assert_allclose(got_poses[problem.free], wanted, atol=1e-5)
    np.testing.assert_allclose(got_points, expected.x[18:].reshape(-1, 3), atol=1e-3)


def test_bundle_adjustment_detects_outliers_and_keeps_fixed_poses() -> None:
    true_poses, _, poses, points, problem = small_problem(5, outliers=6)
    new_poses, new_points = adjust(poses, points, problem, REPROJECTION, steps=20)
    is_inlier = (
        measurement_chi2(new_poses, new_points, problem, REPROJECTION)
        <= problem.observations.chi2_thresholds
    )
    assert not is_inlier[:6].any()
    assert is_inlier[6:].all()
    new_poses, _ = adjust(
        new_poses, new_points, problem.take(is_inlier), REPROJECTION, steps=20, robust=False
    )
    np.testing.assert_array_equal(new_poses[:2], poses[:2])
    before = np.linalg.norm(poses[2:, :3, 3] - true_poses[2:, :3, 3], axis=1)
    after = np.linalg.norm(new_poses[2:, :3, 3] - true_poses[2:, :3, 3], axis=1)
    assert after.max() < 0.006 < 0.02 < before.min()


def test_cost_never_rises_from_poor_initial_points() -> None:
    _, _, poses, points, problem = small_problem(6)
    points = points + np.random.default_rng(0).normal(size=points.shape) * 0.4
    before = measurement_chi2(poses, points, problem, REPROJECTION).sum()
    result = adjust(poses, points, problem, REPROJECTION, steps=3, robust=False)
    assert measurement_chi2(*result, problem, REPROJECTION).sum() < before


def test_problem_refuses_unsorted_cameras() -> None:
    observations = Observations(np.zeros((2, 2)), np.zeros(2), np.ones(2), np.ones(2))
    with pytest.raises(ValueError, match="sorted by camera"):
        Problem(np.array([1, 0]), np.array([0, 0]), observations, np.array([True, True]))


def test_too_few_points_keep_pose_but_get_inlier_flags() -> None:
    rng = np.random.default_rng(0)
    T_cw, points = exp_se3(rng.normal(size=6) * 0.1), cloud(rng, 5)
    observations = observe(T_cw, points, rng)
    observations.pixels[2] += 50.0
    pose, inlier = optimize_pose(T_cw, points, observations, REPROJECTION)
    np.testing.assert_array_equal(pose, T_cw)
    assert inlier.tolist() == [True, True, False, True, True]
