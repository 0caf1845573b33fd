"""Live sources of frames: a camera, and how Ctrl-C stops it."""

import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera

# Color [H, W, 3] uint8 RGB, depth [H, W] m, and timestamp s.
CameraFrame = tuple[NDArray[np.uint8], NDArray[np.float32], float]


class LiveSource:
    """Base of sources whose number of frames is unknown and that can be stopped; a FrameSource."""

    def __init__(self, camera: Camera) -> None:
        """Set the camera of the frames."""
        self.camera = camera
        self.groundtruth: Path | None = None
        self.num_unpaired = 0
        self._stopped = threading.Event()

    def __len__(self) -> int:
        """Return 0: the number of frames is unknown."""
        return 0

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Return the frames until `stop` is called."""
        raise NotImplementedError

    def stop(self) -> None:
        """Stop after the current frame; may be called from any thread and signal handler."""
        self._stopped.set()


class LiveCamera(LiveSource):
    """Camera of the caller: an iterable of (rgb, depth, timestamp)."""

    def __init__(self, camera: Camera, frames: Iterable[CameraFrame | None]) -> None:
        """Set the camera and its frames.

        Args:
            camera: intrinsics of the frames.
            frames: rgb [H, W, 3] uint8 RGB; depth [H, W] m along the optical axis, registered to
                the color image, 0 or nan = no reading; timestamp s, rising. None while no frame
                comes. Images are copied, so that the camera may reuse its buffers.
        """
        super().__init__(camera)
        self._frames = frames

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Return the frames; DataError for another shape or a timestamp that does not rise."""
        last = -np.inf
        for frame in self._frames:
            if self._stopped.is_set():
                return
            if frame is None:
                continue
            rgb, depth, timestamp = frame
            self._check(rgb, depth, timestamp, last)
            last = timestamp
            valid_depth = np.nan_to_num(depth, nan=0.0, posinf=0.0).astype(np.float32)
            yield RGBDFrame(timestamp, rgb.copy(), valid_depth)

    def _check(
        self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], timestamp: float, last: float
    ) -> None:
        """Raise DataError for a frame that does not fit the camera or does not follow the last."""
        size = (self.camera.height, self.camera.width)
        where = f"live frame at {timestamp:.6f} s"
        if rgb.shape != (*size, 3) or rgb.dtype != np.uint8 or depth.shape != size:
            found = f"color {rgb.shape} {rgb.dtype} and depth {depth.shape}"
            raise DataError(f"{where}: {found}; the camera is {size[1]}x{size[0]}")
        if not timestamp > last:
            raise DataError(f"{where} does not come after {last:.6f} s")


@contextmanager
def stop_on_sigint(source: object) -> Iterator[None]:
    """Let the first Ctrl-C stop a live source, so that its results are written.

    The second Ctrl-C interrupts as usual. Does nothing for other sources and outside the main
    thread.
    """
    is_main_thread = threading.current_thread() is threading.main_thread()
    if not isinstance(source, LiveSource) or not is_main_thread:
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        print("stopping; Ctrl-C again leaves without results", file=sys.stderr)
        source.stop()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
