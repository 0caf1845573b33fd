"""Camera trajectories: TUM text files, association, rigid alignment, ATE and RPE with six
statistics (numpy).

A trajectory file of the TUM RGB-D benchmark has one pose per line: `stamp tx ty tz qx qy qz qw`,
seconds, metres and a unit quaternion, camera to world. Lines that begin with # are comments.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import write_text
from cohdc_train.types import FloatArray

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera over time.

    stamps: [n] float64, s, never falling (files with repeated rows exist); poses: [n, 4, 4]
    float64, T_wc camera to world, m. Raises ValueError when the shapes, the order of the stamps or
    a rotation is wrong.
    """

    stamps: FloatArray
    poses: FloatArray

    def __post_init__(self) -> None:
        stamps, poses = np.asarray(self.stamps, np.float64), np.asarray(self.poses, np.float64)
        object.__setattr__(self, "stamps", stamps)
        object.__setattr__(self, "poses", poses)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 4, 4):
            raise ValueError(
                f"stamps {stamps.shape} and poses {poses.shape} are not [n] and [n, 4, 4]"
            )
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
    Raises DataError with the file and the line for a row that is not eight finite numbers, a
    quaternion of nearly no length, or a stamp earlier than the one before it: nothing is sorted.
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
            raise DataError(
                f"{path}:{number}: stamp {rows[-1][0]!r} is earlier than {rows[-2][0]!r} before it"
            )
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
    for stamp, values in zip(
        trajectory.stamps, np.hstack([trajectory.positions, quaternions]), strict=True
    ):
        time = np.format_float_positional(stamp, trim="0", min_digits=6)
        rows.append(" ".join([time, *(f"{value:.10f}" for value in values)]))
    write_text(path, "\n".join(rows) + "\n")
