"""A SLAM run's folder as the report reads it: numbers, frames, poses and errors."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.trajectory.association import match
from cohdc_train.trajectory.metrics import align_umeyama
from cohdc_train.trajectory.trajectory import Trajectory

Floats = NDArray[np.float64]

_PAUSE_S = (
    0.5  # a longer pause between two poses is a gap, whether a frame is listed as lost or not
)
_COLUMNS = ("tracked", "keyframe", "inliers", "culled_share", "segment_ms", "track_ms", "map_ms")


@dataclass(frozen=True)
class Frames:
    """Rows of frames.csv, one a frame that was processed.

    names: timestamps as text, as the images' names have them; timestamps: [n], s; columns: name of
    the file's column -> [n].
    """

    names: Sequence[str]
    timestamps: Floats
    columns: Mapping[str, Floats]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.timestamps)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """[n], True where the frame has no pose."""
        return np.asarray(self.columns["tracked"] == 0)

    def lost_spans(self) -> list[tuple[int, int]]:
        """Return first and last index of every run of lost frames."""
        edges = np.diff(np.concatenate([[0], self.lost.astype(int), [0]]))
        starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
        return list(zip(starts.tolist(), ends.tolist(), strict=True))


@dataclass(frozen=True)
class SlamRun:
    """One SLAM run.

    metrics, config: content of metrics.json and config.yaml; frames: None without frames.csv;
    trajectory: every tracked pose, aligned to the ground truth where there is one, None where none
    was tracked; truth, matched: poses of the same moments, None without ground truth; T: [4, 4]
    from the run's world, which its map is in, to that of `trajectory`.
    """

    label: str
    folder: Path
    metrics: Mapping[str, Any]
    config: Mapping[str, Any]
    frames: Frames | None
    trajectory: Trajectory | None
    truth: Trajectory | None
    matched: Trajectory | None
    T: Floats = field(default_factory=lambda: np.eye(4))

    @property
    def start(self) -> float:
        """Stamp from which the time of plots counts, s."""
        return self.span()[0]

    def span(self) -> tuple[float, float]:
        """Return the times of the first and the last frame, of the poses without frames.csv, s."""
        timestamps = np.zeros(1) if self.trajectory is None else self.trajectory.timestamps
        if self.frames is not None and len(self.frames):
            timestamps = self.frames.timestamps
        return float(timestamps[0]), float(timestamps[-1])

    def errors(self) -> tuple[Floats, Floats] | None:
        """Return timestamps [n], s, and distances to the ground truth [n], m; nan rows at gaps."""
        if self.truth is None or self.matched is None:
            return None
        distances = np.linalg.norm(self.matched.positions - self.truth.positions, axis=1)
        gaps = self.gaps(self.matched.timestamps)
        return np.insert(self.matched.timestamps, gaps, np.nan), np.insert(distances, gaps, np.nan)

    def path(self) -> tuple[Floats, Floats]:
        """Return timestamps [n] and positions [n, 3], m, with a row of nan at every gap."""
        if self.trajectory is None:
            return np.zeros(0), np.zeros((0, 3))
        timestamps, positions = self.trajectory.timestamps, self.trajectory.positions
        gaps = self.gaps(timestamps)
        return np.insert(timestamps, gaps, np.nan), np.insert(positions, gaps, np.nan, axis=0)

    def gaps(self, timestamps: Floats) -> NDArray[np.int64]:
        """Return indices of poses before which tracking paused."""
        broken = np.diff(timestamps) > _PAUSE_S
        if self.frames is not None:
            lost_before = np.searchsorted(self.frames.timestamps[self.frames.lost], timestamps)
            broken |= np.diff(lost_before) > 0
        return np.flatnonzero(broken) + 1

    def length(self) -> float:
        """Return the length of the tracked path, without the gaps, m."""
        steps = np.linalg.norm(np.diff(self.path()[1], axis=0), axis=1)
        return float(np.nansum(steps))


def read_slam_run(label: str, folder: Path, truth: Trajectory | None) -> SlamRun:
    """Read a folder of `cohdc slam`. Raises DataError naming a file that cannot be used."""
    metrics = _read_metrics(folder / "metrics.json")
    config, frames = read_config(folder / "config.yaml"), _read_frames(folder / "frames.csv")
    run = SlamRun(label, folder, metrics, config, frames, None, None, None)
    if metrics["coverage"] == 0:  # nothing was tracked: there is no pose
        return run
    return match_to_truth(run, Trajectory.load_tum(folder / "trajectory.txt"), truth)


def match_to_truth(run: SlamRun, trajectory: Trajectory, truth: Trajectory | None) -> SlamRun:
    """Return a run with its trajectory, aligned to the ground truth where their times match."""
    if truth is None:
        return replace(run, trajectory=trajectory)
    try:
        matched_truth, matched = match(truth, trajectory)
    except DataError:  # of another time: the trajectory stands as it is
        return replace(run, trajectory=trajectory)
    T = align_umeyama(matched.positions, matched_truth.positions)
    moved = trajectory.transformed(T)
    return replace(run, trajectory=moved, truth=matched_truth, matched=matched.transformed(T), T=T)


def find_groundtruth(folder: Path) -> Path | None:
    """Return groundtruth.txt of the sequence that a run was made on, if it is still there."""
    sequence = read_config(folder / "config.yaml").get("sequence")
    if not isinstance(sequence, str):
        return None
    file = Path(sequence) / "groundtruth.txt"
    return file if file.is_file() else None


def read_config(file: Path) -> Mapping[str, Any]:
    """Return a YAML file's mapping, empty where there is no file or none in it.

    Raises DataError for a file that cannot be read.
    """
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{file}: cannot be read as a configuration: {reason}") from error
    return content if isinstance(content, dict) else {}


def _read_metrics(file: Path) -> Mapping[str, Any]:
    try:
        metrics: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        float(metrics["coverage"])
        for time in metrics.get("ms", {}).values():
            float(time["p50"]), float(time["p95"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: cannot be read as metrics: {error!r}") from error
    return metrics


def _read_frames(file: Path) -> Frames | None:
    """Return the rows of frames.csv; None where there is no file."""
    if not file.is_file():
        return None
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            rows = list(reader)
        if missing := {"stamp", *_COLUMNS} - set(reader.fieldnames or ()):
            raise ValueError(f"no column {min(missing)}")
        names = [row["stamp"] for row in rows]
        timestamps = np.array([float(name) for name in names])
        columns = {name: np.array([float(row[name]) for row in rows]) for name in _COLUMNS}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise DataError(f"{file}: cannot be read as a table of frames: {error}") from error
    return Frames(names, timestamps, columns)
