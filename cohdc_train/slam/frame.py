"""What a tracker says of a frame, and when."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array


@dataclass(frozen=True)
class Pose:
    """What became of one frame. t: s; T_wc: [4, 4] camera to world, m, None when the place is lost;
    track_ms: until it was known; map_ms: of the work after that."""

    t: float
    T_wc: Array | None
    keyframe: bool
    inliers: int
    track_ms: float
    map_ms: float

    @property
    def tracked(self) -> bool:
        """Whether the frame has a pose."""
        return self.T_wc is not None


PoseCallback = Callable[[Pose], None]


@dataclass(frozen=True)
class FrameRecord:
    """One frame of a run. stamp: as rgb.txt writes it; culled: share of the pixels under the mask;
    segment_ms: time of the mask; depth_ms: of the depth, where it was computed."""

    stamp: str
    pose: Pose
    culled: float
    segment_ms: float
    depth_ms: float = 0.0


@dataclass(frozen=True)
class View:
    """One frame as the tracker takes it.

    t: s; stamp: t as text, as the source writes it; name: of the colour image without its ending,
    which a mask in a folder bears too; rgb: [H, W, 3] uint8 RGB; depth: [H, W] m along the optical
    axis, 0 = no reading; depth_t: s, when depth was taken, where that differs from t; depth_ms:
    what it took to compute.
    """

    t: float
    stamp: str
    name: str
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    depth_t: float | None = None
    depth_ms: float = 0.0
