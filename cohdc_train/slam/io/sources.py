"""Sources of frames, and recorded sequences."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import TimestampedImage, read_depth, read_pairs, read_rgb

MAX_TIME_DIFFERENCE_S = 0.02  # between color and depth, as TUM's associate tool has it


class FrameSource(Protocol):
    """Frames in the order of time, each made when it is asked for.

    Attributes:
        camera: intrinsics of the frames.
        groundtruth: file of the true trajectory in TUM's format, or None.
        num_unpaired: color images skipped so far because no depth image was near in time.
    """

    camera: Camera
    groundtruth: Path | None
    num_unpaired: int

    def __len__(self) -> int:
        """Return the number of frames, 0 where it is unknown."""
        ...

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Return the frames; DataError names the file that cannot be used."""
        ...


@dataclass(frozen=True)
class SequenceFormat:
    """Format of a folder with frames: two lists like TUM's rgb.txt, paired by their timestamps.

    Attributes:
        first: name of the list whose timestamps the frames get.
        second: name of the other list.
        max_difference_s: largest time between the images of a pair, s.
        make_frame: makes a frame of a pair; raises DataError for an image that cannot be used.
    """

    first: str
    second: str
    max_difference_s: float
    make_frame: Callable[[TimestampedImage, TimestampedImage], RGBDFrame]


def rgbd_format(camera: Camera) -> SequenceFormat:
    """Return the format of the TUM RGB-D benchmark: rgb.txt and depth.txt."""

    def make_frame(color: TimestampedImage, depth: TimestampedImage) -> RGBDFrame:
        return RGBDFrame(
            timestamp=color.timestamp,
            timestamp_text=color.timestamp_text,
            name=color.path.stem,
            rgb=read_rgb(color.path, camera),
            depth=read_depth(depth.path, camera),
            depth_timestamp=depth.timestamp,
        )

    return SequenceFormat("rgb.txt", "depth.txt", MAX_TIME_DIFFERENCE_S, make_frame)


class RecordedSequence:
    """Recorded sequence; a FrameSource."""

    def __init__(
        self, folder: Path, camera: Camera, sequence_format: SequenceFormat | None = None
    ) -> None:
        """Read the lists of the sequence.

        Args:
            folder: of the sequence.
            camera: intrinsics of the frames.
            sequence_format: TUM's RGB-D format where it is None.

        Raises:
            DataError: a list cannot be used, as for `read_pairs`.
        """
        self.camera = camera
        self._format = sequence_format or rgbd_format(camera)
        first, second = folder / self._format.first, folder / self._format.second
        self._pairs, self.num_unpaired = read_pairs(first, second, self._format.max_difference_s)
        truth = folder / "groundtruth.txt"
        self.groundtruth = truth if truth.is_file() else None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._pairs)

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Read the frames; DataError names an image that is broken or of another size."""
        for first, second in self._pairs:
            yield self._format.make_frame(first, second)
