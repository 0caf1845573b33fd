"""Robust least squares on reprojection and depth: one camera's pose, and bundle adjustment with a Schur complement.

A pose is T_cw: [4, 4] world to camera, m. It is updated from the left, T <- exp(xi) T, xi = (translation, rotation).
The residual of an observation has three rows: both pixel coordinates and bf / z, a disparity that a baseline b would
see, so that depth too is weighed in px. Rows of depth that were not measured weigh nothing.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from cohdc_train.slam.geometry.camera import Camera

Array = NDArray[np.float64]

CHI2_PIXEL = 5.991  # 95 % of a chi-square with two degrees of freedom
CHI2_DEPTH = 7.815  # and with three: pixel and depth
_NEAR = 0.05  # m: points nearer than this, or behind the camera, do not count


@dataclass(frozen=True)
class Observations:
    """m measurements. pixels: [m, 2] undistorted px; depths: [m] m, nan = none; sigmas, depth_sigmas: [m] px, of each
    coordinate and of the disparity that depth stands for."""

    pixels: Array
    depths: Array
    sigmas: Array
    depth_sigmas: Array

    def __post_init__(self) -> None:
        m = len(self.pixels)
        shapes = tuple(array.shape for array in (self.pixels, self.depths, self.sigmas, self.depth_sigmas))
        if shapes != ((m, 2), (m,), (m,), (m,)):
            raise ValueError("observations disagree in shape")

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Observations":
        """The chosen rows."""
        return Observations(self.pixels[rows], self.depths[rows], self.sigmas[rows], self.depth_sigmas[rows])

    def trusted(self, trust: Array) -> "Observations":
        """The same of points that stand still with these probabilities, [m] above 0 up to 1: they weigh as much."""
        share = np.sqrt(trust)
        return Observations(self.pixels, self.depths, self.sigmas / share, self.depth_sigmas / share)

    @property
    def limits(self) -> Array:
        """[m] chi-square above which a measurement is an outlier at 5 %."""
        return np.where(np.isnan(self.depths), CHI2_PIXEL, CHI2_DEPTH)


def joined(parts: list[Observations]) -> Observations:
    """All measurements of some frames, in their order."""
    return Observations(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.depths for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.depth_sigmas for part in parts]),
    )


@dataclass(frozen=True)
class Weighing:
    """The camera and bf, px m: how far depth is trusted. 100 px m is a sigma of 1 cm at 1 m and 9 cm at 3 m."""

    camera: Camera
    bf: float = 100.0


@dataclass(frozen=True)
class Prior:
    """A pose as it was expected. T_cw: [4, 4] world to camera, m; information: [6, 6] inverse covariance of the small
    motion (m, rad) in the camera's frame that leads from it to the true one."""

    T_cw: Array
    information: Array

    def pull(self, T_cw: Array) -> Array:
        """[6] gradient, at T_cw, of half the squared distance in sigmas; to first order in the rotation between."""
        between = T_cw @ inverse(self.T_cw)
        turn = np.asarray(cv2.Rodrigues(between[:3, :3])[0])[:, 0]
        way = between[:3, 3] - 0.5 * np.cross(turn, between[:3, 3])
        return np.asarray(self.information @ np.concatenate([way, turn]))


