"""`cohdc evaluate`: errors of a trajectory against ground truth."""

from pathlib import Path

import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.files import write_json
from cohdc_train.trajectory.association import match, nearest
from cohdc_train.trajectory.metrics import Scores, all_pairs, ate, pairs_apart, rpe, statistics
from cohdc_train.trajectory.trajectory import Trajectory

COVERAGE_GAP_S = 0.05  # a true pose is covered when an estimate is this near in time


def score(groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02) -> Scores:
    """Compute ATE and both RPEs, six statistics each: ate_m, rpe_1s_m, rpe_1s_deg, rpe_all_pairs_m.

    rpe_1s is drift per second; its keys are absent when no two matched poses are 1 s apart.
    rpe_all_pairs, TUM's default, tends to sqrt(2) ATE and serves comparisons with published tables.

    Args:
        groundtruth: true trajectory.
        estimate: estimated trajectory.
        max_difference: largest difference of two timestamps of one moment, s.

    Raises:
        DataError: fewer than three poses match.
    """
    groundtruth, estimate = match(groundtruth, estimate, max_difference)
    scores = {"ate_m": statistics(ate(groundtruth, estimate))}
    second = pairs_apart(estimate.timestamps)
    if len(second):
        meters, degrees = rpe(groundtruth, estimate, second)
        scores |= {"rpe_1s_m": statistics(meters), "rpe_1s_deg": statistics(degrees)}
    meters, _ = rpe(groundtruth, estimate, all_pairs(len(estimate)))
    scores["rpe_all_pairs_m"] = statistics(meters)
    return scores


def coverage(groundtruth: Trajectory, estimate: Trajectory) -> float:
    """Compute the share of true poses with an estimate at most `COVERAGE_GAP_S` away in time.

    A trajectory file does not say how many frames there were; this shows the time during which a
    tracker was lost.
    """
    nearest_times = estimate.timestamps[nearest(estimate.timestamps, groundtruth.timestamps)]
    gaps = np.abs(nearest_times - groundtruth.timestamps)
    return float(np.mean(gaps <= COVERAGE_GAP_S))


def evaluate(
    groundtruth: Path | str,
    estimate: Path | str,
    out: Path | str | None = None,
    max_difference: float = 0.02,
) -> dict[str, object]:
    """Score an estimated trajectory against ground truth; both are TUM text files.

    Prints and returns ATE (rigid alignment, no scale), RPE over 1 s and RPE over all pairs, six
    statistics each, `coverage` (share of true poses with an estimate within 0.05 s) and `pairs`
    (number of matched poses).

    Args:
        groundtruth: TUM file of the true trajectory.
        estimate: TUM file of the estimated trajectory.
        out: JSON file for the same numbers and the paths of both files.
        max_difference: largest difference of two timestamps of one moment, s.

    Raises:
        DataError: a file cannot be used. Names file and line.
    """
    truth, guess = Trajectory.load_tum(groundtruth), Trajectory.load_tum(estimate)
    try:
        scores = score(truth, guess, max_difference)
    except DataError as error:
        raise DataError(f"{estimate}: {error}") from error
    pairs = len(match(truth, guess, max_difference)[0])
    covered = coverage(truth, guess)
    result: dict[str, object] = {**scores, "coverage": covered, "pairs": pairs}

    print(f"{'':<16}" + "".join(f"{name:>10}" for name in scores["ate_m"]))
    for key, row in scores.items():
        print(f"{key:<16}" + "".join(f"{value:>10.4f}" for value in row.values()))
    print(f"pairs {pairs} of {len(guess)} estimated poses, coverage {100 * covered:.1f} %")
    if out is not None:
        out = Path(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        paths = {"groundtruth": groundtruth, "estimate": estimate}
        files = {name: str(Path(path).resolve()) for name, path in paths.items()}
        write_json(out, {**result, **files})  # `cohdc report` draws what lies there
    return result
