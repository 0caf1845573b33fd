"""Camera trajectories: TUM text files, association, rigid alignment, ATE and RPE with six statistics (numpy).

A trajectory file of the TUM RGB-D benchmark has one pose per line: `stamp tx ty tz qx qy qz qw`, seconds, metres and a
unit quaternion, camera to world. Lines that begin with # are comments.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import write_json, write_text

FloatArray = NDArray[np.float64]
Scores = dict[str, dict[str, float]]

_LOG = logging.getLogger(__name__)
COVERAGE_GAP_S = 0.05  # a ground-truth pose counts as covered when an estimate lies this near in time, s
MAX_PAIRS = 1_000_000  # up to 1000 poses every pair is used; above, a seeded sample of this size
_CHUNK = 65_536  # pairs computed at a time, which bounds the memory


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera over time.

    stamps: [n] float64, s, never falling (files with repeated rows exist); poses: [n, 4, 4] float64, T_wc camera to
    world, m. Raises ValueError when the shapes, the order of the stamps or a rotation is wrong.
    """

    stamps: FloatArray
    poses: FloatArray

    def __post_init__(self) -> None:
        stamps, poses = np.asarray(self.stamps, np.float64), np.asarray(self.poses, np.float64)
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "poses", poses)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise ValueError(f"stamps {stamps.shape} and poses {poses.shape} are not [n] and [n, 4, 4]")
        if not (np.isfinite(stamps).all() and np.isfinite(poses).all()):
            raise ValueError("a stamp or a pose is not finite")
        if (np.diff(stamps) < 0).any():
            raise ValueError(f"stamps fall after index {int(np.argmax(np.diff(stamps) < 0))}")
        rotations = poses[:, :3, :3]
        gram = rotations.transpose(0, 2, 1) @ rotations
        rigid = np.allclose(gram, np.eye(3), atol=1e-5) and (np.linalg.det(rotations) > 0).all()
        if not rigid or (poses[:, 3] != (0, 0, 0, 1)).any():
            raise ValueError("a pose is not a rotation and a translation over the row 0 0 0 1")

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> FloatArray:
        """[n, 3] camera centres in the world, m."""
        return self.poses[:, :3, 3]

    def take(self, indices: NDArray[np.int64]) -> "Trajectory":
        """The poses at `indices` ([k], never falling)."""
        return Trajectory(self.stamps[indices], self.poses[indices])

    def moved(self, T: FloatArray) -> "Trajectory":
        """The same trajectory seen from another world: every pose becomes T @ T_wc. T: [4, 4], m."""
        return Trajectory(self.stamps, T @ self.poses)


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory file; commas count as spaces, blank lines and # comments are skipped.

    Rows that repeat a stamp (real files hold them) are kept, and a warning is logged.
    Raises DataError with the file and the line for a row that is not eight finite numbers, a quaternion of nearly no
    length, or a stamp earlier than the one before it: nothing is sorted.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as a trajectory: {error}") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        rows.append(_row(line, f"{path}:{number}"))
        if len(rows) > 1 and rows[-1][0] < rows[-2][0]:
            raise DataError(f"{path}:{number}: stamp {rows[-1][0]!r} is earlier than {rows[-2][0]!r} before it")
    if not rows:
        raise DataError(f"{path}: holds no pose")
    from scipy.spatial.transform import Rotation

    table = np.array(rows)
    if repeated := int((np.diff(table[:, 0]) == 0).sum()):
        _LOG.warning("%s: %d rows repeat the stamp before them; each row counts", path, repeated)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0], poses)


