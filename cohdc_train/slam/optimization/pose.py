"""Robust pose optimization by reprojection error and depth.

A pose is T_cw: [4, 4] world to camera, m. It is updated from the left, T <- exp(xi) T with xi =
(translation, rotation). The residual of an observation has three rows: both pixel coordinates, and
the disparity bf / z that a baseline b would observe, so that depth, too, is weighted in px. The row
of a depth that was not measured is zero.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.optimization.reprojection import (
    MIN_DEPTH_M,
    Observations,
    Prior,
    ReprojectionModel,
    chi_square,
    fill_pose_jacobian,
    huber_weights,
    residuals,
)


def optimize_pose(
    T_cw: Array,
    points: Array,
    observations: Observations,
    reprojection: ReprojectionModel,
    rounds: int = 2,
    prior: Prior | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Optimize a pose by Gauss-Newton with Huber weights.

    Outliers are excluded after every round, and may become inliers again in the next.

    Args:
        T_cw: [4, 4] initial pose, world to camera, m.
        points: [m, 3] world, m.
        observations: the m measurements of these points.
        reprojection: camera model of the measurements.
        rounds: number of rounds.
        prior: motion prior, which counts in addition to the measurements.

    Returns:
        The pose, and [m] bool, True = inlier at 95 %.
    """
    limits = observations.chi2_thresholds
    is_inlier = np.ones(len(points), dtype=np.bool_)
    for _ in range(rounds):
        if is_inlier.sum() >= 6:
            T_cw = _refine(
                T_cw, points[is_inlier], observations.take(is_inlier), reprojection, prior
            )
        is_inlier = chi_square(T_cw, points, observations, reprojection) <= limits
    return T_cw, is_inlier


def pose_information(
    T_cw: Array, points: Array, observations: Observations, reprojection: ReprojectionModel
) -> Array:
    """Return the information matrix [6, 6] of a pose: the inverse covariance by its measurements.

    Order (translation m, rotation rad) in the camera frame; arguments as of `optimize_pose`.
    """
    local = to_local(T_cw, points)
    J = np.zeros((6, 3, len(points)))
    fill_pose_jacobian(J, local, observations, reprojection)
    rows = J.reshape(6, -1)
    return np.asarray(rows @ rows.T)


def _refine(
    T_cw: Array,
    points: Array,
    observations: Observations,
    reprojection: ReprojectionModel,
    prior: Prior | None,
    steps: int = 8,
) -> Array:
    """Run Gauss-Newton steps on the given measurements; returns T_cw [4, 4]."""
    limits = observations.chi2_thresholds
    J = np.zeros((6, 3, len(points)))
    for _ in range(steps):
        local = to_local(T_cw, points)
        error = residuals(local, observations, reprojection).T
        weight = huber_weights(np.einsum("im,im->m", error, error), limits)
        weight[local[:, 2] <= MIN_DEPTH_M] = 0.0
        fill_pose_jacobian(J, local, observations, reprojection)
        rows, weighted = J.reshape(6, -1), (J * weight).reshape(6, -1)
        H, g = weighted @ rows.T + 1e-9 * np.eye(6), weighted @ error.reshape(-1)
        if prior is not None:
            H, g = H + prior.information, g + prior.gradient(T_cw)
        step = np.linalg.solve(H, -g)
        rotation = np.asarray(cv2.Rodrigues(step[3:])[0])
        T_cw = T_cw.copy()
        T_cw[:3] = rotation @ T_cw[:3]
        # exp(xi) to first order, which suffices as the last step is tiny.
        T_cw[:3, 3] += step[:3]
        if np.abs(step).max() < 2e-5:  # 20 micrometers or microradians
            break
    # Rounding errors make the rotation drift from orthonormality, and predictions amplify them:
    # one Newton step orthonormalizes it.
    R = T_cw[:3, :3]
    T_cw[:3, :3] = R @ (1.5 * np.eye(3) - 0.5 * R.T @ R)
    return T_cw
