"""Robust least squares on reprojection and depth: one camera's pose, and bundle adjustment with a
Schur complement.

A pose is T_cw: [4, 4] world to camera, m. It is updated from the left, T <- exp(xi) T, xi =
(translation, rotation). The residual of an observation has three rows: both pixel coordinates and
bf / z, a disparity that a baseline b would see, so that depth too is weighed in px. Rows of depth
that were not measured weigh nothing.
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
    seen: Observations,
    reprojection: ReprojectionModel,
    rounds: int = 2,
    prior: Prior | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Gauss-Newton on the six parameters of a pose, Huber-weighted; outliers are dropped and may
    return every round.

    T_cw: [4, 4] start; points: [m, 3] world, m; rounds: how often outliers are chosen; prior: what
    was expected, which counts beside the measurements. Returns the pose and [m] bool, True = inlier
    at 95 %.
    """
    limits = seen.chi2_thresholds
    used = np.ones(len(points), dtype=np.bool_)
    for _ in range(rounds):
        if used.sum() >= 6:
            T_cw = _refine(T_cw, points[used], seen.take(used), reprojection, prior)
        used = chi_square(T_cw, points, seen, reprojection) <= limits
    return T_cw, used


def pose_information(
    T_cw: Array, points: Array, seen: Observations, reprojection: ReprojectionModel
) -> Array:
    """[6, 6] inverse covariance of a pose that these measurements decide; arguments as of
    optimize_pose.
    """
    local = to_local(T_cw, points)
    J = np.zeros((6, 3, len(points)))
    fill_pose_jacobian(J, local, seen, reprojection)
    rows = J.reshape(6, -1)
    return np.asarray(rows @ rows.T)


def _refine(
    T_cw: Array,
    points: Array,
    seen: Observations,
    reprojection: ReprojectionModel,
    prior: Prior | None,
    steps: int = 8,
) -> Array:
    limits = seen.chi2_thresholds
    J = np.zeros((6, 3, len(points)))
    for _ in range(steps):
        local = to_local(T_cw, points)
        error = residuals(local, seen, reprojection).T
        weight = huber_weights(np.einsum("im,im->m", error, error), limits)
        weight[local[:, 2] <= MIN_DEPTH_M] = 0.0
        fill_pose_jacobian(J, local, seen, reprojection)
        rows, weighted = J.reshape(6, -1), (J * weight).reshape(6, -1)
        H, g = weighted @ rows.T + 1e-9 * np.eye(6), weighted @ error.reshape(-1)
        if prior is not None:
            H, g = H + prior.information, g + prior.gradient(T_cw)
        step = np.linalg.solve(H, -g)
        turn = np.asarray(cv2.Rodrigues(step[3:])[0])
        T_cw = T_cw.copy()
        T_cw[:3] = turn @ T_cw[:3]
        T_cw[:3, 3] += step[
            :3
        ]  # exp(xi) to first order, which is all that the last, tiny step needs
        if np.abs(step).max() < 2e-5:  # 20 micrometres or microradians
            break
    # A pose is predicted from the two before, which doubles what rounding took from its rotation;
    # one Newton step back.
    R = T_cw[:3, :3]
    T_cw[:3, :3] = R @ (1.5 * np.eye(3) - 0.5 * R.T @ R)
    return T_cw
