"""Association of trajectories by time."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray


def associate(a: FloatArray, b: FloatArray, max_difference: float = 0.02) -> NDArray[np.int64]:
    """Pair timestamps, each used once, the nearest pairs chosen first.

    The rule is that of the TUM benchmark's associate tool, except that two pairs which would cross
    in time are uncrossed.

    Args:
        a: [n], s, strictly increasing.
        b: [m], s, strictly increasing.
        max_difference: largest difference of a pair, s.

    Returns:
        [k, 2] indices into a and b, both columns increasing.
    """
    first = np.searchsorted(b, a - max_difference, side="left")
    counts = np.searchsorted(b, a + max_difference, side="right") - first
    i = np.repeat(np.arange(len(a)), counts)
    j = np.arange(len(i)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    order = np.argsort(np.abs(a[i] - b[j]), kind="stable")

    is_free_a, is_free_b = np.ones(len(a), bool), np.ones(len(b), bool)
    pairs = []
    for p, q in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if is_free_a[p] and is_free_b[q]:
            is_free_a[p] = is_free_b[q] = False
            pairs.append((p, q))
    return np.sort(np.array(pairs, dtype=np.int64).reshape(-1, 2), axis=0)


def match(
    groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02
) -> tuple[Trajectory, Trajectory]:
    """Cut two trajectories down to their associated poses, row by row.

    Distinct timestamps are associated; a row of the estimate that repeats a timestamp is matched as
    that timestamp is, as evo does. Each trajectory keeps its own timestamps.

    Args:
        groundtruth: true trajectory.
        estimate: estimated trajectory.
        max_difference: largest difference of two timestamps, s.

    Raises:
        DataError: fewer than three poses match, so that nothing can be aligned.
    """
    truth_times, truth_rows = np.unique(groundtruth.timestamps, return_index=True)
    times, time_of_row = np.unique(estimate.timestamps, return_inverse=True)
    pairs = associate(truth_times, times, max_difference)
    partner = np.full(len(times), -1)
    partner[pairs[:, 1]] = truth_rows[pairs[:, 0]]
    partner = partner[time_of_row]
    matched = np.flatnonzero(partner >= 0)
    if len(matched) < 3:
        counts = f"{len(matched)} of {len(estimate)} poses"
        raise DataError(f"{counts} lie within {max_difference} s of the ground truth")
    return groundtruth.take(partner[matched]), estimate.take(matched)


def nearest(timestamps: FloatArray, queries: FloatArray) -> NDArray[np.int64]:
    """Return the index of the timestamp nearest to each query: [m].

    Args:
        timestamps: [n], s, rising.
        queries: [m], s.
    """
    after = np.minimum(np.searchsorted(timestamps, queries), len(timestamps) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(queries - timestamps[before]) <= np.abs(timestamps[after] - queries)
    return np.where(is_before, before, after)
