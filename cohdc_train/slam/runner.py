"""Run of the SLAM system over a sequence, with records, figures, and observers."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import write_jpeg
from cohdc_train.errors import DataError
from cohdc_train.slam.dynamics.mask_sources import MaskSource
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameRecord, FrameResult, PoseCallback, RGBDFrame
from cohdc_train.slam.io.sources import FrameSource
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.system import Slam
from cohdc_train.slam.visualization.overlays import draw_after, draw_before
from cohdc_train.trajectory.trajectory import Trajectory

_NUM_FIGURES = 6


class RunObserver(Protocol):
    """Observer of every frame of a run, such as a viewer or a robot's publisher."""

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Observe a frame after all work on it.

        Where result.is_keyframe, the keyframe of frame.timestamp in the map is this frame. The
        arrays of the result belong to the map: copy the ones that you change.
        """
        ...


@dataclass(frozen=True)
class _Figure:
    """Content of a figure, which is drawn when the run is over."""

    frame: RGBDFrame
    mask: NDArray[np.bool_] | None
    features: Features


@dataclass(frozen=True)
class TrackedSequence:
    """Result of a run.

    records: one per frame; trajectory: final poses of the tracked frames.
    """

    records: list[FrameRecord]
    trajectory: Trajectory


def track_sequence(
    slam: Slam,
    source: FrameSource,
    mask_of: MaskSource,
    figures: Path,
    observers: Sequence[RunObserver] = (),
    on_pose: PoseCallback | None = None,
) -> TrackedSequence:
    """Track every frame of a source, finish the map, and draw figures into a new folder.

    Args:
        slam: the SLAM system.
        source: of frames.
        mask_of: returns a frame's mask.
        figures: folder for the figures, which must not exist.
        observers: called after all work on a frame.
        on_pose: called with each frame's result as soon as its pose is known.

    Raises:
        DataError: a frame cannot be used, unless the source is live and had frames before; or the
            source has no frames.
    """
    count = len(source)
    drawn_frames = _drawn_frames(count)
    records: list[FrameRecord] = []
    drawn: list[_Figure] = []
    try:
        for index, frame in enumerate(source):
            result = _track(slam, frame, mask_of, on_pose)
            records.append(_record(frame, result))
            if index in drawn_frames and result.features is not None:
                drawn.append(_Figure(frame, result.dynamic_mask, result.features))
            for observer in observers:
                observer(frame, result, slam.map)
            _print_progress(index + 1, count, result)
    except DataError as error:
        if not records or count:
            raise
        print(f"ended: {error}", file=sys.stderr)  # the frames of a live run so far are kept
    finally:
        if records and sys.stderr.isatty():
            print(file=sys.stderr)  # ends the line of progress
    if not records:
        raise DataError("the source has no frames; nothing is written")
    trajectory = slam.finish()
    figures.mkdir()
    for figure in drawn:
        _draw(figure, OrbExtractor(slam.camera, slam.config.features), figures)
    return TrackedSequence(records, trajectory)


def _drawn_frames(count: int) -> set[int]:
    """Return the indices of the frames to draw, at growing intervals where the end is unknown."""
    if count == 0:
        return {0, *(30 << k for k in range(20))}
    chosen = np.linspace(0, count - 1, min(_NUM_FIGURES, count)).round().astype(int)
    return set(chosen.tolist())


def _track(
    slam: Slam, frame: RGBDFrame, mask_of: MaskSource, on_pose: PoseCallback | None
) -> FrameResult:
    """Make the mask of a frame, and track it."""
    start = time.perf_counter()
    mask = mask_of(frame)
    mask_ms = 0.0 if mask is None else 1e3 * (time.perf_counter() - start)
    result = slam.track(frame, mask, on_pose)
    return replace(result, timing=replace(result.timing, mask_ms=mask_ms))


def _record(frame: RGBDFrame, result: FrameResult) -> FrameRecord:
    """Return the row of a frame."""
    mask = result.dynamic_mask
    return FrameRecord(
        frame.timestamp_text,
        result.is_tracked,
        result.is_keyframe,
        result.num_matches,
        result.num_inliers,
        masked_ratio=0.0 if mask is None else float(mask.mean()),
        timing=result.timing,
    )


def _draw(figure: _Figure, extract: OrbExtractor, folder: Path) -> None:
    """Draw the keypoints of a frame without its mask and with it."""
    frame, mask = figure.frame, figure.mask
    name = frame.timestamp_text
    before = draw_before(frame.rgb, extract(frame.rgb, frame.depth), mask)
    write_jpeg(folder / f"{name}_before.jpg", before)
    if mask is not None:
        write_jpeg(folder / f"{name}_after.jpg", draw_after(frame.rgb, figure.features, mask))


def _print_progress(done: int, count: int, result: FrameResult) -> None:
    """Print the progress: one line on a terminal, otherwise a line per tenth of the frames.

    Where the number of frames is unknown, a line is printed per hundred frames.
    """
    state = f"{result.num_inliers} inliers" if result.is_tracked else "lost"
    line = f"frame {done}/{count}  {state}" if count else f"frame {done}  {state}"
    if sys.stderr.isatty():
        print(f"\r{line:<50}", end="", file=sys.stderr, flush=True)
    elif done % 100 == 0 if count == 0 else done * 10 // count > (done - 1) * 10 // count:
        print(line, file=sys.stderr, flush=True)
