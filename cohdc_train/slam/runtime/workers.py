"""What runs beside tracking in real time: the source at its own pace, the segmenter, local bundle
adjustment.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from cohdc_train.slam.dynamics.mask_sources import MaskFolder, MaskSource, SegmenterMasks, no_masks
from cohdc_train.slam.frame import FrameResult, PoseCallback
from cohdc_train.slam.io.results import quantiles
from cohdc_train.slam.io.sources import FrameSource
from cohdc_train.slam.runtime.async_masks import AsyncSegmenter
from cohdc_train.slam.runtime.executors import worker_process
from cohdc_train.slam.runtime.paced_source import PacedSource


@dataclass(frozen=True)
class RealtimeWorkers:
    """The parts of a run that others wait for no longer. masks: None when nothing is masked."""

    source: PacedSource
    masks: AsyncSegmenter | None
    executor: Executor

    @property
    def mask_of(self) -> MaskSource:
        """Every frame's mask."""
        return self.masks or no_masks

    def report_latency(self, on_pose: PoseCallback | None) -> PoseCallback:
        """The same, after the source has learnt that there is an answer."""

        def mark_answered(result: FrameResult) -> None:
            self.source.mark_answered()
            if on_pose is not None:
                on_pose(result)

        return mark_answered

    def metrics(self) -> dict[str, Any]:
        """How the run kept up: p50 and p95, ms, of `latency` (from a frame's stamp until its pose
        was known), of the masks' `age`, and of the `segmenter`, for which nobody waited; how many
        frames were `dropped`; by how many seconds playing fell `behind` the recording."""
        result: dict[str, Any] = {
            "dropped": self.source.dropped,
            "behind_s": self.source.playback_delay_s,
            "latency_ms": _milliseconds(self.source.latencies),
        }
        if self.masks is not None:
            result["mask_age_ms"] = _milliseconds(self.masks.ages)
            result["segmenter_ms"] = quantiles(self.masks.segment_ms)
        return result


@contextmanager
def start_workers(
    source: FrameSource, masks: MaskFolder | SegmenterMasks | None
) -> Iterator[RealtimeWorkers]:
    """Start them; when the block ends, they end."""
    with ExitStack() as stack:
        executor = stack.enter_context(worker_process())
        workers = None if masks is None else stack.enter_context(AsyncSegmenter(masks.segment))
        yield RealtimeWorkers(stack.enter_context(PacedSource(source)), workers, executor)


def _milliseconds(seconds: list[float]) -> dict[str, float]:
    return quantiles((1e3 * np.array(seconds)).tolist())
