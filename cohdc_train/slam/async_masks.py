"""Masks without waiting for the segmenter: it works beside tracking, and its newest mask is carried to every frame."""

import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.culling import Mask, grow
from cohdc_train.slam.propagation import Half, Propagation, halve, halve_mask
from cohdc_train.slam.slot import Slot
from cohdc_train.slam.source import View

Outline = Callable[[View], tuple[Mask, float]]

_WIDEN = 30.0  # px per second of a mask's age
_NICE = 5  # the worker gives way to tracking when there are fewer cores than work


@dataclass(frozen=True)
class _Job:
    number: int  # of the frame, as Propagation counts
    view: View
    half: Half


@dataclass(frozen=True)
class _Done:
    job: _Job
    mask: NDArray[np.bool_]  # half size
    growth: float  # px
    ms: float


def widened(half: Mask, growth: float, age: float, view: View) -> Mask:
    """[H, W] bool of a view, from a mask of half size that was carried to it for `age` s; growth: px, of a new one."""
    height, width = view.rgb.shape[:2]
    grown = grow(half, (growth + _WIDEN * age) / 2).astype(np.uint8)
    return np.asarray(cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST) > 0)


class AsyncMasks:
    """A mask for every frame from a segmenter that keeps up with only some.

    outline: view -> mask [H, W], True = dynamic, and by how many px it is to grow. It runs in a thread, on the newest
    frame whenever it is free; those that come while it is busy are not kept for it, for a fresher one comes soon. Only
    the first frame waits for its mask. The older a mask is, the wider it is made. Use inside `with`.

    ages: s, per frame, from the frame its mask was made of; segment_ms: time of each mask in the worker.
    """

    def __init__(self, outline: Outline) -> None:
        self.ages: list[float] = []
        self.segment_ms: list[float] = []
        self._outline = outline
        self._propagation = Propagation()
        self._jobs: Slot[_Job] = Slot()
        self._results: Slot[_Done] = Slot()
        self._busy = False
        self._newest: _Done | None = None
        self._worker = threading.Thread(target=self._work, name="segmenter", daemon=True)

    def __enter__(self) -> "AsyncMasks":
        self._worker.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._jobs.poll()
        self._jobs.close()
        self._worker.join()

    def __call__(self, view: View) -> Mask:
        """[H, W] bool, True = dynamic. Views must come in the order of time; raises what the segmenter raised."""
        half = halve(view.rgb, view.depth)
        job = _Job(self._propagation.advance(half), view, half)
        self._take(self._results.poll())
        if not self._busy:
            self._jobs.put(job)
            self._busy = True
        if self._newest is None:
            self._take(self._results.take())
        mask, newest = self._propagation.mask(), self._newest
        assert mask is not None
        assert newest is not None
        age = view.t - newest.job.view.t
        self.ages.append(age)
        return widened(mask, newest.growth, age, view)

    def _take(self, done: _Done | None) -> None:
        if done is None:
            return
        self._busy, self._newest = False, done
        self.segment_ms.append(done.ms)
        self._propagation.renew(done.mask, done.job.number, done.job.half)

    def _work(self) -> None:
        if sys.platform == "linux":
            os.nice(_NICE)  # there it is this thread's alone
        try:
            while (job := self._jobs.take()) is not None:
                start = time.perf_counter()
                mask, growth = self._outline(job.view)
                done = _Done(job, halve_mask(mask), growth, 1e3 * (time.perf_counter() - start))
                self._results.put(done)
        except Exception as error:
            self._results.close(error)
