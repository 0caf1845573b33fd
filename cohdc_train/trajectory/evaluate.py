"""`cohdc evaluate`: errors of a trajectory against ground truth."""

from pathlib import Path

import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.files import write_json
from cohdc_train.trajectory.association import match, nearest
from cohdc_train.trajectory.metrics import Scores, all_pairs, ate, pairs_apart, rpe, statistics
from cohdc_train.trajectory.trajectory import Trajectory, read_tum

COVERAGE_GAP_S = (
    0.05  # a ground-truth pose counts as covered when an estimate lies this near in time, s
)


def score(groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02) -> Scores:
    """ATE and both RPEs, six statistics each: ate_m, rpe_1s_m, rpe_1s_deg, rpe_all_pairs_m.

    rpe_1s is drift per second; rpe_all_pairs, TUM's default, tends to sqrt(2) ATE and is kept to
    compare with tables that used it. The rpe_1s keys are absent when no two matched poses lie 1 s
    apart. Raises DataError when fewer than three poses match within `max_difference` s.
    """
    groundtruth, estimate = match(groundtruth, estimate, max_difference)
    scores = {"ate_m": statistics(ate(groundtruth, estimate))}
    second = pairs_apart(estimate.stamps)
    if len(second):
        metres, degrees = rpe(groundtruth, estimate, second)
        scores |= {"rpe_1s_m": statistics(metres), "rpe_1s_deg": statistics(degrees)}
    scores["rpe_all_pairs_m"] = statistics(rpe(groundtruth, estimate, all_pairs(len(estimate)))[0])
    return scores


def coverage(groundtruth: Trajectory, estimate: Trajectory) -> float:
    """Share of the ground truth's poses with an estimated pose at most `COVERAGE_GAP_S` away in
    time, 0..1.

    A trajectory file does not tell how many frames there were; this shows the time in which a
    tracker was lost.
    """
    gaps = np.abs(
        estimate.stamps[nearest(estimate.stamps, groundtruth.stamps)] - groundtruth.stamps
    )
    return float(np.mean(gaps <= COVERAGE_GAP_S))


def evaluate(
    groundtruth: Path, estimate: Path, out: Path | None = None, max_difference: float = 0.02
) -> dict[str, object]:
    """Score an estimated trajectory against ground truth; both are TUM text files.

    Prints and returns ATE (rigid alignment, no scale), RPE over 1 s and RPE over all pairs, six
    statistics each, `coverage` (share of ground-truth poses with an estimate within 0.05 s) and
    `pairs` (matched poses). Raises DataError naming the file, and the line, that cannot be used.

    Args:
        groundtruth: TUM file of the true trajectory.
        estimate: TUM file of the estimated trajectory.
        out: JSON file to write the same numbers to, and the names of both files.
        max_difference: largest difference of two stamps that are taken as one moment, s.
    """
    truth, guess = read_tum(groundtruth), read_tum(estimate)
    try:
        scores = score(truth, guess, max_difference)
    except DataError as error:
        raise DataError(f"{estimate}: {error}") from error
    pairs = len(match(truth, guess, max_difference)[0])
    result: dict[str, object] = {**scores, "coverage": coverage(truth, guess), "pairs": pairs}
    print(f"{'':<16}" + "".join(f"{name:>10}" for name in scores["ate_m"]))
    for key, row in scores.items():
        print(f"{key:<16}" + "".join(f"{value:>10.4f}" for value in row.values()))
    print(
        f"pairs {pairs} of {len(guess)} estimated poses, coverage {100 * coverage(truth, guess):.1f} %"
    )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        files = {"groundtruth": str(groundtruth.resolve()), "estimate": str(estimate.resolve())}
        write_json(out, {**result, **files})  # `cohdc report` draws what lies there
    return result