def exp_se3(xi: Array) -> Array:
    """xi: [..., 6] (translation part, rotation vector rad). Returns [..., 4, 4]."""
    rho, phi = xi[..., :3], xi[..., 3:]
    square_angle = np.einsum("...i,...i->...", phi, phi)[..., None, None]
    angle = np.sqrt(square_angle)
    a = np.sinc(angle / np.pi)  # sin(angle) / angle
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos(angle)) / angle^2
    c = np.where(angle < 1e-3, 1 / 6, (1 - a) / np.maximum(square_angle, 1e-12))
    cross = skew(phi)
    square = cross @ cross
    result = np.zeros((*xi.shape[:-1], 4, 4))
    result[..., :3, :3] = np.eye(3) + a * cross + b * square
    result[..., :3, 3] = ((np.eye(3) + b * cross + c * square) @ rho[..., None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def log_se3(T: Array) -> Array:
    """T: [..., 4, 4]. Returns [..., 6] (translation part, rotation vector rad), the inverse of exp_se3."""
    phi = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    cross = skew(phi)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    half = np.maximum(angle / 2, 1e-9)
    c = np.where(angle < 1e-3, 1 / 12, (1 - half / np.tan(half)) / np.maximum(angle, 1e-9) ** 2)
    left = np.eye(3) - 0.5 * cross + c * cross @ cross
    return np.concatenate([(left @ T[..., :3, 3:])[..., 0], phi], axis=-1)


def inverse(T: Array) -> Array:
    """T: [..., 4, 4] rigid. Returns [..., 4, 4]."""
    result = np.zeros_like(T)
    result[..., :3, :3] = T[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, 3:] = -result[..., :3, :3] @ T[..., :3, 3:]
    result[..., 3, 3] = 1.0
    return result


def skew(v: Array) -> Array:
    """v: [..., 3]. Returns [..., 3, 3] with skew(v) @ w = v x w."""
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return result


def residuals(local: Array, seen: Observations, weighing: Weighing) -> Array:
    """local: [m, 3] points in the camera frame, m. Returns [m, 3] prediction minus measurement, in sigmas."""
    camera = weighing.camera
    z = np.maximum(local[:, 2], _NEAR)
    result = np.empty((3, len(local))).T  # each residual's values side by side
    result[:, 0] = camera.fx * local[:, 0] / z + camera.cx - seen.pixels[:, 0]
    result[:, 1] = camera.fy * local[:, 1] / z + camera.cy - seen.pixels[:, 1]
    disparity = weighing.bf / z - weighing.bf / seen.depths
    result[:, 2] = np.where(np.isnan(disparity), 0.0, disparity)
    result[:, :2] /= seen.sigmas[:, None]
    result[:, 2] /= seen.depth_sigmas
    return result


def residual_jacobian(local: Array, seen: Observations, weighing: Weighing) -> Array:
    """d residuals / d local: [m, 3, 3], sigmas per m."""
    camera = weighing.camera
    reciprocal = 1.0 / np.maximum(local[:, 2], _NEAR)
    result = np.zeros((len(local), 3, 3))
    result[:, 0, 0] = camera.fx * reciprocal
    result[:, 0, 2] = -camera.fx * local[:, 0] * reciprocal**2
    result[:, 1, 1] = camera.fy * reciprocal
    result[:, 1, 2] = -camera.fy * local[:, 1] * reciprocal**2
    result[:, 2, 2] = np.where(np.isnan(seen.depths), 0.0, -weighing.bf * reciprocal**2)
    result[:, :2] /= seen.sigmas[:, None, None]
    result[:, 2] /= seen.depth_sigmas[:, None]
    return result


def pose_jacobian(local: Array, derivative: Array) -> Array:
    """local: [m, 3]; derivative: [m, 3, 3] d residual / d local. Returns [m, 3, 6], d residual / d xi."""
    x, y, z = (local[:, axis, None] for axis in range(3))
    dx, dy, dz = (derivative[:, :, axis] for axis in range(3))
    result = np.empty((len(local), 3, 6))
    result[:, :, :3] = derivative
    result[:, :, 3] = y * dz - z * dy  # a turn moves the point by phi x local
    result[:, :, 4] = z * dx - x * dz
    result[:, :, 5] = x * dy - y * dx
    return result


def to_local(T_cw: Array, points: Array) -> Array:
    """T_cw: [4, 4]; points: [m, 3] world, m. Returns [m, 3] in the camera frame, m."""
    return points @ T_cw[:3, :3].T + T_cw[:3, 3]


def chi_square(T_cw: Array, points: Array, seen: Observations, weighing: Weighing) -> Array:
    """[m] squared residual in sigmas; infinite for points that lie behind the camera."""
    local = to_local(T_cw, points)
    chi2 = np.einsum("ij,ij->i", *(2 * (residuals(local, seen, weighing),)))
    return np.where(local[:, 2] > _NEAR, chi2, np.inf)


def huber_weights(chi2: Array, limits: Array) -> Array:
    """[m] weight of each measurement in iteratively reweighted least squares: 1 inside the limit, falling outside."""
    return np.sqrt(np.minimum(1.0, limits / np.maximum(chi2, 1e-12)))


def optimize_pose(
    T_cw: Array, points: Array, seen: Observations, weighing: Weighing, rounds: int = 2, prior: Prior | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Gauss-Newton on the six parameters of a pose, Huber-weighted; outliers are dropped and may return every round.

    T_cw: [4, 4] start; points: [m, 3] world, m; rounds: how often outliers are chosen; prior: what was expected, which
    counts beside the measurements. Returns the pose and [m] bool, True = inlier at 95 %.
    """
    limits = seen.limits
    used = np.ones(len(points), dtype=np.bool_)
    for _ in range(rounds):
        if used.sum() < 6:
            break
        T_cw = _refine(T_cw, points[used], seen.take(used), weighing, prior)
        used = chi_square(T_cw, points, seen, weighing) <= limits
    return T_cw, used


def pose_information(T_cw: Array, points: Array, seen: Observations, weighing: Weighing) -> Array:
    """[6, 6] inverse covariance of a pose that these measurements decide; arguments as of optimize_pose."""
    local = to_local(T_cw, points)
    J = np.zeros((6, 3, len(points)))
    _fill_pose_jacobian(J, local, seen, weighing)
    rows = J.reshape(6, -1)
    return np.asarray(rows @ rows.T)


def _refine(
    T_cw: Array, points: Array, seen: Observations, weighing: Weighing, prior: Prior | None, steps: int = 8
) -> Array:
    limits = seen.limits
    J = np.zeros((6, 3, len(points)))
    for _ in range(steps):
        local = to_local(T_cw, points)
        error = residuals(local, seen, weighing).T
        weight = huber_weights(np.einsum("im,im->m", error, error), limits)
        weight[local[:, 2] <= _NEAR] = 0.0
        _fill_pose_jacobian(J, local, seen, weighing)
        rows, weighted = J.reshape(6, -1), (J * weight).reshape(6, -1)
        H, g = weighted @ rows.T + 1e-9 * np.eye(6), weighted @ error.reshape(-1)
        if prior is not None:
            H, g = H + prior.information, g + prior.pull(T_cw)
        step = np.linalg.solve(H, -g)
        turn = np.asarray(cv2.Rodrigues(step[3:])[0])
        T_cw = T_cw.copy()
        T_cw[:3] = turn @ T_cw[:3]
        T_cw[:3, 3] += step[:3]  # exp(xi) to first order, which is all that the last, tiny step needs
        if np.abs(step).max() < 2e-5:  # 20 micrometres or microradians
            break
    # A pose is predicted from the two before, which doubles what rounding took from its rotation; one Newton step back.
    R = T_cw[:3, :3]
    T_cw[:3, :3] = R @ (1.5 * np.eye(3) - 0.5 * R.T @ R)
    return T_cw


def _fill_pose_jacobian(J: Array, local: Array, seen: Observations, weighing: Weighing) -> None:
    """J: [6, 3, m], zero at first: pose_jacobian of residual_jacobian, laid out for speed with its zeros left out."""
    camera = weighing.camera
    x, y = np.ascontiguousarray(local[:, :2].T)
    z = np.maximum(local[:, 2], _NEAR)
    u, v = J[:, 0], J[:, 1]
    J[0, 0] = camera.fx / (z * seen.sigmas)
    J[1, 1] = camera.fy / (z * seen.sigmas)
    J[2, 0], J[2, 1] = -u[0] * x / z, -v[1] * y / z
    J[2, 2] = np.where(np.isnan(seen.depths), 0.0, -weighing.bf / (z * z * seen.depth_sigmas))
    J[3] = y * J[2]  # a turn moves the point by phi x local
    J[3, 1] -= z * v[1]
    J[4] = -x * J[2]
    J[4, 0] += z * u[0]
    J[5, 0], J[5, 1] = -y * u[0], x * v[1]


def solve_symmetric(matrix: sparse.sparray | sparse.spmatrix, right: Array) -> Array:
    """x of matrix @ x = right. matrix: sparse [n, n], symmetric and positive definite; right: [n]."""
    options = {"SymmetricMode": True}
    factors = splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.asarray(factors.solve(right), dtype=np.float64)
