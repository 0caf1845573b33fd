#!/usr/bin/env python3
"""Measure without a clock what real time costs: delayed masks, and optical flow between matches.

    tools/experiments/late_masks.py --sequences SEQUENCE ... --out OUT [--model person]
        [--late 0 3] [--features 1475 1500 1525]

Tracks TUM-format sequences as `cohdc slam --realtime` does, but mapping is done immediately, no
frame is dropped, and the segmenter always takes --late frames: the same numbers on every machine.
`--settings flow.enabled=false` matches every frame, as synchronous runs do. A few keypoints more or
fewer show what is chance. OUT/late_masks.json has every run's ATE RMSE, OUT/late_masks.md the
means. Without --model masks are those in the sequence's folder `masks`.
"""

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path

from slam_settings import add_settings_option

from cohdc_train.errors import CohdcError, DataError
from cohdc_train.files import write_json, write_text
from cohdc_train.segmenter import Segmenter
from cohdc_train.slam.config import MaskConfig, SlamConfig
from cohdc_train.slam.dynamics.mask_propagation import (
    PropagatedMask,
    SegmentationJob,
    downsample_mask,
)
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, SegmenterMasks
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import RecordedSequence, rgbd_format
from cohdc_train.slam.runtime.async_masks import SegmentFunction
from cohdc_train.slam.runtime.executors import SynchronousExecutor
from cohdc_train.slam.runtime.threads import single_threaded
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import Mask


class LateMasks:
    """Masks as `AsyncSegmenter` makes them, of a segmenter that takes `late` frames.

    The first frame waits for its mask.
    """

    def __init__(self, segment: SegmentFunction, late: int) -> None:
        self._segment, self._late = segment, late
        self._carried = PropagatedMask()
        self._at_work: SegmentationJob | None = None

    def __call__(self, view: RGBDFrame) -> Mask:
        """[H, W] bool, True = dynamic."""
        if self._late == 0:
            return dilate_mask(*self._segment(view))
        job = self._carried.advance(view)
        if self._at_work is not None and job.number >= self._at_work.number + self._late:
            self._done(self._at_work)
        if self._carried.newest is None:
            self._done(job)
        elif self._at_work is None:
            self._at_work = job
        return self._carried.mask(view)

    def _done(self, job: SegmentationJob) -> None:
        mask, growth = self._segment(job.frame)
        self._carried.update(job, downsample_mask(mask), growth)
        self._at_work = None


def remembered(segment: SegmentFunction) -> SegmentFunction:
    """Cache a segmenter's masks by frame name."""
    known: dict[str, tuple[Mask, float]] = {}

    def ask(view: RGBDFrame) -> tuple[Mask, float]:
        if view.name not in known:
            known[view.name] = segment(view)
        return known[view.name]

    return ask


def opened(folder: Path, model: Path | None) -> tuple[RecordedSequence, SegmentFunction]:
    """Open a sequence, and the source of its masks.

    Raises:
        DataError: a file cannot be used.
    """
    camera = choose_camera(folder, None)[0]
    source = RecordedSequence(folder, camera, rgbd_format(camera))
    if source.groundtruth is None:
        raise DataError(f"{folder}: no groundtruth.txt to score by")
    if model is None:
        return source, remembered(MaskFolder(folder / "masks", camera, MaskConfig()).segment)
    return source, remembered(SegmenterMasks(Segmenter(model), MaskConfig()).segment)


def error(
    source: RecordedSequence, masks: Callable[[RGBDFrame], Mask], settings: SlamConfig
) -> float:
    """Return the ATE RMSE, m."""
    with single_threaded():
        slam = Slam(source.camera, settings, executor=SynchronousExecutor())
        for frame in source:
            slam.track(frame, masks(frame))
        trajectory = slam.finish()
    assert source.groundtruth is not None
    rmse: float = score(Trajectory.load_tum(source.groundtruth), trajectory)["ate_m"]["rmse"]
    return rmse


def settings_of(arguments: argparse.Namespace, max_keypoints: int) -> SlamConfig:
    """Return the settings of a run."""
    options = {"features.max_keypoints": max_keypoints, **arguments.settings}
    return SlamConfig().override(options)


def main() -> None:
    """Run, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=Path, nargs="+", required=True, metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--model", type=Path, help="ONNX or a shipped network's name")
    parser.add_argument("--late", type=int, nargs="+", default=[0, 3], help="frames")
    parser.add_argument(
        "--features", type=int, nargs="+", default=[1475, 1500, 1525], help="corners a frame"
    )
    add_settings_option(parser)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        run(arguments)
    except CohdcError as failure:
        raise SystemExit(str(failure)) from None


def run(arguments: argparse.Namespace) -> None:
    """Run all sequences, and write the table after every line."""
    rows, lines = (
        [],
        ["| sequence | late by frames | mean ATE RMSE, m | each |", "|---|---|---|---|"],
    )
    for folder in arguments.sequences:
        source, segment = opened(folder, arguments.model)
        for late in arguments.late:
            errors = [
                error(source, LateMasks(segment, late), settings_of(arguments, n))
                for n in arguments.features
            ]
            rows += [
                {"sequence": folder.name, "late": late, "features": n, "ate_m": e}
                for n, e in zip(arguments.features, errors, strict=True)
            ]
            each = " ".join(f"{e:.4f}" for e in errors)
            lines.append(f"| {folder.name} | {late} | {statistics.mean(errors):.4f} | {each} |")
            print(lines[-1], flush=True)
            write_json(arguments.out / "late_masks.json", rows)
            write_text(arguments.out / "late_masks.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
