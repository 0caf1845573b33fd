"""A sequence that another program still writes."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.live import LiveSource
from cohdc_train.slam.io.sources import SequenceFormat
from cohdc_train.slam.io.tum import TimestampedImage, parse_entry

_PNG, _PNG_END = b"\x89PNG", b"IEND\xaeB`\x82"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"


class GrowingSequence(LiveSource):
    """A sequence's folder while its lists grow.

    Ends with a file `done` in it or after `idle` s without a new line, when every listed pair has
    been given; at once when stopped. Pairs are chosen in the order of time, nearest first. A line
    or image that cannot be used is told on stderr and left out, but for the first, whose DataError
    is raised, as it is when no frame comes.
    """

    def __init__(self, folder: Path, camera: Camera, layout: SequenceFormat, idle: float) -> None:
        super().__init__(camera)
        if not idle > 0:
            raise DataError(f"idle is {idle:g}; it must be above 0 s")
        self._folder = folder
        self._done = folder / "done"
        self._lists = [_GrowingList(folder / name) for name in (layout.first, layout.second)]
        self._layout = layout
        self._idle = idle

    def __iter__(self) -> Iterator[RGBDFrame]:
        given = 0
        for first, second in self._pairs():
            try:
                self._await_whole(first.image, second.image)
                view = self._layout.view(first, second)
            except DataError as error:
                if given == 0:
                    raise
                print(f"left out: {error}", file=sys.stderr)
                continue
            given += 1
            yield view
        if given == 0 and not self._stopped.is_set():
            raise DataError(
                f"{self._folder}: no frame came in {self._idle:g} s; nothing is written"
            )

    def _pairs(self) -> Iterator[tuple[TimestampedImage, TimestampedImage]]:
        """Pairs as soon as their partner is certain: when the second list has come as far as the
        entry.
        """
        waiting: tuple[list[TimestampedImage], list[TimestampedImage]] = [], []
        heard = time.monotonic()
        while True:
            ended = (
                self._done.exists()
                or self._stopped.is_set()
                or time.monotonic() - heard > self._idle
            )
            for queue, growing in zip(waiting, self._lists, strict=True):
                if news := growing.news(ended):
                    heard = time.monotonic()
                    queue.extend(news)
            first, second = waiting
            while first and (ended or (second and second[-1].t >= first[0].t)):
                if self._stopped.is_set():
                    return
                entry = first.pop(0)
                partner = min(second, key=lambda other: abs(other.t - entry.t), default=None)
                if partner is None or abs(partner.t - entry.t) > self._layout.max_difference:
                    self.num_unpaired += 1
                    continue
                del second[: second.index(partner) + 1]
                yield entry, partner
                heard = time.monotonic()
            if ended:
                return
            self._stopped.wait(_POLL)

    def _await_whole(self, *images: Path) -> None:
        start = time.monotonic()
        for image in images:
            while not _is_whole(image):
                if self._stopped.is_set() or time.monotonic() - start > _PATIENCE:
                    raise DataError(
                        f"{image}: not there, or not whole, {_PATIENCE:g} s after it was listed"
                    )
                time.sleep(_POLL)


class _GrowingList:
    """The lines of a list as they come; a line counts when its end is written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = self._number = 0
        self._last: TimestampedImage | None = None

    def news(self, ended: bool) -> list[TimestampedImage]:
        """Entries since the last call; ended: the last line needs no end."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                text = file.read()
        except FileNotFoundError:
            return []
        if not ended:
            text = text[: text.rfind(b"\n") + 1]
        self._offset += len(text)
        return [entry for line in text.splitlines() if (entry := self._entry(line)) is not None]

    def _entry(self, line: bytes) -> TimestampedImage | None:
        self._number += 1
        try:
            entry = parse_entry(self._path, self._number, line.decode("utf-8", "replace"))
            if entry is not None and self._last is not None and entry.t <= self._last.t:
                message = f"time stamp {entry.stamp} does not come after {self._last.stamp}"
                raise DataError(f"{self._path}:{self._number}: {message}")
        except DataError as error:
            if self._last is None:
                raise
            print(f"left out: {error}", file=sys.stderr)
            return None
        self._last = entry or self._last
        return entry


def _is_whole(image: Path) -> bool:
    """Whether a PNG or JPEG ends as one does; other kinds are whole when they hold anything."""
    try:
        with image.open("rb") as file:
            head = file.read(4)
            size = file.seek(0, 2)
            file.seek(max(size - 64, 0))
            tail = file.read().rstrip(b"\0")
    except OSError:
        return False
    if head.startswith(_PNG):
        return tail.endswith(_PNG_END)
    if head.startswith(_JPEG):
        return tail.endswith(_JPEG_END)
    return size >= 4


_POLL = 0.02  # s between two looks into the folder
_PATIENCE = 2.0  # s a listed image may still be on its way to the disk
