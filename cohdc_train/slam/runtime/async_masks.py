"""Segmenter in parallel with tracking: its newest mask is propagated to each frame."""

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MaskConfig, RealtimeConfig
from cohdc_train.slam.dynamics.mask_propagation import (
    PropagatedMask,
    SegmentationJob,
    downsample_mask,
)
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.runtime.latest_slot import LatestSlot
from cohdc_train.types import Mask

# Frame to mask [H, W], True = dynamic, and the dilation that is due, px.
SegmentFunction = Callable[[RGBDFrame], tuple[Mask, float]]


@dataclass(frozen=True)
class _FinishedJob:
    """Job with its mask [h, w] at half size, the dilation that is due, and the time it took."""

    job: SegmentationJob
    mask: NDArray[np.bool_]
    dilation_px: float
    ms: float


class AsyncSegmenter:
    """Mask source with a segmenter that is slower than the frames come; use it in a `with` block.

    The segmenter runs in a thread, on the newest frame whenever it is free. Frames that come while
    it is busy are not queued. Only the first frame waits for its mask.

    Attributes:
        ages: of the mask of each frame, s.
        segment_ms: time of the segmenter for each mask, ms.
    """

    def __init__(
        self,
        segment: SegmentFunction,
        masks: MaskConfig = MaskConfig(),
        realtime: RealtimeConfig = RealtimeConfig(),
    ) -> None:
        """Prepare the thread.

        Args:
            segment: the segmenter, without dilation.
            masks: propagation of masks.
            realtime: niceness of the thread.
        """
        self.ages: list[float] = []
        self.segment_ms: list[float] = []
        self._segment = segment
        self._nice = realtime.worker_nice
        self._propagated = PropagatedMask(masks)
        self._jobs: LatestSlot[SegmentationJob] = LatestSlot()
        self._results: LatestSlot[_FinishedJob] = LatestSlot()
        self._is_busy = False
        self._worker = threading.Thread(target=self._work, name="segmenter", daemon=True)

    def __enter__(self) -> "AsyncSegmenter":
        """Start the thread."""
        self._worker.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for the thread, which gets no further job."""
        self._jobs.poll()
        self._jobs.close()
        self._worker.join()

    def __call__(self, frame: RGBDFrame) -> Mask:
        """Return the newest mask [H, W] bool, True = dynamic, propagated to a frame.

        Frames must come in the order of time. An error of the segmenter is raised.
        """
        job = self._propagated.advance(frame)
        self._apply(self._results.poll())
        if not self._is_busy:
            self._jobs.put(job)
            self._is_busy = True
        if self._propagated.newest is None:
            self._apply(self._results.take())
        newest = self._propagated.newest or job
        self.ages.append(frame.timestamp - newest.frame.timestamp)
        return self._propagated.mask(frame)

    def _apply(self, finished: _FinishedJob | None) -> None:
        """Replace the mask by that of a finished job, if there is one."""
        if finished is None:
            return
        self._is_busy = False
        self.segment_ms.append(finished.ms)
        self._propagated.update(finished.job, finished.mask, finished.dilation_px)

    def _work(self) -> None:
        """Segment frames until there is no further job; the thread's function."""
        if sys.platform == "linux":
            os.nice(self._nice)  # on Linux it applies to this thread alone
        try:
            while (job := self._jobs.take()) is not None:
                start = time.perf_counter()
                mask, dilation_px = self._segment(job.frame)
                half = downsample_mask(mask)
                ms = 1e3 * (time.perf_counter() - start)
                self._results.put(_FinishedJob(job, half, dilation_px, ms))
        except Exception as error:
            self._results.close(error)
