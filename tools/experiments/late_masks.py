#!/usr/bin/env python3
"""What real time costs without a clock: masks that are late by so many frames, and optical flow
between matched frames.

    tools/experiments/late_masks.py --sequences SEQUENCE ... --out OUT [--model person]
        [--late 0 3] [--features 1475 1500 1525]

Tracks TUM-format sequences as `cohdc slam --realtime` does, but mapping is done at once, no frame
is dropped, and the segmenter always takes --late frames: the same numbers on every machine.
`--method flow=false` matches every frame, as synchronous runs do. A few corners more or fewer show
what is chance. OUT/late_masks.json has every run's ATE RMSE, OUT/late_masks.md the means. Without
--model masks are those in the sequence's folder `masks`.
"""

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path

from slam_method import add_method_option

from cohdc_train.errors import CohdcError, DataError
from cohdc_train.files import write_json, write_text
from cohdc_train.segmenter import Segmenter
from cohdc_train.slam.config import Culling, Method
from cohdc_train.slam.dynamics.mask_propagation import CarriedMasks, Job, halve_mask
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, SegmenterMasks
from cohdc_train.slam.dynamics.masks import grow
from cohdc_train.slam.frame import View
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import Recorded, rgbd_layout
from cohdc_train.slam.runtime.async_masks import Outline
from cohdc_train.slam.runtime.executors import SynchronousExecutor
from cohdc_train.slam.runtime.threads import one_thread
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import Mask


class LateMasks:
    """Masks as `AsyncMasks` makes them, of a segmenter that takes `late` frames; the first is
    waited for.
    """

    def __init__(self, outline: Outline, late: int) -> None:
        self._outline, self._late = outline, late
        self._carried = CarriedMasks()
        self._at_work: Job | None = None

    def __call__(self, view: View) -> Mask:
        """[H, W] bool, True = dynamic."""
        if self._late == 0:
            return grow(*self._outline(view))
        job = self._carried.advance(view)
        if self._at_work is not None and job.number >= self._at_work.number + self._late:
            self._done(self._at_work)
        if self._carried.newest is None:
            self._done(job)
        elif self._at_work is None:
            self._at_work = job
        return self._carried.mask(view)

    def _done(self, job: Job) -> None:
        mask, growth = self._outline(job.view)
        self._carried.renew(job, halve_mask(mask), growth)
        self._at_work = None


def remembered(outline: Outline) -> Outline:
    """The same, asked once for every frame."""
    known: dict[str, tuple[Mask, float]] = {}

    def ask(view: View) -> tuple[Mask, float]:
        if view.name not in known:
            known[view.name] = outline(view)
        return known[view.name]

    return ask


def opened(folder: Path, model: Path | None) -> tuple[Recorded, Outline]:
    """A sequence, and what outlines its people. Raises DataError for what cannot be used."""
    camera = choose_camera(folder, None)[0]
    source = Recorded(folder, camera, rgbd_layout(camera))
    if source.groundtruth is None:
        raise DataError(f"{folder}: no groundtruth.txt to score by")
    if model is None:
        return source, remembered(MaskFolder(folder / "masks", camera, Culling()).outline)
    return source, remembered(SegmenterMasks(Segmenter(model), Culling()).outline)


def error(source: Recorded, masks: Callable[[View], Mask], features: int, method: Method) -> float:
    """ATE RMSE, m."""
    with one_thread():
        tracker = Tracker(source.camera, features, 0, method, SynchronousExecutor())
        for view in source:
            tracker.track(view.rgb, view.depth, view.t, masks(view), view.depth_t)
        tracker.finish()
    assert source.groundtruth is not None
    rmse: float = score(Trajectory.load_tum(source.groundtruth), Trajectory(*tracker.trajectory()))[
        "ate_m"
    ]["rmse"]
    return rmse


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
    add_method_option(parser)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        run(arguments)
    except CohdcError as failure:
        raise SystemExit(str(failure)) from None


def run(arguments: argparse.Namespace) -> None:
    """What there is so far is written after every line."""
    rows, lines = (
        [],
        ["| sequence | late by frames | mean ATE RMSE, m | each |", "|---|---|---|---|"],
    )
    for folder in arguments.sequences:
        source, outline = opened(folder, arguments.model)
        for late in arguments.late:
            errors = [
                error(source, LateMasks(outline, late), n, arguments.method)
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
