"""Association of an estimate with ground truth by time."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray


def associate(a: FloatArray, b: FloatArray, max_difference: float = 0.02) -> NDArray[np.int64]:
    """Pairs of stamps at most `max_difference` s apart, each stamp used once, the nearest pairs
    chosen first.

    a: [n], b: [m], strictly increasing, s. Returns [k, 2] indices into a and b, both columns
    increasing. The rule is that of the TUM benchmark's associate tool, except that two pairs which
    would cross in time are uncrossed.
    """
    first = np.searchsorted(b, a - max_difference, side="left")
    counts = np.searchsorted(b, a + max_difference, side="right") - first
    i = np.repeat(np.arange(len(a)), counts)
    j = np.arange(len(i)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    order = np.argsort(np.abs(a[i] - b[j]), kind="stable")
    free_a, free_b = np.ones(len(a), bool), np.ones(len(b), bool)
    pairs = []
    for p, q in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if free_a[p] and free_b[q]:
            free_a[p] = free_b[q] = False
            pairs.append((p, q))
    return np.sort(np.array(pairs, dtype=np.int64).reshape(-1, 2), axis=0)


def match(
    groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02
) -> tuple[Trajectory, Trajectory]:
    """Both trajectories cut down to their associated poses, row by row; each keeps its own stamps.

    Distinct stamps are associated; a row of the estimate that repeats a stamp is matched as that
    stamp is, as evo does. Raises DataError when fewer than three poses match: nothing could be
    aligned.
    """
    truth_stamps, truth_rows = np.unique(groundtruth.stamps, return_index=True)
    stamps, stamp_of_row = np.unique(estimate.stamps, return_inverse=True)
    pairs = associate(truth_stamps, stamps, max_difference)
    partner = np.full(len(stamps), -1)
    partner[pairs[:, 1]] = truth_rows[pairs[:, 0]]
    partner = partner[stamp_of_row]
    matched = np.flatnonzero(partner >= 0)
    if len(matched) < 3:
        raise DataError(
            f"{len(matched)} of {len(estimate)} poses lie within {max_difference} s of the ground truth"
        )
    return groundtruth.take(partner[matched]), estimate.take(matched)


def nearest(stamps: FloatArray, wanted: FloatArray) -> NDArray[np.int64]:
    """Return the row of the stamp nearest to each wanted time. stamps: [n], rising, s; wanted: [m],
    s.
    """
    after = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(
        np.abs(wanted - stamps[before]) <= np.abs(stamps[after] - wanted), before, after
    )
