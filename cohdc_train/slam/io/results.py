"""Result files of a run: trajectory, metrics, one row per frame, and the resolved options."""

import csv
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.files import check_folder, publish
from cohdc_train.slam.frame import FrameRecord
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

_VERB = "slam"
_TEXT_FILES = ("trajectory.txt", "metrics.json", "frames.csv", "config.yaml")
_NAMES = (*_TEXT_FILES, "map.ply", "map.png", "pictures")
DENSE_CLOUD = "cloud.ply"
ANIMATION = "animation.webp"
_MIN_SCORED_FRAMES = 3  # fewer poses fix no rigid alignment
_COLUMNS = (
    *("stamp", "tracked", "keyframe", "matches", "inliers", "culled_share"),
    *("segment_ms", "track_ms", "map_ms"),
)


def compute_metrics(
    records: list[FrameRecord], trajectory: Trajectory, truth: Trajectory | None, dropped: int = 0
) -> dict[str, Any]:
    """Compute the numbers of metrics.json.

    `coverage` is tracked over associated frames. `ms` has p50 and p95 of each stage: `map` is of
    one keyframe, with the work for it on later frames, `depth` of stereo pairs only, `segment` is
    each frame's wait for its mask. `fps` is frames over the time of all stages.

    Args:
        records: of the frames that reached the tracker.
        trajectory: final, of the tracked frames.
        truth: true trajectory. Where it covers another time, stderr says so, and errors are absent
            as they are without it.
        dropped: frames that came while the tracker was busy; they count as not tracked.
    """
    times = _stage_times(records)
    num_tracked = sum(record.is_tracked for record in records)
    total_ms = sum(sum(row) for row in times.values())
    num_frames = len(records) + dropped
    metrics: dict[str, Any] = {
        "frames": num_frames,
        "tracked": num_tracked,
        "coverage": num_tracked / num_frames,
        "keyframes": sum(record.is_keyframe for record in records),
        "fps": 1e3 * len(records) / total_ms,
        "ms": {stage: quantiles(row) for stage, row in times.items()},
    }
    if truth is not None and num_tracked >= _MIN_SCORED_FRAMES:
        try:
            metrics.update(score(truth, trajectory))
        except DataError as error:
            print(f"no scores: {error}", file=sys.stderr)
    return metrics


def _stage_times(records: list[FrameRecord]) -> dict[str, list[float]]:
    """Return the times of each stage, ms."""
    timings = [record.timing for record in records]
    depth = [timing.depth_ms for timing in timings]
    times = {"depth": depth} if any(depth) else {}
    times["segment"] = [timing.mask_ms for timing in timings]
    times["track"] = [timing.tracking_ms for timing in timings]
    times["map"] = _mapping_times(records)
    return times


def _mapping_times(records: list[FrameRecord]) -> list[float]:
    """Return the time of mapping per keyframe, ms, with the work that later frames did for it."""
    times: list[float] = []
    for record in records:
        if record.is_keyframe or not times:
            times.append(0.0)
        times[-1] += record.timing.mapping_ms
    return times


def quantiles(values: list[float]) -> dict[str, float]:
    """Return p50 and p95 of some values; 0 where there are none."""
    array = np.array(values or [0.0])
    return {"p50": float(np.quantile(array, 0.5)), "p95": float(np.quantile(array, 0.95))}


def write_run(
    folder: Path,
    records: list[FrameRecord],
    trajectory: Trajectory,
    metrics: dict[str, Any],
    config: str,
) -> None:
    """Write trajectory.txt, metrics.json, frames.csv and config.yaml into an existing folder."""
    trajectory.save_tum(folder / "trajectory.txt")
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    (folder / "config.yaml").write_text(config, encoding="utf-8")
    with (folder / "frames.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(_row(record) for record in records)


def _row(record: FrameRecord) -> list[object]:
    """Return the row of a frame in frames.csv."""
    timing = record.timing
    times = (timing.mask_ms, timing.tracking_ms, timing.mapping_ms)
    return [
        record.timestamp_text,
        int(record.is_tracked),
        int(record.is_keyframe),
        record.num_matches,
        record.num_inliers,
        f"{record.masked_ratio:.4f}",
        *(f"{ms:.2f}" for ms in times),
    ]


def format_summary(metrics: dict[str, Any]) -> str:
    """Return the small table at the end of a run."""
    tracked = f"{metrics['tracked']} of {metrics['frames']} tracked"
    in_map = f"{metrics['keyframes_in_map']} of them in the map at the end"
    rows = [
        ("frames", f"{tracked} ({100 * metrics['coverage']:.1f} %)"),
        ("keyframes", f"{metrics['keyframes']}, {in_map}"),
        ("loops closed", str(metrics["loops"])),
        ("frames/s", f"{metrics['fps']:.1f}"),
    ]
    times = {f"{stage} ms": quantiles for stage, quantiles in metrics["ms"].items()}
    if metrics["realtime"]:
        rows.append(("dropped", str(metrics["dropped"])))
        names = {
            "segmenter_ms": "segmenter ms",
            "mask_age_ms": "mask age ms",
            "latency_ms": "latency ms",
        }
        times |= {text: metrics[key] for key, text in names.items() if key in metrics}
    rows += [(name, f"p50 {q['p50']:.1f}  p95 {q['p95']:.1f}") for name, q in times.items()]
    for key in ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m"):
        if key in metrics:
            values = [f"{name} {value:.4f}" for name, value in metrics[key].items()]
            rows.append((key, "  ".join(values)))
    return "\n".join(f"  {name:<16}{text}" for name, text in rows)


def move_into_place(part: Path, out: Path) -> None:
    """Move the files of a run into the output folder, in place of those of a former run.

    A file that someone else put there during the run stays, and stderr names it.
    """
    for name in publish(part, out, _VERB):
        problem = "was written by another program during the run, and is kept"
        print(f"{out / name}: {problem}; the file of this run is lost", file=sys.stderr)


def check_output_dir(out: Path, extras: Sequence[str] = ()) -> None:
    """Check that a folder can take the results of a run, and create the folder above it.

    Args:
        out: the folder.
        extras: files that the run writes as well.

    Raises:
        DataError: the folder cannot be written, or holds files of others with these names.
    """
    check_folder(out, _VERB, [*_NAMES, *extras])
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        for folder in (out.parent, out):
            if folder.exists():
                tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror}") from error
