"""What a run leaves behind: trajectory, metrics, a row per frame, the resolved config, pictures."""

import csv
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.files import check_folder, publish
from cohdc_train.slam.features import Features
from cohdc_train.slam.pose import Pose
from cohdc_train.trajectory import Trajectory, score, write_tum

_VERB = "slam"
_NAMES = (
    *("trajectory.txt", "metrics.json", "frames.csv", "config.yaml"),
    *("map.ply", "map.png", "pictures"),
)
_GREEN, _RED, _YELLOW = (60, 220, 60), (230, 40, 40), (255, 220, 0)  # RGB


@dataclass(frozen=True)
class FrameRecord:
    """One frame of a run. stamp: as rgb.txt writes it; culled: share of the pixels under the mask; segment_ms: time of
    the mask; depth_ms: of the depth, where it was computed."""

    stamp: str
    pose: Pose
    culled: float
    segment_ms: float
    depth_ms: float = 0.0


def measure(
    records: list[FrameRecord], trajectory: Trajectory, truth: Trajectory | None, dropped: int = 0
) -> dict[str, Any]:
    """The numbers of metrics.json but the seed.

    dropped: frames that came while the tracker was busy and have no record; they count as frames without a pose.
    `coverage` is tracked / associated frames; `ms` has p50 and p95 per stage, `map` over keyframes only, `depth` of
    stereo pairs only; `fps` is frames over the time of all stages. Errors are absent without a truth, and, which is
    told on stderr, where it is of another time.
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
    folder: Path, records: list[FrameRecord], trajectory: Trajectory, metrics: dict[str, Any], config: dict[str, Any]
) -> None:
    """Write trajectory.txt, metrics.json, frames.csv and config.yaml into an existing folder."""
    write_tum(folder / "trajectory.txt", trajectory)
    (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    with (folder / "frames.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["stamp", "tracked", "keyframe", "inliers", "culled_share", "segment_ms", "track_ms", "map_ms"])
        for record in records:
            pose = record.pose
            times = [f"{ms:.2f}" for ms in (record.segment_ms, pose.track_ms, pose.map_ms)]
            culled = f"{record.culled:.4f}"
            writer.writerow([record.stamp, int(pose.tracked), int(pose.keyframe), pose.inliers, culled, *times])


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


def draw_before(rgb: NDArray[np.uint8], features: Features, mask: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """All corners an unmasked search finds: red on the mask, green elsewhere. Returns [H, W, 3] RGB."""
    rows, columns = np.rint(features.pixels[:, 1]).astype(int), np.rint(features.pixels[:, 0]).astype(int)
    on_mask = np.zeros(len(features), dtype=np.bool_) if mask is None else mask[rows, columns]
    image = rgb.copy()
    for x, y, red in zip(columns.tolist(), rows.tolist(), on_mask.tolist(), strict=True):
        cv2.circle(image, (x, y), 2, _RED if red else _GREEN, 1, cv2.LINE_AA)
    return image


def draw_after(rgb: NDArray[np.uint8], features: Features, mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The corners that were kept, and the outline of the mask. Returns [H, W, 3] RGB."""
    image = draw_before(rgb, features, None)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, _YELLOW, 2)
    return image


def write_jpeg(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write [H, W, 3] RGB as JPEG."""
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    path.write_bytes(data.tobytes())
