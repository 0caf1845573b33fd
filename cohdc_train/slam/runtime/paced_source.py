"""Views at the pace of their stamps: whoever is late finds the newest one, and the others are
dropped and counted.
"""

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


class Clock(Protocol):
    """Seconds since some moment."""

    def now(self) -> float:
        """The time, s."""
        ...

    def wait_until(self, moment: float) -> None:
        """Return at a moment, at once when it has passed."""
        ...


class WallClock:
    """The machine's own."""

    def now(self) -> float:
        """The time, s."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep."""
        time.sleep(max(moment - self.now(), 0.0))


class PacedSource:
    """A source whose views come when they are due. Iterate once, inside `with`.

    The first view starts the clock when it has been dealt with: until then nothing is known of the
    place, and masks are waited for. From then on a thread makes the views and hands each over at
    its stamp; a camera's, of which nobody knows how many will come, at once.

    `dropped` counts the views that a newer one replaced before they were asked for. `latencies`, s:
    from when a view was due until `answered`, or else until the next was asked for, without the
    first. `behind`, s: what playing took longer than the recording, because images could not be
    read as fast; then all later ones are due so much later.
    """

    def __init__(self, source: FrameSource, clock: Clock | None = None) -> None:
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
        self._due = 0.0  # when the view was that was given out last
        self._answered = True
        self._between = float("inf")  # s, from one view to the next

    @property
    def dropped(self) -> int:
        """Views that were not given out."""
        return self._slot.dropped

    def frame_time_used(self) -> float:
        """Share of the time between views that has gone since the latest was due; work beyond 1
        holds up the next.
        """
        return (self._clock.now() - self._due) / max(self._between, 1e-6)

    def mark_answered(self) -> None:
        """What was wanted of the latest view is known."""
        if not self._answered:
            self.latencies.append(self._clock.now() - self._due)
            self._answered = True

    def __len__(self) -> int:
        return len(self._source)

    def __enter__(self) -> "PacedSource":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        if self._reader is not None:
            self._reader.join(timeout=2.0)  # a camera that gives nothing more may hold it for ever

    def __iter__(self) -> Iterator[RGBDFrame]:
        views = iter(self._source)
        first = next(views, None)
        if first is None:
            return
        yield first
        start = self._clock.now() - first.timestamp  # the moment at which stamps were 0
        self._reader = threading.Thread(
            target=self._read, args=(views, start), name="reader", daemon=True
        )
        self._reader.start()
        while (item := self._slot.take()) is not None:
            view, self._due = item
            self._answered = False
            yield view
            self.mark_answered()

    def _read(self, views: Iterator[RGBDFrame], start: float) -> None:
        before = float("-inf")
        try:
            for view in views:
                due = self._clock.now()
                if len(self):
                    self.playback_delay_s = max(
                        self.playback_delay_s, due - (start + view.timestamp)
                    )
                    due = start + view.timestamp + self.playback_delay_s
                    self._clock.wait_until(due)
                if self._stop.is_set():
                    return
                self._slot.put((view, due))
                self._between, before = due - before, due
        except Exception as error:
            self._slot.close(error)
        else:
            self._slot.close()
