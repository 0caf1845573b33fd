"""Where frames come from: anything that gives one view after the other; here a recorded TUM
sequence.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import TimestampedImage, read_depth, read_pairs, read_rgb


class FrameSource(Protocol):
    """Views in the order of time, each made when it is asked for.

    groundtruth: file in TUM's format, or None; num_unpaired: colour images left out for want of a
    depth image.
    """

    camera: Camera
    groundtruth: Path | None
    num_unpaired: int

    def __len__(self) -> int:
        """How many views will come, 0 where nobody knows."""
        ...

    def __iter__(self) -> Iterator[RGBDFrame]:
        """The views. Raises DataError naming the file that cannot be used."""
        ...


@dataclass(frozen=True)
class SequenceFormat:
    """How a folder holds frames: two lists in the manner of TUM's rgb.txt, paired by their stamps.

    max_difference: s between the two of a pair; view: makes a view of them, or raises DataError for
    an image that cannot be used.
    """

    first: str
    second: str
    max_difference: float
    view: Callable[[TimestampedImage, TimestampedImage], RGBDFrame]


def rgbd_format(camera: Camera) -> SequenceFormat:
    """TUM's layout: rgb.txt and depth.txt."""

    def view(color: TimestampedImage, depth: TimestampedImage) -> RGBDFrame:
        rgb, meters = read_rgb(color.image, camera), read_depth(depth.image, camera)
        name = color.image.stem
        return RGBDFrame(color.t, rgb, meters, depth.t, timestamp_text=color.stamp, name=name)

    return SequenceFormat("rgb.txt", "depth.txt", 0.02, view)


class RecordedSequence:
    """A recorded sequence, in TUM's layout when no other is given.

    Raises DataError as read_pairs does, and, while views are taken, for images that are broken or
    of another size.
    """

    def __init__(self, folder: Path, camera: Camera, layout: SequenceFormat | None = None) -> None:
        self.camera = camera
        self._layout = layout or rgbd_format(camera)
        lists = folder / self._layout.first, folder / self._layout.second
        self._pairs, self.num_unpaired = read_pairs(*lists, self._layout.max_difference)
        truth = folder / "groundtruth.txt"
        self.groundtruth = truth if truth.is_file() else None

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[RGBDFrame]:
        for first, second in self._pairs:
            yield self._layout.view(first, second)
