"""What a run leaves behind: trajectory, metrics, a row per frame, the resolved config, pictures."""

import csv
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cohdc_train.errors import DataError
from cohdc_train.files import check_folder, publish
from cohdc_train.slam.frame import FrameRecord
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

_VERB = "slam"
_NAMES = (
    *("trajectory.txt", "metrics.json", "frames.csv", "config.yaml"),
    *("map.ply", "map.png", "pictures"),
)


def measure(
    records: list[FrameRecord], trajectory: Trajectory, truth: Trajectory | None, dropped: int = 0
) -> dict[str, Any]:
    """The numbers of metrics.json but the seed.

    dropped: frames that came while the tracker was busy and have no record; they count as frames
    without a pose. `coverage` is tracked / associated frames; `ms` has p50 and p95 per stage, `map`
    over keyframes only, `depth` of stereo pairs only; `fps` is frames over the time of all stages.
    Errors are absent without a truth, and, which is told on stderr, where it is of another time.
    """
    poses = [record.pose for record in records]
    depth = [record.depth_ms for record in records]
    times = ({"depth": depth} if any(depth) else {}) | {
        "segment": [record.segment_ms for record in records],
        "track": [pose.track_ms for pose in poses],
        "map": [pose.map_ms for pose in poses if pose.keyframe],
    }
    tracked = sum(pose.tracked for pose in poses)
    busy = sum(sum(row) for row in times.values())
    result: dict[str, Any] = {
        "frames": len(poses) + dropped,
        "tracked": tracked,
        "coverage": tracked / (len(poses) + dropped),
        "keyframes": sum(pose.keyframe for pose in poses),
        "fps": 1e3 * len(poses) / busy,
        "ms": {stage: quantiles(row) for stage, row in times.items()},
    }
    if truth is not None and tracked >= 3:
        try:
            result.update(score(truth, trajectory))
        except DataError as error:
            print(f"no scores: {error}", file=sys.stderr)
    return result


def quantiles(values: list[float]) -> dict[str, float]:
    """p50 and p95; 0 where there is no value."""
    array = np.array(values or [0.0])
    return {"p50": float(np.quantile(array, 0.5)), "p95": float(np.quantile(array, 0.95))}


def write_run(
    folder: Path,
    records: list[FrameRecord],
    trajectory: Trajectory,
    metrics: dict[str, Any],
    config: dict[str, Any],
) -> None:
    """Write trajectory.txt, metrics.json, frames.csv and config.yaml into an existing folder."""
    trajectory.save_tum(folder / "trajectory.txt")
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    with (folder / "frames.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            [
                "stamp",
                "tracked",
                "keyframe",
                "inliers",
                "culled_share",
                "segment_ms",
                "track_ms",
                "map_ms",
            ]
        )
        for record in records:
            pose = record.pose
            times = [f"{ms:.2f}" for ms in (record.segment_ms, pose.track_ms, pose.map_ms)]
            culled = f"{record.culled:.4f}"
            writer.writerow(
                [record.stamp, int(pose.tracked), int(pose.keyframe), pose.inliers, culled, *times]
            )


def publish_run(part: Path, out: Path) -> None:
    """Move the files of a run into `out`, in place of those of a former one.

    A file that somebody else put there during the run stays, and is named on stderr.
    """
    for name in publish(part, out, _VERB):
        print(f"{out / name}: is not of a run and was kept; this run's is lost", file=sys.stderr)


def check_out(out: Path, cloud: bool) -> None:
    """Raise DataError when `out` cannot become a folder of results. Makes the folder above it.

    cloud: whether the run writes cloud.ply.
    """
    check_folder(out, _VERB, [*_NAMES, "cloud.ply"] if cloud else _NAMES)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        for folder in (out.parent, out):
            if folder.exists():
                tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror}") from error
