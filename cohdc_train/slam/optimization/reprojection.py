"""Reprojection errors of points with depth: residuals, Jacobians and weights."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse, to_local

CHI2_PIXEL = 5.991  # 95 % of a chi-square with two degrees of freedom
CHI2_DEPTH = 7.815  # the same with three: pixel and depth
MIN_DEPTH_M = 0.05  # m: points nearer than this, or behind the camera, do not count


@dataclass(frozen=True)
class Observations:
    """Measurements of m points in one or several frames.

    pixels: [m, 2] undistorted px; depths: [m] m, nan = none; sigmas: [m] standard deviation of each
    pixel coordinate, px; depth_sigmas: [m] standard deviation of the disparity that depth stands
    for, px.
    """

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
        """Return the measurements of the chosen rows."""
        return Observations(
            self.pixels[rows], self.depths[rows], self.sigmas[rows], self.depth_sigmas[rows]
        )

    def weighted(self, probability: Array) -> "Observations":
        """Weight each measurement by the probability [m] that its point is static, in (0, 1]."""
        root = np.sqrt(probability)
        return Observations(self.pixels, self.depths, self.sigmas / root, self.depth_sigmas / root)

    @property
    def chi2_thresholds(self) -> Array:
        """Return the chi-square [m] above which a measurement is an outlier at 5 %."""
        return np.where(np.isnan(self.depths), CHI2_PIXEL, CHI2_DEPTH)


def concatenate(parts: list[Observations]) -> Observations:
    """Concatenate the measurements of several frames, in order."""
    return Observations(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.depths for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.depth_sigmas for part in parts]),
    )


@dataclass(frozen=True)
class ReprojectionModel:
    """Camera model of the measurements.

    camera: intrinsics; bf: focal length times baseline, px m, which weights depth. 100 px m is a
    standard deviation of 1 cm at 1 m and of 9 cm at 3 m.
    """

    camera: Camera
    bf: float = 100.0


@dataclass(frozen=True)
class Prior:
    """Prior of a pose, such as the prediction of a motion model.

    T_cw: [4, 4] world to camera, m; information: [6, 6] inverse covariance of the small motion (m,
    rad) in the camera frame from this pose to the true one.
    """

    T_cw: Array
    information: Array

    def gradient(self, T_cw: Array) -> Array:
        """Return the gradient [6], at T_cw, of half the squared Mahalanobis distance to the prior.

        It is exact to first order in the rotation between the two poses.
        """
        relative = T_cw @ inverse(self.T_cw)
        rotation = np.asarray(cv2.Rodrigues(relative[:3, :3])[0])[:, 0]
        translation = relative[:3, 3] - 0.5 * np.cross(rotation, relative[:3, 3])
        return np.asarray(self.information @ np.concatenate([translation, rotation]))


def residuals(local: Array, observations: Observations, reprojection: ReprojectionModel) -> Array:
    """Return the residuals of points: prediction minus measurement, in standard deviations.

    Args:
        local: [m, 3] points in the camera frame, m.
        observations: the m measurements.
        reprojection: camera model.

    Returns:
        [m, 3] of u, v, and disparity; the latter is 0 without depth.
    """
    camera = reprojection.camera
    z = np.maximum(local[:, 2], MIN_DEPTH_M)
    result = np.empty((3, len(local))).T  # contiguous per residual
    result[:, 0] = camera.fx * local[:, 0] / z + camera.cx - observations.pixels[:, 0]
    result[:, 1] = camera.fy * local[:, 1] / z + camera.cy - observations.pixels[:, 1]
    disparity = reprojection.bf / z - reprojection.bf / observations.depths
    result[:, 2] = np.where(np.isnan(disparity), 0.0, disparity)
    result[:, :2] /= observations.sigmas[:, None]
    result[:, 2] /= observations.depth_sigmas
    return result


def residual_jacobian(
    local: Array, observations: Observations, reprojection: ReprojectionModel
) -> Array:
    """Return the Jacobian [m, 3, 3] of the residuals by the local points [m, 3], sigmas per m."""
    camera = reprojection.camera
    reciprocal = 1.0 / np.maximum(local[:, 2], MIN_DEPTH_M)
    result = np.zeros((len(local), 3, 3))
    result[:, 0, 0] = camera.fx * reciprocal
    result[:, 0, 2] = -camera.fx * local[:, 0] * reciprocal**2
    result[:, 1, 1] = camera.fy * reciprocal
    result[:, 1, 2] = -camera.fy * local[:, 1] * reciprocal**2
    result[:, 2, 2] = np.where(np.isnan(observations.depths), 0.0, -reprojection.bf * reciprocal**2)
    result[:, :2] /= observations.sigmas[:, None, None]
    result[:, 2] /= observations.depth_sigmas[:, None]
    return result


def pose_jacobian(local: Array, derivative: Array) -> Array:
    """Return the Jacobian [m, 3, 6] of the residuals by xi of the pose.

    local: [m, 3] points in the camera frame, m; derivative: [m, 3, 3] d residual / d local.
    """
    x, y, z = (local[:, axis, None] for axis in range(3))
    dx, dy, dz = (derivative[:, :, axis] for axis in range(3))
    result = np.empty((len(local), 3, 6))
    result[:, :, :3] = derivative
    result[:, :, 3] = y * dz - z * dy  # a rotation moves the point by phi x local
    result[:, :, 4] = z * dx - x * dz
    result[:, :, 5] = x * dy - y * dx
    return result


def chi_square(
    T_cw: Array, points: Array, observations: Observations, reprojection: ReprojectionModel
) -> Array:
    """Return the chi-square [m] of each measurement, infinite for points behind the camera."""
    local = to_local(T_cw, points)
    chi2 = np.einsum("ij,ij->i", *(2 * (residuals(local, observations, reprojection),)))
    return np.where(local[:, 2] > MIN_DEPTH_M, chi2, np.inf)


def huber_weights(chi2: Array, limits: Array) -> Array:
    """Return the Huber weight [m] of each measurement in iteratively reweighted least squares.

    It is 1 up to the limit on chi2, and falls beyond.
    """
    return np.sqrt(np.minimum(1.0, limits / np.maximum(chi2, 1e-12)))


def fill_pose_jacobian(
    J: Array, local: Array, observations: Observations, reprojection: ReprojectionModel
) -> None:
    """Write `pose_jacobian` of `residual_jacobian` into J: [6, 3, m], which must be zero at first.

    The layout is chosen for speed, and entries that are always zero are skipped.
    """
    camera = reprojection.camera
    x, y = np.ascontiguousarray(local[:, :2].T)
    z = np.maximum(local[:, 2], MIN_DEPTH_M)
    u, v = J[:, 0], J[:, 1]
    J[0, 0] = camera.fx / (z * observations.sigmas)
    J[1, 1] = camera.fy / (z * observations.sigmas)
    J[2, 0], J[2, 1] = -u[0] * x / z, -v[1] * y / z
    J[2, 2] = np.where(
        np.isnan(observations.depths), 0.0, -reprojection.bf / (z * z * observations.depth_sigmas)
    )
    J[3] = y * J[2]  # a rotation moves the point by phi x local
    J[3, 1] -= z * v[1]
    J[4] = -x * J[2]
    J[4, 0] += z * u[0]
    J[5, 0], J[5, 1] = -y * u[0], x * v[1]
