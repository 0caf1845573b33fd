"""Sequence that another program is still writing."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.live import LiveSource
from cohdc_train.slam.io.sources import SequenceFormat
from cohdc_train.slam.io.tum import Pair, TimestampedImage, check_order, parse_line

_PNG, _PNG_END = b"\x89PNG", b"IEND\xaeB`\x82"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_TAIL_BYTES = 64  # read from the end of an image
_POLL_S = 0.02  # between two looks into the folder
_IMAGE_TIMEOUT_S = 2.0  # that a listed image may take to be written


class GrowingSequence(LiveSource):
    """Folder of a sequence whose lists grow; a FrameSource.

    It ends with a file named done in the folder, or when no line has come for some time; all pairs
    listed so far are still returned. It ends immediately when stopped. Pairs come in the order of
    time. A line or image that cannot be used is reported on stderr and skipped.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        sequence_format: SequenceFormat,
        idle_timeout_s: float,
    ) -> None:
        """Start to follow a folder.

        Args:
            folder: of the sequence.
            camera: intrinsics of the frames.
            sequence_format: names of the lists, and how frames are made.
            idle_timeout_s: time without a new line after which the sequence ends, s.

        Raises:
            DataError: the timeout is not above 0.
        """
        super().__init__(camera)
        if not idle_timeout_s > 0:
            raise DataError(f"idle_timeout is {idle_timeout_s:g}; it must be above 0 s")
        names = (sequence_format.first, sequence_format.second)
        self._folder = folder
        self._end_mark = folder / "done"
        self._lists = [_GrowingList(folder / name) for name in names]
        self._format = sequence_format
        self._idle_timeout_s = idle_timeout_s

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Return frames as they are written.

        DataError is raised for the first frame when it cannot be used, and when no frame comes.
        """
        num_frames = 0
        for first, second in self._pairs():
            try:
                self._wait_until_complete(first.path, second.path)
                frame = self._format.make_frame(first, second)
            except DataError as error:
                if num_frames == 0:
                    raise
                print(f"skipped: {error}", file=sys.stderr)
                continue
            num_frames += 1
            yield frame
        if num_frames == 0 and not self._stopped.is_set():
            waited = f"no frame came in {self._idle_timeout_s:g} s"
            raise DataError(f"{self._folder}: {waited}; nothing is written")

    def _pairs(self) -> Iterator[Pair]:
        """Return pairs as soon as the partner is certain: the second list has come as far."""
        waiting: tuple[list[TimestampedImage], list[TimestampedImage]] = [], []
        last_news = time.monotonic()
        while True:
            has_ended = self._has_ended(last_news)
            for queue, growing in zip(waiting, self._lists, strict=True):
                if news := growing.read_new(has_ended):
                    last_news = time.monotonic()
                    queue.extend(news)
            first, second = waiting
            while first and (has_ended or _reaches(second, first[0])):
                if self._stopped.is_set():
                    return
                image = first.pop(0)
                partner = self._take_partner(image, second)
                if partner is None:
                    self.num_unpaired += 1
                    continue
                yield image, partner
                last_news = time.monotonic()
            if has_ended:
                return
            self._stopped.wait(_POLL_S)

    def _has_ended(self, last_news: float) -> bool:
        """Check whether the sequence ends now. last_news: time of the last line, s."""
        is_idle = time.monotonic() - last_news > self._idle_timeout_s
        return self._end_mark.exists() or self._stopped.is_set() or is_idle

    def _take_partner(
        self, image: TimestampedImage, candidates: list[TimestampedImage]
    ) -> TimestampedImage | None:
        """Take the nearest candidate in time from the list, with all before it; None if too far."""
        differences = [abs(other.timestamp - image.timestamp) for other in candidates]
        if not differences or min(differences) > self._format.max_difference_s:
            return None
        index = differences.index(min(differences))
        partner = candidates[index]
        del candidates[: index + 1]
        return partner

    def _wait_until_complete(self, *images: Path) -> None:
        """Wait until images are written; DataError when it takes too long."""
        start = time.monotonic()
        for image in images:
            while not _is_complete(image):
                if self._stopped.is_set() or time.monotonic() - start > _IMAGE_TIMEOUT_S:
                    problem = f"missing or incomplete {_IMAGE_TIMEOUT_S:g} s after it was listed"
                    raise DataError(f"{image}: {problem}")
                time.sleep(_POLL_S)


class _GrowingList:
    """Lines of a list as they come; a line counts when its end is written."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0  # bytes read so far
        self._number = 0  # of the last line
        self._last: TimestampedImage | None = None

    def read_new(self, has_ended: bool) -> list[TimestampedImage]:
        """Return the images listed since the last call. has_ended: the last line needs no end."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                text = file.read()
        except FileNotFoundError:
            return []
        if not has_ended:
            text = text[: text.rfind(b"\n") + 1]
        self._offset += len(text)
        images = [self._parse(line) for line in text.splitlines()]
        return [image for image in images if image is not None]

    def _parse(self, line: bytes) -> TimestampedImage | None:
        """Parse the next line; DataError for the first one, None for a later one that is broken."""
        self._number += 1
        try:
            image = parse_line(self._path, self._number, line.decode("utf-8", "replace"))
            if image is not None:
                check_order(self._path, self._number, image, self._last)
        except DataError as error:
            if self._last is None:
                raise
            print(f"skipped: {error}", file=sys.stderr)
            return None
        self._last = image or self._last
        return image


def _reaches(images: list[TimestampedImage], image: TimestampedImage) -> bool:
    """Check that a list has come as far in time as an image."""
    return bool(images) and images[-1].timestamp >= image.timestamp


def _is_complete(image: Path) -> bool:
    """Check that a PNG or JPEG file has its end; other files are complete with 4 bytes."""
    try:
        with image.open("rb") as file:
            head = file.read(4)
            size = file.seek(0, 2)
            file.seek(max(size - _TAIL_BYTES, 0))
            tail = file.read().rstrip(b"\0")
    except OSError:
        return False
    if head.startswith(_PNG):
        return tail.endswith(_PNG_END)
    if head.startswith(_JPEG):
        return tail.endswith(_JPEG_END)
    return size >= 4
