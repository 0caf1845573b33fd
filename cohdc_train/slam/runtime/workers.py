"""Parts of a real-time run that work in parallel with tracking."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from cohdc_train.slam.config import MaskConfig, RealtimeConfig
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, MaskSource, SegmenterMasks, no_masks
from cohdc_train.slam.frame import FrameResult, PoseCallback
from cohdc_train.slam.io.results import quantiles
from cohdc_train.slam.io.sources import FrameSource
from cohdc_train.slam.runtime.async_masks import AsyncSegmenter
from cohdc_train.slam.runtime.executors import worker_process
from cohdc_train.slam.runtime.paced_source import PacedSource


@dataclass(frozen=True)
class RealtimeWorkers:
    """Paced source, segmenter and worker process of a real-time run.

    Attributes:
        source: frames at their pace.
        masks: segmenter in a thread; None without masks.
        executor: worker process for bundle adjustment.
    """

    source: PacedSource
    masks: AsyncSegmenter | None
    executor: Executor

    @property
    def mask_of(self) -> MaskSource:
        """Source of the mask of each frame."""
        return self.masks or no_masks

    def report_latency(self, on_pose: PoseCallback | None) -> PoseCallback:
        """Return a callback that records the latency of a pose, and then calls `on_pose`."""

        def record(result: FrameResult) -> None:
            self.source.mark_answered()
            if on_pose is not None:
                on_pose(result)

        return record

    def metrics(self) -> dict[str, Any]:
        """Return how the run kept pace.

        Returns:
            Number of frames `dropped`; `behind_s`, the delay of playback; p50 and p95, ms, of
            `latency_ms` (from a frame's timestamp until its pose was known), `mask_age_ms`, and
            `segmenter_ms`, for which no frame waits.
        """
        metrics: dict[str, Any] = {
            "dropped": self.source.dropped,
            "behind_s": self.source.playback_delay_s,
            "latency_ms": _quantiles_ms(self.source.latencies),
        }
        if self.masks is not None:
            metrics["mask_age_ms"] = _quantiles_ms(self.masks.ages)
            metrics["segmenter_ms"] = quantiles(self.masks.segment_ms)
        return metrics


@contextmanager
def start_workers(
    source: FrameSource,
    masks: MaskFolder | SegmenterMasks | None,
    mask_config: MaskConfig = MaskConfig(),
    realtime: RealtimeConfig = RealtimeConfig(),
) -> Iterator[RealtimeWorkers]:
    """Start the workers; they end with the `with` block.

    Args:
        source: of the frames.
        masks: of the frames, or None.
        mask_config: propagation of masks.
        realtime: niceness of the workers.
    """
    with ExitStack() as stack:
        executor = stack.enter_context(worker_process(realtime))
        segmenter = None
        if masks is not None:
            segmenter = stack.enter_context(AsyncSegmenter(masks.segment, mask_config, realtime))
        paced = stack.enter_context(PacedSource(source))
        yield RealtimeWorkers(paced, segmenter, executor)


def _quantiles_ms(seconds: list[float]) -> dict[str, float]:
    """Return p50 and p95, ms, of times in s."""
    return quantiles((1e3 * np.array(seconds)).tolist())