def _row(line: str, place: str) -> list[float]:
    try:
        values = [float(word) for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise DataError(f"{place}: {error}") from error
    if len(values) != 8:
        raise DataError(f"{place}: {len(values)} numbers where stamp tx ty tz qx qy qz qw are 8")
    if not np.isfinite(values).all():
        raise DataError(f"{place}: a number is not finite")
    if np.linalg.norm(values[4:]) < 1e-6:
        raise DataError(f"{place}: quaternion of length {np.linalg.norm(values[4:]):.1e}")
    return values


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory file, whole or not at all; stamps come back exactly, poses to 1e-9."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat(canonical=True)
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, values in zip(trajectory.stamps, np.hstack([trajectory.positions, quaternions]), strict=True):
        time = np.format_float_positional(stamp, trim="0", min_digits=6)
        rows.append(" ".join([time, *(f"{value:.10f}" for value in values)]))
    write_text(path, "\n".join(rows) + "\n")


def associate(a: FloatArray, b: FloatArray, max_difference: float = 0.02) -> NDArray[np.int64]:
    """Pairs of stamps at most `max_difference` s apart, each stamp used once, the nearest pairs chosen first.

    a: [n], b: [m], strictly increasing, s. Returns [k, 2] indices into a and b, both columns increasing. The rule is
    that of the TUM benchmark's associate tool, except that two pairs which would cross in time are uncrossed.
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


def match(groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02) -> tuple[Trajectory, Trajectory]:
    """Both trajectories cut down to their associated poses, row by row; each keeps its own stamps.

    Distinct stamps are associated; a row of the estimate that repeats a stamp is matched as that stamp is, as evo does.
    Raises DataError when fewer than three poses match: nothing could be aligned.
    """
    truth_stamps, truth_rows = np.unique(groundtruth.stamps, return_index=True)
    stamps, stamp_of_row = np.unique(estimate.stamps, return_inverse=True)
    pairs = associate(truth_stamps, stamps, max_difference)
    partner = np.full(len(stamps), -1)
    partner[pairs[:, 1]] = truth_rows[pairs[:, 0]]
    partner = partner[stamp_of_row]
    matched = np.flatnonzero(partner >= 0)
    if len(matched) < 3:
        raise DataError(f"{len(matched)} of {len(estimate)} poses lie within {max_difference} s of the ground truth")
    return groundtruth.take(partner[matched]), estimate.take(matched)


def align_umeyama(source: FloatArray, target: FloatArray) -> FloatArray:
    """The rigid motion that brings `source` nearest to `target` in least squares (Umeyama 1991, without scale).

    source, target: [n, 3] points, m. Returns T [4, 4] with target ~ T @ source.
    """
    mean_source, mean_target = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((target - mean_target).T @ (source - mean_source))
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # a rotation, never a reflection
    T = np.eye(4)
    T[:3, :3] = U @ S @ Vt
    T[:3, 3] = mean_target - T[:3, :3] @ mean_source
    return T


def ate(groundtruth: Trajectory, estimate: Trajectory) -> FloatArray:
    """Absolute trajectory error of matched poses after rigid alignment. Returns [n] distances, m."""
    T = align_umeyama(estimate.positions, groundtruth.positions)
    return np.asarray(np.linalg.norm(estimate.moved(T).positions - groundtruth.positions, axis=1))


def rpe(groundtruth: Trajectory, estimate: Trajectory, pairs: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Relative pose error of matched poses over `pairs` ([k, 2] indices i, j).

    The error is E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Q the ground truth and P the estimate. Returns the lengths of E's
    translations [k], m, and the angles of its rotations [k], deg.
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
        sine2 = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
        # the arc tangent keeps its digits near 0 degrees, where the arc cosine of the trace loses half of them
        angles[part] = np.degrees(np.arctan2(np.linalg.norm(sine2, axis=0), np.trace(R, axis1=1, axis2=2) - 1))
    return lengths, angles


def _nearest(stamps: FloatArray, wanted: FloatArray) -> NDArray[np.int64]:
    after = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(wanted - stamps[before]) <= np.abs(stamps[after] - wanted), before, after)


def pairs_apart(stamps: FloatArray, delta: float = 1.0, tolerance: float = 0.05) -> NDArray[np.int64]:
    """For every stamp the one nearest to `delta` s later, where it is within `tolerance` s of that. Returns [k, 2]."""
    j = _nearest(stamps, stamps + delta)
    i = np.flatnonzero(np.abs(stamps[j] - stamps - delta) <= tolerance)
    return np.stack([i, j[i]], axis=1)


def all_pairs(n: int, seed: int = 0) -> NDArray[np.int64]:
    """Every ordered pair of n poses, i = j included, as TUM's evaluate_rpe takes them without a fixed delta.

    That tool draws 10 000 pairs by chance when there are more; here all n^2 are used up to `MAX_PAIRS`, and a sample
    of that size drawn with `seed` above it, so the same files give the same numbers. Returns [k, 2].
    """
    if n * n > MAX_PAIRS:
        return np.random.default_rng(seed).integers(0, n, size=(MAX_PAIRS, 2))
    return np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(np.int64)


def statistics(errors: FloatArray) -> dict[str, float]:
    """The six statistics of the benchmark: rmse mean median std (of the population) min max. errors: [n], n > 0."""
    values = {"rmse": np.sqrt(np.mean(errors**2)), "mean": np.mean(errors), "median": np.median(errors)}
    values |= {"std": np.std(errors), "min": np.min(errors), "max": np.max(errors)}
    return {name: float(value) for name, value in values.items()}


def score(groundtruth: Trajectory, estimate: Trajectory, max_difference: float = 0.02) -> Scores:
    """ATE and both RPEs, six statistics each: ate_m, rpe_1s_m, rpe_1s_deg, rpe_all_pairs_m.

    rpe_1s is drift per second; rpe_all_pairs, TUM's default, tends to sqrt(2) ATE and is kept to compare with tables
    that used it. The rpe_1s keys are absent when no two matched poses lie 1 s apart.
    Raises DataError when fewer than three poses match within `max_difference` s.
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
    """Share of the ground truth's poses with an estimated pose at most `COVERAGE_GAP_S` away in time, 0..1.

    A trajectory file does not tell how many frames there were; this shows the time in which a tracker was lost.
    """
    gaps = np.abs(estimate.stamps[_nearest(estimate.stamps, groundtruth.stamps)] - groundtruth.stamps)
    return float(np.mean(gaps <= COVERAGE_GAP_S))


def evaluate(
    groundtruth: Path, estimate: Path, out: Path | None = None, max_difference: float = 0.02
) -> dict[str, object]:
    """Score an estimated trajectory against ground truth; both are TUM text files.

    Prints and returns ATE (rigid alignment, no scale), RPE over 1 s and RPE over all pairs, six statistics each,
    `coverage` (share of ground-truth poses with an estimate within 0.05 s) and `pairs` (matched poses).
    Raises DataError naming the file, and the line, that cannot be used.

    Args:
        groundtruth: TUM file of the true trajectory.
        estimate: TUM file of the estimated trajectory.
        out: JSON file to write the same numbers to.
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
    print(f"pairs {pairs} of {len(guess)} estimated poses, coverage {100 * coverage(truth, guess):.1f} %")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, result)
    return result
