#!/usr/bin/env python3
"""Track a sequence with optical flow as in real time, but without a clock.

    PYTHONPATH=CHECKOUT:CHECKOUT/tools golden_flow.py SEQUENCE OUT

Mapping runs when it is submitted, no frame is dropped, and a fixed pattern stands for the time
that a frame has used, so the result depends on the code alone. Writes poses.npy (as tracked, one
per frame), timestamps.npy and trajectory.npy (as refined at the end), and frames.csv.

The API of the checkout may be older or newer than this file. A class that only moved or got
another name is one more place in a call of `first_of`. Another way to drive the tracker is one
more function in LAYOUTS: it raises ImportError where the checkout has no such classes.
"""

import csv
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_MAX_KEYPOINTS = 600
_TIME_USED = (0.0, 0.1, 0.6, 0.0, 0.9)  # share of the frame period, frame by frame


class FlowRun(NamedTuple):
    """Result of a run.

    poses: (n, 4, 4) online, NaN where lost; rows: of frames.csv; trajectory: (n, 4, 4) at the end.
    """

    poses: list[Any]
    rows: list[tuple[int, int]]
    timestamps: Any
    trajectory: Any


def first_of(*places: str) -> Any:
    """Return the first of several `module:name` that can be imported."""
    for place in places:
        module, _, name = place.partition(":")
        try:
            return getattr(import_module(module), name)
        except (ImportError, AttributeError):
            continue
    raise ImportError(f"none of {', '.join(places)}")


def run_system(sequence: Path) -> FlowRun:
    """Drive `Slam(camera, config, executor=..., frame_time_used=...)`."""
    slam = "cohdc_train.slam"
    executor = first_of(f"{slam}.runtime.executors:SynchronousExecutor")
    system_class = first_of(f"{slam}.system:Slam")
    config = first_of(f"{slam}.config:SlamConfig")()
    single_threaded = first_of(
        f"{slam}.runtime.threads:single_threaded", f"{slam}.runtime.threads:one_thread"
    )
    frames = open_frames(sequence)
    used = 0.0
    poses, rows = [], []
    with single_threaded():
        system = system_class(
            frames.camera,
            config.override({"features.max_keypoints": _MAX_KEYPOINTS}),
            executor=executor(),
            frame_time_used=lambda: used,
        )
        for index, frame in enumerate(frames):
            used = _TIME_USED[index % len(_TIME_USED)]
            result = system.track(frame)
            poses.append(np.full((4, 4), np.nan) if result.T_wc is None else result.T_wc)
            rows.append((int(result.is_keyframe), result.num_matches))
        trajectory = system.finish()
    timestamps = getattr(trajectory, "timestamps", None)
    timestamps = trajectory.timestamps if timestamps is None else timestamps
    return FlowRun(poses, rows, timestamps, trajectory.poses)


def run_tracker(sequence: Path) -> FlowRun:
    """Drive the Tracker of old checkouts, which takes its options as single arguments."""
    slam = "cohdc_train.slam"
    executor = first_of(
        f"{slam}.runtime.executors:SynchronousExecutor",
        f"{slam}.runtime.executors:AtOnce",
        "at_once:AtOnce",
    )
    tracker_class = first_of(f"{slam}.tracking.tracker:Tracker", f"{slam}.tracking:Tracker")
    single_threaded = first_of(
        f"{slam}.runtime.threads:single_threaded",
        f"{slam}.runtime.threads:one_thread",
        f"{slam}.one_thread:one_thread",
    )
    frames = open_frames(sequence)
    used = 0.0
    poses, rows = [], []
    with single_threaded():
        parts = {"executor": executor(), "spent": lambda: used}
        tracker = tracker_class(frames.camera, _MAX_KEYPOINTS, **parts)
        for index, frame in enumerate(frames):
            used = _TIME_USED[index % len(_TIME_USED)]
            result = tracker.track(frame.rgb, frame.depth, frame.t, None, frame.depth_t)
            poses.append(np.full((4, 4), np.nan) if result.T_wc is None else result.T_wc)
            rows.append((int(result.keyframe), result.inliers))
        tracker.finish()
    timestamps, trajectory = tracker.trajectory()
    return FlowRun(poses, rows, timestamps, trajectory)


def open_frames(sequence: Path) -> Any:
    """Open a recorded RGB-D sequence."""
    slam = "cohdc_train.slam"
    choose_camera = first_of(
        f"{slam}.geometry.calibration:choose_camera",
        f"{slam}.camera:choose_camera",
    )
    recorded = first_of(
        f"{slam}.io.sources:RecordedSequence",
        f"{slam}.io.sources:Recorded",
        f"{slam}.source:Recorded",
    )
    return recorded(sequence, choose_camera(sequence, None)[0])


# The newest first.
LAYOUTS: tuple[Callable[[Path], FlowRun], ...] = (run_system, run_tracker)


def run_layout(sequence: Path) -> FlowRun:
    """Run the first layout that the checkout has."""
    problems = []
    for layout in LAYOUTS:
        try:
            return layout(sequence)
        except ImportError as error:
            problems.append(f"{layout.__name__}: {error}")
    raise SystemExit(f"golden_flow.py knows no layout of this checkout: {'; '.join(problems)}")


def main() -> None:
    """Track and write."""
    sequence, out = Path(sys.argv[1]), Path(sys.argv[2])
    result = run_layout(sequence)
    out.mkdir(parents=True)
    np.save(out / "poses.npy", np.stack(result.poses))
    np.save(out / "timestamps.npy", np.asarray(result.timestamps))
    np.save(out / "trajectory.npy", np.asarray(result.trajectory))
    with (out / "frames.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([("keyframe", "inliers"), *result.rows])


if __name__ == "__main__":
    main()
