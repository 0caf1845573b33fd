"""Source that gives frames at the pace of their timestamps, and drops those that are too late."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Protocol

from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import FrameSource
from cohdc_train.slam.runtime.latest_slot import LatestSlot

_JOIN_TIMEOUT_S = 2.0  # a camera that gives no further frame may block the reader forever
_MIN_PERIOD_S = 1e-6


class Clock(Protocol):
    """Clock with an arbitrary origin."""

    def now(self) -> float:
        """Return the time, s."""
        ...

    def wait_until(self, moment: float) -> None:
        """Wait until a time, s; return immediately when it has passed."""
        ...


class WallClock:
    """Clock of the machine."""

    def now(self) -> float:
        """Return the time, s."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep until a time, s."""
        time.sleep(max(moment - self.now(), 0.0))


class PacedSource:
    """FrameSource that gives frames when they are due; iterate once, in a `with` block.

    The clock starts when the first frame has been processed: until then nothing is known of the
    place, and its mask is waited for. From then on a thread makes the frames, and hands over each
    one at its timestamp. Frames of a live camera are due when they come.

    Attributes:
        camera: intrinsics of the frames.
        groundtruth: file of the true trajectory, or None.
        num_unpaired: as of the source.
        latencies: s, from when a frame was due until `mark_answered`, or else until the next frame
            was requested; without the first frame.
        playback_delay_s: s by which the frames fell behind the recording because images could not
            be read as fast; all later frames are due that much later.
    """

    def __init__(self, source: FrameSource, clock: Clock | None = None) -> None:
        """Prepare to play a source. clock: the machine's where it is None."""
        self.camera: Camera = source.camera
        self.groundtruth: Path | None = source.groundtruth
        self.num_unpaired = source.num_unpaired
        self.latencies: list[float] = []
        self.playback_delay_s = 0.0
        self._source = source
        self._clock = clock or WallClock()
        self._slot: LatestSlot[tuple[RGBDFrame, float]] = LatestSlot()
        self._stop = threading.Event()
        self._reader: threading.Thread | None = None
        self._due = 0.0  # of the latest frame, on the clock
        self._is_answered = True
        self._period = float("inf")  # s between the latest two frames

    @property
    def dropped(self) -> int:
        """Number of frames that a newer one replaced before they were requested."""
        return self._slot.dropped

    def frame_time_used(self) -> float:
        """Return the share of the frame period that has elapsed since the latest frame was due.

        Above 1, the next frame is delayed.
        """
        return (self._clock.now() - self._due) / max(self._period, _MIN_PERIOD_S)

    def mark_answered(self) -> None:
        """Record the latency of the latest frame: its pose is known."""
        if not self._is_answered:
            self.latencies.append(self._clock.now() - self._due)
            self._is_answered = True

    def __len__(self) -> int:
        """Return the number of frames of the source, 0 where it is unknown."""
        return len(self._source)

    def __enter__(self) -> "PacedSource":
        """Return the source."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the reader."""
        self._stop.set()
        if self._reader is not None:
            self._reader.join(timeout=_JOIN_TIMEOUT_S)

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Return the frames that are not dropped; raises what the source raises."""
        frames = iter(self._source)
        first = next(frames, None)
        if first is None:
            return
        yield first
        origin = self._clock.now() - first.timestamp  # of the timestamps, on the clock
        arguments = (frames, origin)
        self._reader = threading.Thread(
            target=self._read, args=arguments, name="reader", daemon=True
        )
        self._reader.start()
        while (item := self._slot.take()) is not None:
            frame, self._due = item
            self._is_answered = False
            yield frame
            self.mark_answered()

    def _read(self, frames: Iterator[RGBDFrame], origin: float) -> None:
        """Make frames, and hand each over when it is due; the thread's function."""
        last_due = float("-inf")
        try:
            for frame in frames:
                due = self._clock.now()
                if len(self):
                    scheduled = origin + frame.timestamp
                    self.playback_delay_s = max(self.playback_delay_s, due - scheduled)
                    due = scheduled + self.playback_delay_s
                    self._clock.wait_until(due)
                if self._stop.is_set():
                    return
                self._slot.put((frame, due))
                self._period, last_due = due - last_due, due
        except Exception as error:
            self._slot.close(error)
        else:
            self._slot.close()
