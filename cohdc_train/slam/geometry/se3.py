"""Rigid motions SE(3) and their Lie algebra."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


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
    """T: [..., 4, 4]. Returns [..., 6] (translation part, rotation vector rad), the inverse of
    exp_se3.
    """
    phi = (
        Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    )
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


def to_local(T_cw: Array, points: Array) -> Array:
    """T_cw: [4, 4]; points: [m, 3] world, m. Returns [m, 3] in the camera frame, m."""
    return points @ T_cw[:3, :3].T + T_cw[:3, 3]


def adjoint(T: Array) -> Array:
    """[n, 6, 6] with T exp(xi) = exp(adjoint xi) T."""
    result = np.zeros((len(T), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = T[:, :3, :3]
    result[:, :3, 3:] = skew(T[:, :3, 3]) @ T[:, :3, :3]
    return result


def adjoint_of_algebra(xi: Array) -> Array:
    """[n, 6, 6], the derivative of the adjoint of exp(xi) at zero."""
    result = np.zeros((len(xi), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = skew(xi[:, 3:])
    result[:, :3, 3:] = skew(xi[:, :3])
    return result
