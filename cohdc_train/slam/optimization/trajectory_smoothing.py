"""Smoothing of the trajectory by the motion model, after the sequence has ended.

It is the fixed-interval counterpart of the motion model's Kalman filter: the velocity changes with
the same noise, or with more where the measurements show faster changes, but later frames count as
well. One linear system is solved for all poses.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from cohdc_train.slam.config import MotionModelConfig, SmoothingConfig
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3

_BAND = 18  # diagonals of the normal equations: three frames of six parameters are coupled


@dataclass(frozen=True)
class TrackedPoses:
    """Poses of n frames, with the information of each frame's own measurements.

    timestamps: [n] s, ascending; T_cw: [n, 4, 4] world to camera, m; information: [n, 6, 6] inverse
    covariance of each pose by the frame's measurements, in the camera frame, (m, rad);
    prior_gradients: [n, 6] `Prior.gradient` of the motion prior at each pose, 0 where none counted.
    """

    timestamps: Array
    T_cw: Array
    information: Array
    prior_gradients: Array

    def split(self, rows: NDArray[np.int64]) -> list["TrackedPoses"]:
        """Split the frames before the given rows."""
        parts = [
            np.split(values, rows)
            for values in (self.timestamps, self.T_cw, self.information, self.prior_gradients)
        ]
        return [TrackedPoses(*part) for part in zip(*parts, strict=True)]


def smooth_trajectory(
    tracked: TrackedPoses, config: SmoothingConfig, motion: MotionModelConfig
) -> Array:
    """Smooth poses by the motion model; returns [n, 4, 4] T_cw, m.

    The effect of the motion prior on each pose is removed first, since earlier frames count here
    anyway. Frames that are further apart than motion.max_gap_s are smoothed separately.
    """
    step = np.diff(tracked.timestamps)
    is_gap = (step <= motion.min_gap_s) | (step > motion.max_gap_s)
    runs = tracked.split(np.flatnonzero(is_gap) + 1)
    return np.concatenate([_smooth_run(run, config, motion) for run in runs])


def _smooth_run(tracked: TrackedPoses, config: SmoothingConfig, motion: MotionModelConfig) -> Array:
    """Smooth consecutive frames without a gap; returns [n, 4, 4] T_cw, m."""
    timestamps, poses = tracked.timestamps, tracked.T_cw
    if len(timestamps) < 3:
        return poses
    before, after = np.diff(timestamps)[:-1], np.diff(timestamps)[1:]
    coefficients = np.stack([1 / before, -1 / before - 1 / after, 1 / after])[..., None]
    deviation = np.repeat(motion.acceleration_sigma, 3) * ((before + after) / 2)[:, None]
    motions = log_se3(poses[1:] @ inverse(poses[:-1]))
    change = motions[1:] / after[:, None] - motions[:-1] / before[:, None]
    eigenvalues, axes = np.linalg.eigh(tracked.information)
    eigenvalues = np.maximum(eigenvalues, config.min_information)
    prior_shift = np.einsum(
        "nab,nb,ncb,nc->na", axes, 1 / eigenvalues, axes, tracked.prior_gradients
    )
    weights = eigenvalues / (1 + eigenvalues * config.pose_floor**2)
    information = (axes * weights[:, None]) @ axes.transpose(0, 2, 1)
    information = information * _information_scale(
        information, coefficients, change, deviation, config.min_variance_ratio
    )
    gradient = np.einsum("nab,nb->na", information, prior_shift)
    weight, corrections = np.ones_like(change), np.zeros((len(timestamps), 6))
    for _ in range(config.iterations):
        corrections = _solve_corrections(
            information, gradient, coefficients, change, weight / deviation**2
        )
        remaining = (
            change + (coefficients * np.stack(_triples(corrections))).sum(axis=0)
        ) / deviation
        window = 2 * config.window_frames + 1
        weight = 1 / np.maximum(1.0, uniform_filter1d(remaining**2, window, axis=0, mode="nearest"))
    return np.asarray(exp_se3(corrections) @ poses, dtype=np.float64)


def _triples(values: Array) -> tuple[Array, Array, Array]:
    """Return the values [n - 2, ...] of the frame before, of the frame, and of the frame after."""
    return values[:-2], values[1:-1], values[2:]


def _information_scale(
    information: Array, coefficients: Array, change: Array, deviation: Array, min_ratio: float
) -> Array:
    """Return the factor [6, 6] by which the frames' stated information is too low.

    With the stated noise, the velocity would change more than it does.
    """
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    stated_variance = (coefficients**2 * np.stack(_triples(variance))).sum(axis=0).mean(axis=0)
    excess = (change**2).mean(axis=0) - (deviation**2).mean(axis=0)
    ratio = np.clip(excess / stated_variance, min_ratio, 1.0)
    return np.asarray(1 / np.sqrt(ratio[:, None] * ratio[None]))


def _solve_corrections(
    information: Array, gradient: Array, coefficients: Array, change: Array, weight: Array
) -> Array:
    """Solve for the corrections [n, 6] that reconcile the frames with smooth velocity.

    Args:
        information: [n, 6, 6] of each frame's pose.
        gradient: [n, 6] information times the correction that the frame's measurements ask for.
        coefficients: [3, n - 2, 1] of the motions of three frames in a change of velocity.
        change: [n - 2, 6] changes of velocity before correction.
        weight: [n - 2, 6] inverse variances of these changes.
    """
    n = len(information)
    # diagonal[k]: blocks that couple frames k apart.
    diagonal, rhs = np.zeros((3, n, 6)), gradient.copy()
    for row in range(3):
        _triples(rhs)[row][...] -= coefficients[row] * weight * change
        for column in range(row + 1):
            _triples(diagonal[row - column])[column][...] += (
                coefficients[row] * coefficients[column] * weight
            )
    band = np.zeros((_BAND, 6 * n))
    for offset in range(6):
        for a in range(offset, 6):
            band[offset, a - offset :: 6] = information[:, a, a - offset]
    for frames in range(3):
        for a in range(6):
            band[6 * frames, a::6] += diagonal[frames, :, a]
    return np.asarray(solveh_banded(band, rhs.ravel(), lower=True)).reshape(n, 6)
