"""Masks without waiting for the segmenter: it works beside tracking, and its newest mask is carried
to every frame.
"""

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.mask_propagation import CarriedMasks, Job, halve_mask
from cohdc_train.slam.frame import View
from cohdc_train.slam.runtime.executors import NICE
from cohdc_train.slam.runtime.latest_slot import LatestSlot
from cohdc_train.types import Mask

Outline = Callable[[View], tuple[Mask, float]]


@dataclass(frozen=True)
class _Done:
    job: Job
    mask: NDArray[np.bool_]  # half size
    growth: float  # px
    ms: float


class AsyncMasks:
    """A mask for every frame from a segmenter that keeps up with only some.

    outline: view -> mask [H, W], True = dynamic, and by how many px it is to grow. It runs in a
    thread, on the newest frame whenever it is free; those that come while it is busy are not kept
    for it, for a fresher one comes soon. Only the first frame waits for its mask. Use inside
    `with`.

    ages: s, per frame, from the frame its mask was made of; segment_ms: time of each mask in the
    worker.
    """

    def __init__(self, outline: Outline) -> None:
        self.ages: list[float] = []
        self.segment_ms: list[float] = []
        self._outline = outline
        self._carried = CarriedMasks()
        self._jobs: LatestSlot[Job] = LatestSlot()
        self._results: LatestSlot[_Done] = LatestSlot()
        self._busy = False
        self._worker = threading.Thread(target=self._work, name="segmenter", daemon=True)

    def __enter__(self) -> "AsyncMasks":
        self._worker.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._jobs.poll()
        self._jobs.close()
        self._worker.join()

    def __call__(self, view: View) -> Mask:
        """[H, W] bool, True = dynamic. Views must come in the order of time; raises what the
        segmenter raised.
        """
        job = self._carried.advance(view)
        self._take(self._results.poll())
        if not self._busy:
            self._jobs.put(job)
            self._busy = True
        if self._carried.newest is None:
            self._take(self._results.take())
        assert self._carried.newest is not None
        self.ages.append(view.t - self._carried.newest.view.t)
        return self._carried.mask(view)

    def _take(self, done: _Done | None) -> None:
        if done is None:
            return
        self._busy = False
        self.segment_ms.append(done.ms)
        self._carried.renew(done.job, done.mask, done.growth)

    def _work(self) -> None:
        if sys.platform == "linux":
            os.nice(NICE)  # there it is this thread's alone
        try:
            while (job := self._jobs.take()) is not None:
                start = time.perf_counter()
                mask, growth = self._outline(job.view)
                done = _Done(job, halve_mask(mask), growth, 1e3 * (time.perf_counter() - start))
                self._results.put(done)
        except Exception as error:
            self._results.close(error)
