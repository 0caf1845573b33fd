"""Local bundle adjustment: Levenberg-Marquardt over poses and points, points eliminated by the Schur complement."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.optimization import (
    Array,
    Observations,
    Weighing,
    exp_se3,
    huber_weights,
    pose_jacobian,
    residual_jacobian,
    residuals,
    to_local,
)

_BLAS_SERIAL = 200_000  # multiplications; OpenBLAS starts threads at 262144


@dataclass(frozen=True)
class Problem:
    """Which camera saw which point. No camera sees a point twice.

    cameras: [m] int64 index into the poses, sorted; points: [m] int64 index into the points; seen: the m measurements;
    free: [c] bool, which poses may move.
    """

    cameras: NDArray[np.int64]
    points: NDArray[np.int64]
    seen: Observations
    free: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if not len(self.cameras) == len(self.points) == len(self.seen):
            raise ValueError("cameras, points and measurements differ in length")
        if np.any(np.diff(self.cameras) < 0):
            raise ValueError("measurements must be sorted by camera")

    def take(self, rows: NDArray[np.bool_]) -> "Problem":
        """The same problem with the chosen measurements only."""
        return Problem(self.cameras[rows], self.points[rows], self.seen.take(rows), self.free)


@dataclass(frozen=True)
class _Normal:
    """Blocks of the normal equations of c free cameras and p points, after weighing."""

    camera: Array  # [c, 6, 6]
    point: Array  # [p, 3, 3]
    mixed: Array  # [3, c * 6, p]: columns of the point's block first, so that products are long and contiguous
    camera_gradient: Array  # [c, 6]
    point_gradient: Array  # [p, 3]


def local_points(poses: Array, points: Array, problem: Problem) -> Array:
    """[m, 3] each measured point in the frame of the camera that saw it, m."""
    result = np.empty((len(problem.points), 3))
    ends = np.searchsorted(problem.cameras, np.arange(len(poses) + 1))
    for camera, pose in enumerate(poses):
        rows = slice(ends[camera], ends[camera + 1])
        result[rows] = to_local(pose, points[problem.points[rows]])
    return result


def measurement_chi2(poses: Array, points: Array, problem: Problem, weighing: Weighing) -> Array:
    """[m] squared residual in sigmas; infinite where the point lies behind the camera."""
    local = local_points(poses, points, problem)
    error = residuals(local, problem.seen, weighing)
    return np.where(local[:, 2] > 0.05, np.einsum("mi,mi->m", error, error), np.inf)


def adjust(
    poses: Array, points: Array, problem: Problem, weighing: Weighing, steps: int = 8, robust: bool = True
) -> tuple[Array, Array]:
    """Minimise the (Huber) cost of all measurements over the free poses and all points.

    poses: [c, 4, 4] T_cw; points: [p, 3] world, m. Returns both, improved; the cost never rises. At least one pose
    must be fixed, or depth measured, for the problem to have one answer; damping keeps the step finite in any case.
    """
    damping = 1e-4
    cost = _cost(poses, points, problem, weighing, robust)
    for _ in range(steps):
        normal = _normal_equations(poses, points, problem, weighing, robust)
        pose_step, point_step = _solve(normal, damping)
        new_poses = poses.copy()
        new_poses[problem.free] = exp_se3(pose_step) @ poses[problem.free]
        new_points = points + point_step
        new_cost = _cost(new_poses, new_points, problem, weighing, robust)
        if new_cost > cost:
            damping *= 10
            continue
        gain = (cost - new_cost) / max(cost, 1e-12)
        poses, points, cost, damping = new_poses, new_points, new_cost, max(damping / 10, 1e-8)
        if gain < 1e-3:
            break
    return poses, points


def _cost(poses: Array, points: Array, problem: Problem, weighing: Weighing, robust: bool) -> float:
    error = residuals(local_points(poses, points, problem), problem.seen, weighing)
    chi2 = np.einsum("mi,mi->m", error, error)
    if not robust:
        return float(chi2.sum())
    limits = problem.seen.limits
    return float(np.where(chi2 <= limits, chi2, 2 * np.sqrt(limits * chi2) - limits).sum())


def _normal_equations(poses: Array, points: Array, problem: Problem, weighing: Weighing, robust: bool) -> _Normal:
    local = local_points(poses, points, problem)
    error = residuals(local, problem.seen, weighing)
    derivative = residual_jacobian(local, problem.seen, weighing)
    if robust:
        weight = np.sqrt(huber_weights(np.einsum("mi,mi->m", error, error), problem.seen.limits))
        error, derivative = error * weight[:, None], derivative * weight[:, None, None]
    by_pose = pose_jacobian(local, derivative)
    free, count = np.flatnonzero(problem.free), len(points)
    slot = {int(camera): place for place, camera in enumerate(free)}
    result = _Normal(
        camera=np.zeros((len(free), 6, 6)),
        point=np.zeros((count, 3, 3)),
        mixed=np.zeros((3, len(free) * 6, count)),
        camera_gradient=np.zeros((len(free), 6)),
        point_gradient=np.zeros((count, 3)),
    )
    ends = np.searchsorted(problem.cameras, np.arange(len(poses) + 1))
    for camera, pose in enumerate(poses):
        rows = slice(ends[camera], ends[camera + 1])
        by_point = (derivative[rows].reshape(-1, 3) @ pose[:3, :3]).reshape(-1, 3, 3)
        ids = problem.points[rows]  # a camera sees a point once, so += may index with an array
        result.point[ids] += by_point.transpose(0, 2, 1) @ by_point
        result.point_gradient[ids] += np.einsum("mij,mi->mj", by_point, error[rows])
        if camera in slot:
            _add_camera(result, slot[camera], ids, (by_pose[rows], by_point, error[rows]))
    return result


def _add_camera(result: _Normal, slot: int, ids: NDArray[np.int64], terms: tuple[Array, Array, Array]) -> None:
    by_pose, by_point, error = terms
    J = by_pose.reshape(-1, 6)
    result.camera[slot] = J.T @ J
    result.camera_gradient[slot] = np.einsum("ma,m->a", J, error.reshape(-1))
    products = by_pose.transpose(0, 2, 1) @ by_point
    result.mixed[:, slot * 6 : slot * 6 + 6, ids] = products.transpose(2, 1, 0)


def _solve(normal: _Normal, damping: float) -> tuple[Array, Array]:
    """Steps of the poses [c, 6] and the points [p, 3] from the damped normal equations."""
    c, mixed = len(normal.camera), normal.mixed
    diagonal = np.arange(3)
    point = normal.point.copy()
    point[:, diagonal, diagonal] = point[:, diagonal, diagonal] * (1 + damping) + 1e-6
    inverse = np.linalg.inv(point)
    right = -normal.camera_gradient.reshape(-1)
    reduced = np.zeros((c * 6, c * 6))
    for k in range(3):
        carried = sum(mixed[i] * inverse[:, i, k] for i in range(3))  # column k of mixed @ inverse
        reduced -= _product(carried, mixed[k])
        right = right + np.einsum("ap,p->a", carried, normal.point_gradient[:, k])
    for slot in range(c):
        block = slice(slot * 6, slot * 6 + 6)
        reduced[block, block] += normal.camera[slot] + damping * np.diag(np.diag(normal.camera[slot]))
    reduced[np.diag_indices(c * 6)] += 1e-9
    pose_step: Array = np.linalg.solve(reduced, right).astype(np.float64)
    back = -normal.point_gradient - np.einsum("a,kap->pk", pose_step, mixed)
    return pose_step.reshape(c, 6), np.einsum("pij,pj->pi", inverse, back)


def _product(first: Array, second: Array) -> Array:
    """first @ second.T of two [a, p] arrays, in pieces that a BLAS does not split over threads.

    Waiting for a second thread on a busy machine costs many times these products, and the order of sums stays the same.
    """
    total = np.zeros((len(first), len(second)))
    width = max(_BLAS_SERIAL // (len(first) * len(second)), 1)
    for start in range(0, first.shape[1], width):
        piece = slice(start, start + width)
        total += first[:, piece] @ second[:, piece].T
    return total
