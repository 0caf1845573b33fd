"""Absolute and relative errors of a trajectory."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.trajectory.association import nearest
from cohdc_train.trajectory.trajectory import FloatArray, Trajectory

Scores = dict[str, dict[str, float]]
MAX_PAIRS = 1_000_000  # up to 1000 poses every pair is used; above, a seeded sample of this size
_CHUNK = 65_536  # pairs computed at a time, which bounds the memory


def align_umeyama(source: FloatArray, target: FloatArray) -> FloatArray:
    """The rigid motion that brings `source` nearest to `target` in least squares (Umeyama 1991,
    without scale).

    source, target: [n, 3] points, m. Returns T [4, 4] with target ~ T @ source.
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


def ate(groundtruth: Trajectory, estimate: Trajectory) -> FloatArray:
    """Absolute trajectory error of matched poses after rigid alignment. Returns [n] distances, m."""
    T = align_umeyama(estimate.positions, groundtruth.positions)
    return np.asarray(np.linalg.norm(estimate.moved(T).positions - groundtruth.positions, axis=1))


def rpe(
    groundtruth: Trajectory, estimate: Trajectory, pairs: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Relative pose error of matched poses over `pairs` ([k, 2] indices i, j).

    The error is E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Q the ground truth and P the estimate. Returns
    the lengths of E's translations [k], m, and the angles of its rotations [k], deg.
    """
    Q, P = groundtruth.poses, estimate.poses
    Q_inverse, P_inverse = np.linalg.inv(Q), np.linalg.inv(P)
    lengths, angles = np.empty(len(pairs)), np.empty(len(pairs))
    for start in range(0, len(pairs), _CHUNK):
        part = slice(start, start + _CHUNK)
        i, j = pairs[part].T
        E = Q_inverse[j] @ Q[i] @ P_inverse[i] @ P[j]
        lengths[part] = np.linalg.norm(E[:, :3, 3], axis=1)
        R = E[:, :3, :3]
        sine2 = np.stack(
            [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]]
        )
        # the arc tangent keeps its digits near 0 degrees, where the arc cosine of the trace loses
        # half of them
        angles[part] = np.degrees(
            np.arctan2(np.linalg.norm(sine2, axis=0), np.trace(R, axis1=1, axis2=2) - 1)
        )
    return lengths, angles


def pairs_apart(
    stamps: FloatArray, delta: float = 1.0, tolerance: float = 0.05
) -> NDArray[np.int64]:
    """For every stamp the one nearest to `delta` s later, where it is within `tolerance` s of that.
    Returns [k, 2].
    """
    j = nearest(stamps, stamps + delta)
    i = np.flatnonzero(np.abs(stamps[j] - stamps - delta) <= tolerance)
    return np.stack([i, j[i]], axis=1)


def all_pairs(n: int, seed: int = 0) -> NDArray[np.int64]:
    """Every ordered pair of n poses, i = j included, as TUM's evaluate_rpe takes them without a
    fixed delta.

    That tool draws 10 000 pairs by chance when there are more; here all n^2 are used up to
    `MAX_PAIRS`, and a sample of that size drawn with `seed` above it, so the same files give the
    same numbers. Returns [k, 2].
    """
    if n * n > MAX_PAIRS:
        return np.random.default_rng(seed).integers(0, n, size=(MAX_PAIRS, 2))
    return np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(np.int64)


def statistics(errors: FloatArray) -> dict[str, float]:
    """The six statistics of the benchmark: rmse mean median std (of the population) min max.
    errors: [n], n > 0.
    """
    values = {
        "rmse": np.sqrt(np.mean(errors**2)),
        "mean": np.mean(errors),
        "median": np.median(errors),
    }
    values |= {"std": np.std(errors), "min": np.min(errors), "max": np.max(errors)}
    return {name: float(value) for name, value in values.items()}
