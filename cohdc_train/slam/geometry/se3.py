"""Rigid motions SE(3) and their Lie algebra."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-3  # rad; below it the limits of the series are exact enough


def exp_se3(xi: Array) -> Array:
    """Map twists to rigid motions (exponential map).

    Args:
        xi: [..., 6] translation part, then rotation vector, rad.

    Returns:
        [..., 4, 4].
    """
    rho, phi = xi[..., :3], xi[..., 3:]
    square_angle = np.einsum("...i,...i->...", phi, phi)[..., None, None]
    angle = np.sqrt(square_angle)

    # Coefficients of the series: sin(t) / t, (1 - cos(t)) / t^2 and (1 - sin(t) / t) / t^2.
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    exact = (1 - sine) / np.maximum(square_angle, 1e-12)
    cubic = np.where(angle < _SMALL_ANGLE, 1 / 6, exact)

    cross = skew(phi)
    square = cross @ cross
    rotation = np.eye(3) + sine * cross + cosine * square
    left_jacobian = np.eye(3) + cosine * cross + cubic * square

    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = (left_jacobian @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log_se3(T: Array) -> Array:
    """Map rigid motions [..., 4, 4] to twists [..., 6]; the inverse of `exp_se3`."""
    rotations = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3))
    phi = rotations.as_rotvec().reshape(*T.shape[:-2], 3)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    half = np.maximum(angle / 2, 1e-9)
    exact = (1 - half / np.tan(half)) / np.maximum(angle, 1e-9) ** 2
    quadratic = np.where(angle < _SMALL_ANGLE, 1 / 12, exact)

    cross = skew(phi)
    inverse_left_jacobian = np.eye(3) - 0.5 * cross + quadratic * cross @ cross
    rho = (inverse_left_jacobian @ T[..., :3, 3:])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def inverse(T: Array) -> Array:
    """Invert rigid motions [..., 4, 4]."""
    result = np.zeros_like(T)
    result[..., :3, :3] = T[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, 3:] = -result[..., :3, :3] @ T[..., :3, 3:]
    result[..., 3, 3] = 1.0
    return result


def skew(v: Array) -> Array:
    """Return the matrices [..., 3, 3] that compute the cross product with vectors v [..., 3]."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result = np.zeros((*v.shape, 3))
    result[..., 0, 1] = -z
    result[..., 0, 2] = y
    result[..., 1, 2] = -x
    result[..., 1, 0] = z
    result[..., 2, 0] = -y
    result[..., 2, 1] = x
    return result


def to_local(T_cw: Array, points: Array) -> Array:
    """Transform points [m, 3] from the world into the camera frame, m. T_cw: [4, 4]."""
    return points @ T_cw[:3, :3].T + T_cw[:3, 3]


def adjoint(T: Array) -> Array:
    """Return the adjoints [n, 6, 6] of rigid motions [n, 4, 4]: T exp(xi) = exp(adjoint xi) T."""
    rotation = T[:, :3, :3]
    result = np.zeros((len(T), 6, 6))
    result[:, :3, :3] = rotation
    result[:, 3:, 3:] = rotation
    result[:, :3, 3:] = skew(T[:, :3, 3]) @ rotation
    return result


def adjoint_of_algebra(xi: Array) -> Array:
    """Return the derivative [n, 6, 6] of the adjoint of exp(xi) at zero. xi: [n, 6]."""
    rotation = skew(xi[:, 3:])
    result = np.zeros((len(xi), 6, 6))
    result[:, :3, :3] = rotation
    result[:, 3:, 3:] = rotation
    result[:, :3, 3:] = skew(xi[:, :3])
    return result
