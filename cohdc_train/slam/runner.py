"""Views through the tracker, one after the other: their times, their pictures, and those who watch."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import write_jpeg
from cohdc_train.errors import DataError
from cohdc_train.slam.dynamics.mask_sources import MaskSource
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameRecord, PoseCallback, View
from cohdc_train.slam.io.sources import Source
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.slam.visualization.overlays import draw_after, draw_before


class RunObserver(Protocol):
    """Sees every frame of a run: the recorder of a cloud, a viewer, a robot's own publisher."""

    def __call__(
        self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        """After a frame. mask: [H, W] bool, True = dynamic: what was masked, at rest or not, and
        what depth found to move; None where there was neither. record.pose.T_wc: its pose; when
        record.pose.keyframe, the map's keyframe of the time view.t is this frame."""
        ...


_PICTURES = 6


@dataclass(frozen=True)
class _Picture:
    """What is drawn of a frame when the run is over, so that no time of the run goes into it."""

    view: View
    mask: NDArray[np.bool_] | None
    features: Features


def play(
    tracker: Tracker,
    source: Source,
    mask_of: MaskSource,
    pictures: Path,
    observers: Sequence[RunObserver],
    on_pose: PoseCallback | None = None,
) -> list[FrameRecord]:
    """Track every view, call on_pose as soon as its pose is known, and the watchers when all is
    done with it; then draw some into the new folder `pictures`.

    Raises DataError for a view that cannot be used, unless the source is live and has given some,
    and when none comes.
    """
    count = len(source)
    chosen = _pictured(count)
    records: list[FrameRecord] = []
    drawn: list[_Picture] = []
    try:
        for index, view in enumerate(source):
            mask, record = _step(tracker, view, mask_of, on_pose)
            records.append(record)
            if index in chosen and tracker.features is not None:
                drawn.append(_Picture(view, tracker.mask, tracker.features))
            for observer in observers:
                observer(view, mask, record, tracker)
            _progress(index + 1, count, record)
    except DataError as error:
        if not records or count:
            raise
        print(f"ended: {error}", file=sys.stderr)  # what a live run has so far is not lost
    finally:
        if records and sys.stderr.isatty():
            print(file=sys.stderr)  # ends the line of progress
    if not records:
        raise DataError("no frame came: nothing is written")
    tracker.finish()
    pictures.mkdir()
    for picture in drawn:
        _draw(picture, OrbExtractor(tracker.camera, tracker.budget), pictures)
    return records


def _pictured(count: int) -> set[int]:
    """Which frames are drawn; where nobody knows how many come, the first and then ever rarer ones."""
    if count == 0:
        return {0, *(30 << k for k in range(20))}
    return set(np.linspace(0, count - 1, min(_PICTURES, count)).round().astype(int).tolist())


def _step(
    tracker: Tracker, view: View, mask_of: MaskSource, on_pose: PoseCallback | None
) -> tuple[NDArray[np.bool_] | None, FrameRecord]:
    """One frame: what a watcher gets as its mask, and what became of it."""
    start = time.perf_counter()
    mask = mask_of(view)
    segment_ms = 0.0 if mask is None else 1e3 * (time.perf_counter() - start)
    pose = tracker.track(view.rgb, view.depth, view.t, mask, view.depth_t, on_pose)
    culled = 0.0 if tracker.mask is None else float(tracker.mask.mean())
    # Who is at rest is of use to tracking, but belongs into no cloud.
    mask = tracker.mask if mask is None or tracker.mask is None else mask | tracker.mask
    return mask, FrameRecord(view.stamp, pose, culled, segment_ms, view.depth_ms)


def _draw(picture: _Picture, extract: OrbExtractor, folder: Path) -> None:
    view, mask = picture.view, picture.mask
    before = draw_before(view.rgb, extract(view.rgb, view.depth), mask)
    write_jpeg(folder / f"{view.stamp}_before.jpg", before)
    if mask is not None:
        write_jpeg(folder / f"{view.stamp}_after.jpg", draw_after(view.rgb, picture.features, mask))


def _progress(done: int, count: int, record: FrameRecord) -> None:
    """One line that renews itself on a terminal; elsewhere a line per tenth, or per hundred where
    no end is known.
    """
    state = f"{record.pose.inliers} inliers" if record.pose.tracked else "lost"
    line = f"frame {done}/{count}  {state}" if count else f"frame {done}  {state}"
    if sys.stderr.isatty():
        print(f"\r{line:<50}", end="", file=sys.stderr, flush=True)
    elif done % 100 == 0 if count == 0 else done * 10 // count > (done - 1) * 10 // count:
        print(line, file=sys.stderr, flush=True)
