"""Frames at the pace of their timestamps, with a clock that the test sets."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from plane_world import CAMERA

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.runtime.latest_slot import LatestSlot
from cohdc_train.slam.runtime.paced_source import PacedSource

TIMEOUT_S = 20.0  # of a wait for a thread, which is over long before


def test_slot_holds_the_newest_item_and_counts_dropped_ones() -> None:
    slot: LatestSlot[int] = LatestSlot()
    assert slot.poll() is None
    for number in range(1000):
        slot.put(number)
    assert slot.take() == 999
    assert slot.dropped == 999
    assert slot.poll() is None
    slot.put(7)
    slot.close()
    assert slot.take() == 7, "an item from before the end can be taken"
    assert slot.take() is None


def test_slot_raises_the_error_it_was_closed_with() -> None:
    slot: LatestSlot[int] = LatestSlot()
    slot.close(DataError("broken.png: not an image"))
    with pytest.raises(DataError, match=r"broken\.png"):
        slot.take()


def make_frame(index: int) -> RGBDFrame:
    """Return a black frame of a camera with 30 frames per second, named by its number."""
    size = (CAMERA.height, CAMERA.width)
    rgb, depth = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
    return RGBDFrame(100 + index / 30, rgb, depth, name=f"{index}")


class GatedSource:
    """Source that makes a frame when it is allowed to; requested: number of requested frames."""

    camera, groundtruth, num_unpaired = CAMERA, None, 0

    def __init__(self, count: int, broken: int | None = None) -> None:
        self.count, self.broken = count, broken
        self.allowed = threading.Semaphore(0)
        self.requested = 0
        self.changed = threading.Condition()

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[RGBDFrame]:
        for index in range(self.count + 1):
            with self.changed:
                self.requested += 1
                self.changed.notify_all()
            assert self.allowed.acquire(timeout=TIMEOUT_S)
            if index == self.broken:
                raise DataError("7.png: broken")
            if index < self.count:
                yield make_frame(index)

    def allow(self, num_frames: int) -> None:
        """Make some frames, and wait until the reader requests the one after."""
        with self.changed:
            goal = self.requested + num_frames
            self.allowed.release(num_frames)
            assert self.changed.wait_for(lambda: self.requested >= goal, TIMEOUT_S)


class ManualClock:
    """Clock that the test sets."""

    def __init__(self) -> None:
        self.time = 0.0
        self.waits: list[float] = []

    def now(self) -> float:
        return self.time

    def wait_until(self, moment: float) -> None:
        self.waits.append(moment)


def test_answer_ends_the_latency_and_frame_time_elapses() -> None:
    source, clock = GatedSource(3), ManualClock()
    source.allowed.release(2)
    frame_time_used = []
    with PacedSource(source, clock) as paced:
        for taken in paced:
            assert paced.frame_time_used() <= 0
            if taken.name == "1":
                source.allow(1)
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
    )  # the clock did not move during the first


def test_frames_are_dropped_and_counted_while_tracking_is_busy() -> None:
    source, clock = GatedSource(9), ManualClock()
    source.allowed.release(2)
    names = []
    with PacedSource(source, clock) as paced:
        for taken in paced:
            names.append(int(taken.name))
            if names == [0, 1]:
                source.allow(5)
                clock.time += 0.2  # frames 2..6 come in this time
            elif names[-1] == 6:
                source.allowed.release(3)
    assert names[:3] == [0, 1, 6]
    assert paced.dropped == 9 - len(names)
    assert paced.dropped >= 4
    np.testing.assert_allclose(clock.waits, np.arange(1, 9) / 30, atol=1e-9)
    np.testing.assert_allclose(paced.latencies[0], 0.2 - 1 / 30, atol=1e-9)
    assert len(paced.latencies) == len(names) - 1


class SlowToRead:
    """Source of four frames that take 0.1 s each to read."""

    camera, groundtruth, num_unpaired = CAMERA, None, 0

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock

    def __len__(self) -> int:
        return 4

    def __iter__(self) -> Iterator[RGBDFrame]:
        for index in range(4):
            self.clock.time += 0.1
            yield make_frame(index)


def test_slow_reading_delays_playback() -> None:
    clock = ManualClock()
    with PacedSource(SlowToRead(clock), clock) as paced:
        given = list(paced)
    assert paced.playback_delay_s == pytest.approx(3 * (0.1 - 1 / 30))
    np.testing.assert_allclose(clock.waits, [0.2, 0.3, 0.4])
    assert len(given) + paced.dropped == 4


def test_broken_image_ends_the_run_with_its_error() -> None:
    source = GatedSource(9, broken=3)
    source.allowed.release(9)
    with (
        PacedSource(source, ManualClock()) as paced,
        pytest.raises(DataError, match=r"7\.png: broken"),
    ):
        list(paced)
