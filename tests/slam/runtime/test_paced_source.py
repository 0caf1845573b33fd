"""Views at the pace of their stamps, without a clock: what is late is dropped and counted, nothing
queues.
"""

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from plane_world import CAMERA

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import View
from cohdc_train.slam.runtime.latest_slot import LatestSlot
from cohdc_train.slam.runtime.paced_source import PacedSource

LONG = 20.0  # s: no wait of a thread here takes that long unless it hangs


def test_a_slot_holds_the_newest_and_counts_the_rest() -> None:
    slot: LatestSlot[int] = LatestSlot()
    assert slot.poll() is None
    for number in range(1000):
        slot.put(number)
    assert slot.take() == 999
    assert slot.dropped == 999
    assert slot.poll() is None
    slot.put(7)
    slot.close()
    assert slot.take() == 7, "what was there when it closed is still given"
    assert slot.take() is None


def test_a_slot_closed_with_an_error_raises_it_where_it_is_read() -> None:
    slot: LatestSlot[int] = LatestSlot()
    slot.close(DataError("broken.png: not an image"))
    with pytest.raises(DataError, match=r"broken\.png"):
        slot.take()


def view(index: int) -> View:
    t, size = 100 + index / 30, (CAMERA.height, CAMERA.width)
    return View(
        t,
        f"{t:.6f}",
        f"{index}",
        np.zeros((*size, 3), dtype=np.uint8),
        np.zeros(size, dtype=np.float32),
    )


class Gated:
    """A source that makes a view when it is let; `asked` tells how many views have been asked for."""

    camera, groundtruth, num_unpaired = CAMERA, None, 0

    def __init__(self, count: int, broken: int | None = None) -> None:
        self.count, self.broken = count, broken
        self.allowed = threading.Semaphore(0)
        self.asked = 0
        self.changed = threading.Condition()

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[View]:
        for index in range(self.count + 1):
            with self.changed:
                self.asked += 1
                self.changed.notify_all()
            assert self.allowed.acquire(timeout=LONG)
            if index == self.broken:
                raise DataError("7.png: broken")
            if index < self.count:
                yield view(index)

    def let(self, views: int) -> None:
        """Make so many views, and wait until the reader comes for the one after."""
        with self.changed:
            goal = self.asked + views
            self.allowed.release(views)
            assert self.changed.wait_for(lambda: self.asked >= goal, LONG)


class Still:
    """A clock that goes only when it is told to."""

    def __init__(self) -> None:
        self.time = 0.0
        self.waits: list[float] = []

    def now(self) -> float:
        return self.time

    def wait_until(self, moment: float) -> None:
        self.waits.append(moment)


def test_an_answer_ends_the_latency_and_the_time_until_the_next_view_is_spent() -> None:
    source, clock = Gated(3), Still()
    source.allowed.release(2)
    frame_time_used = []
    with PacedSource(source, clock) as paced:
        for taken in paced:
            assert paced.frame_time_used() <= 0
            if taken.name == "1":
                source.let(1)
            if taken.name == "2":
                clock.time = 2.2 / 30
                paced.mark_answered()
                for moment in (2.45, 2.55):
                    clock.time = moment / 30
                    frame_time_used.append(paced.frame_time_used())
                source.allowed.release()
    np.testing.assert_allclose(frame_time_used, [0.45, 0.55])
    np.testing.assert_allclose(
        paced.latencies, [-1 / 30, 0.2 / 30], atol=1e-9
    )  # the clock stood still for the first


def test_views_that_come_while_the_tracker_is_busy_are_dropped_and_counted() -> None:
    source, clock = Gated(9), Still()
    source.allowed.release(2)
    given = []
    with PacedSource(source, clock) as paced:
        for taken in paced:
            given.append(int(taken.name))
            if given == [0, 1]:
                source.let(5)
                clock.time += 0.2  # views 2..6 come in this time
            elif given[-1] == 6:
                source.allowed.release(3)
    assert given[:3] == [0, 1, 6]
    assert paced.dropped == 9 - len(given)
    assert paced.dropped >= 4
    np.testing.assert_allclose(clock.waits, np.arange(1, 9) / 30, atol=1e-9)
    np.testing.assert_allclose(paced.latencies[0], 0.2 - 1 / 30, atol=1e-9)
    assert len(paced.latencies) == len(given) - 1


class SlowToRead:
    """Four views that take 0.1 s each to make."""

    camera, groundtruth, num_unpaired = CAMERA, None, 0

    def __init__(self, clock: Still) -> None:
        self.clock = clock

    def __len__(self) -> int:
        return 4

    def __iter__(self) -> Iterator[View]:
        for index in range(4):
            self.clock.time += 0.1
            yield view(index)


def test_reading_slower_than_the_recording_delays_it_instead_of_piling_up() -> None:
    clock = Still()
    with PacedSource(SlowToRead(clock), clock) as paced:
        given = list(paced)
    assert paced.playback_delay_s == pytest.approx(3 * (0.1 - 1 / 30))
    np.testing.assert_allclose(clock.waits, [0.2, 0.3, 0.4])
    assert len(given) + paced.dropped == 4


def test_a_broken_image_ends_the_run_with_its_error() -> None:
    source = Gated(9, broken=3)
    source.allowed.release(9)
    with PacedSource(source, Still()) as paced, pytest.raises(DataError, match=r"7\.png: broken"):
        list(paced)
