"""Bundle adjustment by Levenberg-Marquardt, with points eliminated by the Schur complement."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cohdc_train.slam.geometry.se3 import Array, exp_se3, to_local
from cohdc_train.slam.optimization.linear_solver import solve_symmetric
from cohdc_train.slam.optimization.reprojection import (
    MIN_DEPTH_M,
    Observations,
    ReprojectionModel,
    huber_weights,
    pose_jacobian,
    residual_jacobian,
    residuals,
)


@dataclass(frozen=True)
class Problem:
    """Observations of points by cameras; a camera observes a point at most once.

    cameras: [m] int64 index into the poses, sorted; points: [m] int64 index into the points;
    observations: the m measurements; free: [c] bool, True = the pose is optimized.
    """

    cameras: NDArray[np.int64]
    points: NDArray[np.int64]
    observations: Observations
    free: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if not len(self.cameras) == len(self.points) == len(self.observations):
            raise ValueError("cameras, points and measurements differ in length")
        if np.any(np.diff(self.cameras) < 0):
            raise ValueError("measurements must be sorted by camera")

    def take(self, rows: NDArray[np.bool_]) -> "Problem":
        """Return the problem with the chosen measurements [m] bool only."""
        return Problem(
            self.cameras[rows], self.points[rows], self.observations.take(rows), self.free
        )


@dataclass(frozen=True)
class _Normal:
    """Blocks of the weighted normal equations of c free cameras and p points."""

    camera: Array  # [c, 6, 6]
    point: Array  # [p, 3, 3]
    # [c * 6, p * 3]: a block of 6 x 3 for every measurement by a free camera.
    mixed: sparse.bsr_array
    camera_gradient: Array  # [c, 6]
    point_gradient: Array  # [p, 3]


def local_points(poses: Array, points: Array, problem: Problem) -> Array:
    """Transform each observed point into the frame of its camera; returns [m, 3] m."""
    result = np.empty((len(problem.points), 3))
    ends = np.searchsorted(problem.cameras, np.arange(len(poses) + 1))
    for camera, pose in enumerate(poses):
        rows = slice(ends[camera], ends[camera + 1])
        result[rows] = to_local(pose, points[problem.points[rows]])
    return result


def measurement_chi2(
    poses: Array, points: Array, problem: Problem, reprojection: ReprojectionModel
) -> Array:
    """Return the chi-square [m] of each measurement, infinite for a point behind its camera."""
    local = local_points(poses, points, problem)
    error = residuals(local, problem.observations, reprojection)
    return np.where(local[:, 2] > MIN_DEPTH_M, np.einsum("mi,mi->m", error, error), np.inf)


def adjust(
    poses: Array,
    points: Array,
    problem: Problem,
    reprojection: ReprojectionModel,
    steps: int = 8,
    robust: bool = True,
) -> tuple[Array, Array]:
    """Minimize the (Huber) cost of all measurements over the free poses and all points.

    At least one pose must be fixed, or depth measured, for a unique solution; damping keeps the
    step finite in any case.

    Args:
        poses: [c, 4, 4] T_cw, world to camera, m.
        points: [p, 3] world, m.
        problem: the measurements, and which poses are free.
        reprojection: camera model of the measurements.
        steps: Levenberg-Marquardt steps at most.
        robust: use the Huber kernel.

    Returns:
        The optimized poses and points; the cost is never higher than before.
    """
    damping = 1e-4
    cost = _cost(poses, points, problem, reprojection, robust)
    for _ in range(steps):
        normal = _normal_equations(poses, points, problem, reprojection, robust)
        pose_step, point_step = _solve(normal, damping)
        new_poses = poses.copy()
        new_poses[problem.free] = exp_se3(pose_step) @ poses[problem.free]
        new_points = points + point_step
        new_cost = _cost(new_poses, new_points, problem, reprojection, robust)
        if new_cost > cost:
            damping *= 10
            continue
        gain = (cost - new_cost) / max(cost, 1e-12)
        poses, points, cost, damping = new_poses, new_points, new_cost, max(damping / 10, 1e-8)
        if gain < 1e-3:
            break
    return poses, points


def _cost(
    poses: Array, points: Array, problem: Problem, reprojection: ReprojectionModel, robust: bool
) -> float:
    """Return the sum of the squared residuals, with the Huber kernel where robust."""
    error = residuals(local_points(poses, points, problem), problem.observations, reprojection)
    chi2 = np.einsum("mi,mi->m", error, error)
    if not robust:
        return float(chi2.sum())
    limits = problem.observations.chi2_thresholds
    return float(np.where(chi2 <= limits, chi2, 2 * np.sqrt(limits * chi2) - limits).sum())


def _normal_equations(
    poses: Array, points: Array, problem: Problem, reprojection: ReprojectionModel, robust: bool
) -> _Normal:
    """Build the blocks of the normal equations at the current poses and points."""
    local = local_points(poses, points, problem)
    error = residuals(local, problem.observations, reprojection)
    derivative = residual_jacobian(local, problem.observations, reprojection)
    if robust:
        weight = np.sqrt(
            huber_weights(np.einsum("mi,mi->m", error, error), problem.observations.chi2_thresholds)
        )
        error, derivative = error * weight[:, None], derivative * weight[:, None, None]
    by_pose = pose_jacobian(local, derivative)
    by_point = derivative @ poses[problem.cameras, :3, :3]
    free, count = np.flatnonzero(problem.free), len(points)
    camera, camera_gradient = np.zeros((len(free), 6, 6)), np.zeros((len(free), 6))
    point, point_gradient = np.zeros((count, 3, 3)), np.zeros((count, 3))
    ends = np.searchsorted(problem.cameras, np.arange(len(poses) + 1))
    for rows in (slice(*pair) for pair in pairwise(ends)):
        # A camera observes a point once, so that += may index with an array.
        ids, J = problem.points[rows], by_point[rows]
        point[ids] += J.transpose(0, 2, 1) @ J
        point_gradient[ids] += np.einsum("mij,mi->mj", J, error[rows])
    for slot, index in enumerate(free):
        rows = slice(ends[index], ends[index + 1])
        J = by_pose[rows].reshape(-1, 6)
        camera[slot] = J.T @ J
        camera_gradient[slot] = J.T @ error[rows].reshape(-1)
    moves = problem.free[problem.cameras]
    blocks = by_pose[moves].transpose(0, 2, 1) @ by_point[moves]
    lengths = np.concatenate([[0], np.cumsum(np.diff(ends)[free])])
    mixed = sparse.bsr_array(
        (blocks, problem.points[moves], lengths), shape=(6 * len(free), 3 * count)
    )
    return _Normal(camera, point, mixed, camera_gradient, point_gradient)


def _solve(normal: _Normal, damping: float) -> tuple[Array, Array]:
    """Solve the damped normal equations for the steps of poses [c, 6] and points [p, 3]."""
    c, mixed = len(normal.camera), normal.mixed
    diagonal = np.arange(3)
    point = normal.point.copy()
    point[:, diagonal, diagonal] = point[:, diagonal, diagonal] * (1 + damping) + 1e-6
    inverse = np.linalg.inv(point)
    blocks = mixed.data @ inverse[mixed.indices]
    reduced = sparse.bsr_array((blocks, mixed.indices, mixed.indptr), shape=mixed.shape)
    camera = normal.camera + (damping * normal.camera + 1e-9) * np.eye(6)
    cameras = sparse.bsr_array((camera, np.arange(c), np.arange(c + 1)))
    rhs = reduced @ normal.point_gradient.ravel() - normal.camera_gradient.ravel()
    pose_step = solve_symmetric(cameras - reduced @ mixed.T, rhs)
    point_rhs = -normal.point_gradient - (mixed.T @ pose_step).reshape(-1, 3)
    return pose_step.reshape(c, 6), np.einsum("pij,pj->pi", inverse, point_rhs)
