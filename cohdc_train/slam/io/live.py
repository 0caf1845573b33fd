"""Sources without a known end: a camera of one's own, and a folder that another program is writing."""

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

Frame = tuple[NDArray[np.uint8], NDArray[np.float32], float]


class LiveSource:
    """What both have in common: nobody knows how many views will come, and `stop` ends them after
    the current one.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.groundtruth: Path | None = None
        self.num_unpaired = 0
        self._stopped = threading.Event()

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[RGBDFrame]:
        raise NotImplementedError

    def stop(self) -> None:
        """No further view; callable from any thread and from a signal's handler."""
        self._stopped.set()


class LiveCamera(LiveSource):
    """A camera of one's own: anything that gives (rgb, depth_m, t) one after the other, or None
    while nothing comes.

    rgb: [H, W, 3] uint8 RGB; depth_m: [H, W] m along the optical axis, registered to the colour
    image, 0 or nan = no reading; t: s, rising. Both images are copied: a camera may use its buffers
    again. Raises DataError for a frame of another shape or a time that does not rise.
    """

    def __init__(self, camera: Camera, frames: Iterable[Frame | None]) -> None:
        super().__init__(camera)
        self._frames = frames

    def __iter__(self) -> Iterator[RGBDFrame]:
        last = -np.inf
        for frame in self._frames:
            if self._stopped.is_set():
                return
            if frame is None:
                continue
            rgb, depth_m, t = frame
            size = (self.camera.height, self.camera.width)
            if rgb.shape != (*size, 3) or rgb.dtype != np.uint8 or depth_m.shape != size:
                found = f"colour {rgb.shape} {rgb.dtype} and depth {depth_m.shape}"
                raise DataError(
                    f"live frame at {t:.6f} s: {found}; the camera is {size[1]}x{size[0]}"
                )
            if not t > last:
                raise DataError(f"live frame at {t:.6f} s does not come after {last:.6f} s")
            last = t
            depth = np.nan_to_num(depth_m, nan=0.0, posinf=0.0).astype(np.float32)
            yield RGBDFrame(t, rgb.copy(), depth)


@contextmanager
def stop_on_sigint(source: object) -> Iterator[None]:
    """While it is open, the first Ctrl-C stops a live source, whose results are written; the second
    interrupts as ever.

    Does nothing for other sources and outside the main thread.
    """
    if (
        not isinstance(source, LiveSource)
        or threading.current_thread() is not threading.main_thread()
    ):
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
