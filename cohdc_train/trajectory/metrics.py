"""Absolute and relative errors of a trajectory."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.trajectory.association import match, nearest
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray

Scores = dict[str, dict[str, float]]
MAX_PAIRS = 1_000_000  # up to 1000 poses all pairs are used; above, a seeded sample of this size
_CHUNK = 65_536  # pairs computed at a time, which bounds the memory


def align_umeyama(source: FloatArray, target: FloatArray) -> FloatArray:
    """Compute the rigid motion that aligns points in least squares (Umeyama 1991, without scale).

    Args:
        source: [n, 3], m.
        target: [n, 3], m.

    Returns:
        T [4, 4] with target ~ T @ source.
    """
    mean_source, mean_target = source.mean(0), target.mean(0)
    T = np.eye(4)
    T[:3, :3] = nearest_rotation((target - mean_target).T @ (source - mean_source))
    T[:3, 3] = mean_target - T[:3, :3] @ mean_source
    return T


def nearest_rotation(covariance: FloatArray) -> FloatArray:
    """Compute the rotations that align centered points in least squares (Kabsch).

    Args:
        covariance: [..., 3, 3] sum of target times source transposed.

    Returns:
        [..., 3, 3], never a reflection.
    """
    U, _, Vt = np.linalg.svd(covariance)
    signs = np.ones(covariance.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * signs[..., None, :]) @ Vt)


def align_to_truth(groundtruth: Trajectory, estimate: Trajectory) -> Trajectory:
    """Align all poses of an estimate to the ground truth, by the poses whose times match.

    Raises:
        DataError: fewer than three poses match.
    """
    matched_truth, matched = match(groundtruth, estimate)
    T = align_umeyama(matched.positions, matched_truth.positions)
    return estimate.transformed(T)


def ate(groundtruth: Trajectory, estimate: Trajectory) -> FloatArray:
    """Compute the absolute trajectory error of matched poses after rigid alignment: [n], m."""
    T = align_umeyama(estimate.positions, groundtruth.positions)
    offsets = estimate.transformed(T).positions - groundtruth.positions
    return np.asarray(np.linalg.norm(offsets, axis=1))


def rpe(
    groundtruth: Trajectory, estimate: Trajectory, pairs: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Compute the relative pose error of matched poses over pairs.

    The error is E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Q the ground truth and P the estimate.

    Args:
        groundtruth: true trajectory.
        estimate: estimated trajectory, row by row matched.
        pairs: [k, 2] indices i, j.

    Returns:
        The lengths of E's translations [k], m, and the angles of its rotations [k], deg.
    """
    Q, P = groundtruth.poses, estimate.poses
    Q_inverse, P_inverse = np.linalg.inv(Q), np.linalg.inv(P)
    lengths, angles = np.empty(len(pairs)), np.empty(len(pairs))
    for start in range(0, len(pairs), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        i, j = pairs[chunk].T
        E = Q_inverse[j] @ Q[i] @ P_inverse[i] @ P[j]
        lengths[chunk] = np.linalg.norm(E[:, :3, 3], axis=1)
        angles[chunk] = np.degrees(_rotation_angles(E[:, :3, :3]))
    return lengths, angles


def _rotation_angles(R: FloatArray) -> FloatArray:
    """Compute the angles of rotations [k, 3, 3]: [k], rad.

    The arc tangent keeps its digits near 0, where the arc cosine of the trace loses half of them.
    """
    x = R[:, 2, 1] - R[:, 1, 2]
    y = R[:, 0, 2] - R[:, 2, 0]
    z = R[:, 1, 0] - R[:, 0, 1]
    double_sine = np.linalg.norm(np.stack([x, y, z]), axis=0)
    double_cosine = np.trace(R, axis1=1, axis2=2) - 1
    return np.asarray(np.arctan2(double_sine, double_cosine))


def pairs_apart(
    timestamps: FloatArray, delta: float = 1.0, tolerance: float = 0.05
) -> NDArray[np.int64]:
    """Pair each timestamp with the one nearest to `delta` s later.

    Args:
        timestamps: [n], s, rising.
        delta: s.
        tolerance: largest deviation from delta, s; other pairs are dropped.

    Returns:
        [k, 2] indices.
    """
    j = nearest(timestamps, timestamps + delta)
    i = np.flatnonzero(np.abs(timestamps[j] - timestamps - delta) <= tolerance)
    return np.stack([i, j[i]], axis=1)


def all_pairs(n: int, seed: int = 0) -> NDArray[np.int64]:
    """Pair n poses in all ordered ways, i = j included, as TUM's evaluate_rpe without a delta.

    That tool draws 10 000 pairs at random when there are more. Here all n^2 are used up to
    `MAX_PAIRS`, and above it a sample of that size drawn with `seed`, so that the same files give
    the same numbers.

    Returns:
        [k, 2] indices.
    """
    if n * n > MAX_PAIRS:
        return np.random.default_rng(seed).integers(0, n, size=(MAX_PAIRS, 2))
    return np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(np.int64)


def statistics(errors: FloatArray) -> dict[str, float]:
    """Compute the benchmark's six statistics: rmse, mean, median, std (population), min, max.

    errors: [n], n > 0.
    """
    values = {
        "rmse": np.sqrt(np.mean(errors**2)),
        "mean": np.mean(errors),
        "median": np.median(errors),
        "std": np.std(errors),
        "min": np.min(errors),
        "max": np.max(errors),
    }
    return {name: float(value) for name, value in values.items()}
