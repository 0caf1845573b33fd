"""Where frames come from: anything that gives one view after the other; here a recorded TUM sequence."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.camera import Camera
from cohdc_train.slam.tum import Sequence, read_depth, read_rgb, read_sequence


@dataclass(frozen=True)
class View:
    """One frame as the tracker takes it.

    t: s; stamp: t as text, as the source writes it; name: of the colour image without its ending, which a mask in a
    folder bears too; rgb: [H, W, 3] uint8 RGB; depth: [H, W] m along the optical axis, 0 = no reading; depth_t: s, when
    depth was taken, where that differs from t.
    """

    t: float
    stamp: str
    name: str
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    depth_t: float | None = None


class Source(Protocol):
    """Views in the order of time, each made when it is asked for.

    groundtruth: file in TUM's format, or None; without_depth: colour images left out for want of a depth image.
    """

    camera: Camera
    groundtruth: Path | None
    without_depth: int

    def __len__(self) -> int:
        """How many views will come, 0 where nobody knows."""
        ...

    def __iter__(self) -> Iterator[View]:
        """The views. Raises DataError naming the file that cannot be used."""
        ...


class Recorded:
    """An RGB-D sequence in TUM's layout.

    Raises DataError as read_sequence does, and, while views are taken, for images that are broken or of another size.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        self.camera = camera
        self._sequence: Sequence = read_sequence(folder)
        self.groundtruth = self._sequence.groundtruth
        self.without_depth = self._sequence.without_depth

    def __len__(self) -> int:
        return len(self._sequence.frames)

    def __iter__(self) -> Iterator[View]:
        for frame in self._sequence.frames:
            rgb, depth = read_rgb(frame.rgb, self.camera), read_depth(frame.depth, self.camera)
            yield View(frame.t, frame.stamp, frame.rgb.stem, rgb, depth, frame.depth_t)
