"""Smoothing of a trajectory by the motion model, when the sequence is over.

The fixed-interval counterpart of the motion model: velocity changes as there, unless it is seen to
change faster, but later frames count as well. All poses are solved for at once.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from cohdc_train.slam.config import MotionModelConfig, SmoothingConfig
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3

_BAND = 18  # diagonals of the normal equations: three frames hang together


@dataclass(frozen=True)
class TrackedPoses:
    """Poses of n frames, and what each frame knows of its own.

    timestamps: [n] s, rising; T_cw: [n, 4, 4] world to camera, m; information: [n, 6, 6] inverse
    covariance of each pose by the frame's measurements, in the camera's frame, (m, rad);
    prior_gradients: [n, 6] `Prior.gradient` of the motion prior at each pose, 0 where none counted.
    """

    timestamps: Array
    T_cw: Array
    information: Array
    prior_gradients: Array

    def split(self, rows: NDArray[np.int64]) -> list["TrackedPoses"]:
        """Split before the given rows."""
        parts = [
            np.split(values, rows)
            for values in (self.timestamps, self.T_cw, self.information, self.prior_gradients)
        ]
        return [TrackedPoses(*part) for part in zip(*parts, strict=True)]


def smooth_trajectory(
    tracked: TrackedPoses, config: SmoothingConfig, motion: MotionModelConfig
) -> Array:
    """Return smoothed poses [n, 4, 4] T_cw, m.

    The motion prior that a pose was found with is taken out, for what came before counts here
    anyway. Frames further apart than motion.max_gap_s are smoothed separately.
    """
    step = np.diff(tracked.timestamps)
    is_gap = (step <= motion.min_gap_s) | (step > motion.max_gap_s)
    runs = tracked.split(np.flatnonzero(is_gap) + 1)
    return np.concatenate([_smooth_run(run, config, motion) for run in runs])


def _smooth_run(tracked: TrackedPoses, config: SmoothingConfig, motion: MotionModelConfig) -> Array:
    """Smooth frames without a gap between them."""
    timestamps, poses = tracked.timestamps, tracked.T_cw
    if len(timestamps) < 3:
        return poses
    before, after = np.diff(timestamps)[:-1], np.diff(timestamps)[1:]
    shares = np.stack([1 / before, -1 / before - 1 / after, 1 / after])[..., None]
    deviation = np.repeat(motion.acceleration_sigma, 3) * ((before + after) / 2)[:, None]
    motions = log_se3(poses[1:] @ inverse(poses[:-1]))
    change = motions[1:] / after[:, None] - motions[:-1] / before[:, None]
    certain, axes = np.linalg.eigh(tracked.information)
    certain = np.maximum(certain, config.min_information)
    away = np.einsum("nab,nb,ncb,nc->na", axes, 1 / certain, axes, tracked.prior_gradients)
    weights = certain / (1 + certain * config.pose_floor**2)
    seen = (axes * weights[:, None]) @ axes.transpose(0, 2, 1)
    seen = seen * _sharper(seen, shares, change, deviation, config.min_variance_ratio)
    towards = np.einsum("nab,nb->na", seen, away)
    weight, small = np.ones_like(change), np.zeros((len(timestamps), 6))
    for _ in range(config.iterations):
        small = _solved(seen, towards, shares, change, weight / deviation**2)
        left = (change + (shares * np.stack(_threes(small))).sum(axis=0)) / deviation
        window = 2 * config.window_frames + 1
        weight = 1 / np.maximum(1.0, uniform_filter1d(left**2, window, axis=0, mode="nearest"))
    return np.asarray(exp_se3(small) @ poses, dtype=np.float64)


def _threes(values: Array) -> tuple[Array, Array, Array]:
    """values: [n, ...] of frames. Those of the frame before, of the frame and of the one after, [n
    - 2, ...] each.
    """
    return values[:-2], values[1:-1], values[2:]


def _sharper(
    seen: Array, shares: Array, change: Array, deviation: Array, min_ratio: float
) -> Array:
    """[6, 6] how much more frames know than they say: with so much noise velocity would change more
    than it does.
    """
    own = np.diagonal(np.linalg.inv(seen), axis1=1, axis2=2)
    foreseen = (shares**2 * np.stack(_threes(own))).sum(axis=0).mean(axis=0)
    excess = (change**2).mean(axis=0) - (deviation**2).mean(axis=0)
    share = np.clip(excess / foreseen, min_ratio, 1.0)
    return np.asarray(1 / np.sqrt(share[:, None] * share[None]))


def _solved(seen: Array, towards: Array, shares: Array, change: Array, weight: Array) -> Array:
    """[n, 6] the small motions that reconcile frames with changes of velocity [n - 2, 6].

    seen: [n, 6, 6] information; towards: [n, 6] the same times the small motion to where what a
    frame saw puts it;
    shares: [3, n - 2, 1] of the motions of three frames in a change; weight: [n - 2, 6].
    """
    n = len(seen)
    diagonal, right = (
        np.zeros((3, n, 6)),
        towards.copy(),
    )  # by how many frames a block lies below the diagonal
    for row in range(3):
        _threes(right)[row][...] -= shares[row] * weight * change
        for column in range(row + 1):
            _threes(diagonal[row - column])[column][...] += shares[row] * shares[column] * weight
    band = np.zeros((_BAND, 6 * n))
    for offset in range(6):
        for a in range(offset, 6):
            band[offset, a - offset :: 6] = seen[:, a, a - offset]
    for frames in range(3):
        for a in range(6):
            band[6 * frames, a::6] += diagonal[frames, :, a]
    return np.asarray(solveh_banded(band, right.ravel(), lower=True)).reshape(n, 6)
