"""Camera trajectories, and their files in the format of the TUM RGB-D benchmark.

A file has one pose per line: `timestamp tx ty tz qx qy qz qw`, s, m and a unit quaternion, camera
to world. Lines that begin with # are comments.
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

    Attributes:
        timestamps: float64 [n], s, never falling; files with repeated timestamps exist.
        poses: float64 [n, 4, 4], T_wc camera to world, m.

    Raises:
        ValueError: a shape, the order of the timestamps or a rotation is wrong.
    """

    timestamps: FloatArray
    poses: FloatArray

    def __post_init__(self) -> None:
        """Convert to float64 arrays and check them."""
        timestamps = np.asarray(self.timestamps, np.float64)
        poses = np.asarray(self.poses, np.float64)
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "poses", poses)
        if timestamps.ndim != 1 or poses.shape != (len(timestamps), 4, 4):
            shapes = f"timestamps {timestamps.shape} and poses {poses.shape}"
            raise ValueError(f"{shapes} are not [n] and [n, 4, 4]")
        if not (np.isfinite(timestamps).all() and np.isfinite(poses).all()):
            raise ValueError("a timestamp or a pose is not finite")
        falls = np.diff(timestamps) < 0
        if falls.any():
            raise ValueError(f"timestamps fall after index {int(np.argmax(falls))}")
        _check_poses(poses)

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.timestamps)

    @classmethod
    def load_tum(cls, path: str | Path) -> "Trajectory":
        """Load a TUM trajectory file.

        Commas count as spaces; blank lines and # comments are skipped. Rows that repeat a timestamp
        (real files hold them) are kept, and a warning is logged. Nothing is sorted.

        Raises:
            DataError: the file cannot be read, or a row is not eight finite numbers with a valid
                quaternion, or its timestamp is earlier than the one before. Names file and line.
        """
        path = Path(path)
        table = _read_rows(path)
        if repeated := int((np.diff(table[:, 0]) == 0).sum()):
            message = "%s: %d rows repeat the timestamp before them; each row counts"
            _LOG.warning(message, path, repeated)

        from scipy.spatial.transform import Rotation

        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
        poses[:, :3, 3] = table[:, 1:4]
        return cls(table[:, 0], poses)

    def save_tum(self, path: str | Path) -> None:
        """Save as a TUM trajectory file, whole or not at all.

        Timestamps come back exactly, poses to 1e-9.

        Raises:
            DataError: the file cannot be written.
        """
        from scipy.spatial.transform import Rotation

        quaternions = Rotation.from_matrix(self.poses[:, :3, :3]).as_quat(canonical=True)
        values = np.hstack([self.positions, quaternions])
        lines = ["# timestamp tx ty tz qx qy qz qw"]
        for timestamp, row in zip(self.timestamps, values, strict=True):
            time = np.format_float_positional(timestamp, trim="0", min_digits=6)
            lines.append(" ".join([time, *(f"{value:.10f}" for value in row)]))
        write_text(Path(path), "\n".join(lines) + "\n")

    @property
    def positions(self) -> FloatArray:
        """Positions of the camera in the world: [n, 3], m."""
        return self.poses[:, :3, 3]

    def take(self, indices: NDArray[np.int64]) -> "Trajectory":
        """Return the poses at some indices. indices: [k], never falling."""
        return Trajectory(self.timestamps[indices], self.poses[indices])

    def transformed(self, T: FloatArray) -> "Trajectory":
        """Return the trajectory in another world frame: each pose becomes T @ T_wc.

        T: [4, 4] rigid motion, m.
        """
        return Trajectory(self.timestamps, T @ self.poses)


def _check_poses(poses: FloatArray) -> None:
    """Raise ValueError unless all poses are rigid motions. poses: [n, 4, 4]."""
    rotations = poses[:, :3, :3]
    gram = rotations.transpose(0, 2, 1) @ rotations
    is_rigid = np.allclose(gram, np.eye(3), atol=1e-5) and (np.linalg.det(rotations) > 0).all()
    if not is_rigid or (poses[:, 3] != (0, 0, 0, 1)).any():
        raise ValueError("a pose is not a rotation and a translation over the row 0 0 0 1")


def _read_rows(path: Path) -> FloatArray:
    """Read the rows of a TUM trajectory file: [n, 8]."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as a trajectory: {error}") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        place = f"{path}:{number}"
        row = _parse_row(line, place)
        if rows and row[0] < rows[-1][0]:
            raise DataError(
                f"{place}: timestamp {row[0]!r} is earlier than {rows[-1][0]!r} before it"
            )
        rows.append(row)
    if not rows:
        raise DataError(f"{path}: holds no pose")
    return np.array(rows)


def _parse_row(line: str, place: str) -> list[float]:
    """Parse eight numbers. place: file and line, for the message of a DataError."""
    try:
        values = [float(word) for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise DataError(f"{place}: {error}") from error
    if len(values) != 8:
        raise DataError(f"{place}: {len(values)} numbers; timestamp tx ty tz qx qy qz qw are 8")
    if not np.isfinite(values).all():
        raise DataError(f"{place}: a number is not finite")
    length = np.linalg.norm(values[4:])
    if length < 1e-6:
        raise DataError(f"{place}: quaternion of length {length:.1e}")
    return values
