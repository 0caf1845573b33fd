"""Reprojection errors of points with depth: residuals, Jacobians and weights."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse, to_local

CHI2_PIXEL = 5.991  # 95 % of a chi-square with two degrees of freedom
CHI2_DEPTH = 7.815  # and with three: pixel and depth
MIN_DEPTH_M = 0.05  # m: points nearer than this, or behind the camera, do not count


@dataclass(frozen=True)
class Observations:
    """m measurements. pixels: [m, 2] undistorted px; depths: [m] m, nan = none; sigmas,
    depth_sigmas: [m] px, of each coordinate and of the disparity that depth stands for."""

    pixels: Array
    depths: Array
    sigmas: Array
    depth_sigmas: Array

    def __post_init__(self) -> None:
        m = len(self.pixels)
        shapes = tuple(
            array.shape for array in (self.pixels, self.depths, self.sigmas, self.depth_sigmas)
        )
        if shapes != ((m, 2), (m,), (m,), (m,)):
            raise ValueError("observations disagree in shape")

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Observations":
        """The chosen rows."""
        return Observations(
            self.pixels[rows], self.depths[rows], self.sigmas[rows], self.depth_sigmas[rows]
        )

    def weighted(self, trust: Array) -> "Observations":
        """The same of points that stand still with these probabilities, [m] above 0 up to 1: they
        weigh as much.
        """
        share = np.sqrt(trust)
        return Observations(
            self.pixels, self.depths, self.sigmas / share, self.depth_sigmas / share
        )

    @property
    def chi2_thresholds(self) -> Array:
        """[m] chi-square above which a measurement is an outlier at 5 %."""
        return np.where(np.isnan(self.depths), CHI2_PIXEL, CHI2_DEPTH)


def concatenate(parts: list[Observations]) -> Observations:
    """All measurements of some frames, in their order."""
    return Observations(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.depths for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.depth_sigmas for part in parts]),
    )


@dataclass(frozen=True)
class ReprojectionModel:
    """The camera and bf, px m: how far depth is trusted. 100 px m is a sigma of 1 cm at 1 m and 9
    cm at 3 m.
    """

    camera: Camera
    bf: float = 100.0


@dataclass(frozen=True)
class Prior:
    """A pose as it was expected. T_cw: [4, 4] world to camera, m; information: [6, 6] inverse
    covariance of the small motion (m, rad) in the camera's frame that leads from it to the true
    one."""

    T_cw: Array
    information: Array

    def gradient(self, T_cw: Array) -> Array:
        """[6] gradient, at T_cw, of half the squared distance in sigmas; to first order in the
        rotation between.
        """
        between = T_cw @ inverse(self.T_cw)
        turn = np.asarray(cv2.Rodrigues(between[:3, :3])[0])[:, 0]
        way = between[:3, 3] - 0.5 * np.cross(turn, between[:3, 3])
        return np.asarray(self.information @ np.concatenate([way, turn]))


def residuals(local: Array, seen: Observations, reprojection: ReprojectionModel) -> Array:
    """local: [m, 3] points in the camera frame, m. Returns [m, 3] prediction minus measurement, in
    sigmas.
    """
    camera = reprojection.camera
    z = np.maximum(local[:, 2], MIN_DEPTH_M)
    result = np.empty((3, len(local))).T  # each residual's values side by side
    result[:, 0] = camera.fx * local[:, 0] / z + camera.cx - seen.pixels[:, 0]
    result[:, 1] = camera.fy * local[:, 1] / z + camera.cy - seen.pixels[:, 1]
    disparity = reprojection.bf / z - reprojection.bf / seen.depths
    result[:, 2] = np.where(np.isnan(disparity), 0.0, disparity)
    result[:, :2] /= seen.sigmas[:, None]
    result[:, 2] /= seen.depth_sigmas
    return result


def residual_jacobian(local: Array, seen: Observations, reprojection: ReprojectionModel) -> Array:
    """d residuals / d local: [m, 3, 3], sigmas per m."""
    camera = reprojection.camera
    reciprocal = 1.0 / np.maximum(local[:, 2], MIN_DEPTH_M)
    result = np.zeros((len(local), 3, 3))
    result[:, 0, 0] = camera.fx * reciprocal
    result[:, 0, 2] = -camera.fx * local[:, 0] * reciprocal**2
    result[:, 1, 1] = camera.fy * reciprocal
    result[:, 1, 2] = -camera.fy * local[:, 1] * reciprocal**2
    result[:, 2, 2] = np.where(np.isnan(seen.depths), 0.0, -reprojection.bf * reciprocal**2)
    result[:, :2] /= seen.sigmas[:, None, None]
    result[:, 2] /= seen.depth_sigmas[:, None]
    return result


def pose_jacobian(local: Array, derivative: Array) -> Array:
    """local: [m, 3]; derivative: [m, 3, 3] d residual / d local. Returns [m, 3, 6], d residual / d
    xi.
    """
    x, y, z = (local[:, axis, None] for axis in range(3))
    dx, dy, dz = (derivative[:, :, axis] for axis in range(3))
    result = np.empty((len(local), 3, 6))
    result[:, :, :3] = derivative
    result[:, :, 3] = y * dz - z * dy  # a turn moves the point by phi x local
    result[:, :, 4] = z * dx - x * dz
    result[:, :, 5] = x * dy - y * dx
    return result


def chi_square(
    T_cw: Array, points: Array, seen: Observations, reprojection: ReprojectionModel
) -> Array:
    """[m] squared residual in sigmas; infinite for points that lie behind the camera."""
    local = to_local(T_cw, points)
    chi2 = np.einsum("ij,ij->i", *(2 * (residuals(local, seen, reprojection),)))
    return np.where(local[:, 2] > MIN_DEPTH_M, chi2, np.inf)


def huber_weights(chi2: Array, limits: Array) -> Array:
    """[m] weight of each measurement in iteratively reweighted least squares: 1 inside the limit,
    falling outside.
    """
    return np.sqrt(np.minimum(1.0, limits / np.maximum(chi2, 1e-12)))


def fill_pose_jacobian(
    J: Array, local: Array, seen: Observations, reprojection: ReprojectionModel
) -> None:
    """J: [6, 3, m], zero at first: pose_jacobian of residual_jacobian, laid out for speed with its
    zeros left out.
    """
    camera = reprojection.camera
    x, y = np.ascontiguousarray(local[:, :2].T)
    z = np.maximum(local[:, 2], MIN_DEPTH_M)
    u, v = J[:, 0], J[:, 1]
    J[0, 0] = camera.fx / (z * seen.sigmas)
    J[1, 1] = camera.fy / (z * seen.sigmas)
    J[2, 0], J[2, 1] = -u[0] * x / z, -v[1] * y / z
    J[2, 2] = np.where(np.isnan(seen.depths), 0.0, -reprojection.bf / (z * z * seen.depth_sigmas))
    J[3] = y * J[2]  # a turn moves the point by phi x local
    J[3, 1] -= z * v[1]
    J[4] = -x * J[2]
    J[4, 0] += z * u[0]
    J[5, 0], J[5, 1] = -y * u[0], x * v[1]
