"""RGB-D frame, and the result of tracking it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.se3 import Array

Status = Literal["initializing", "tracking", "lost"]
PoseSource = Literal["map", "flow"]


@dataclass(frozen=True)
class RGBDFrame:
    """Color image and depth image with one timestamp.

    Args:
        timestamp: s.
        rgb: [H, W, 3] uint8 RGB.
        depth: [H, W] float32 m along the optical axis, 0 = no reading.
        depth_timestamp: s, where it differs from timestamp.
        timestamp_text: timestamp as the source writes it; six decimals when not given.
        name: of the color image without its suffix, which its mask in a folder has, too;
            timestamp_text when not given.
        depth_ms: time it took to compute the depth.
    """

    timestamp: float
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    depth_timestamp: float | None = None
    timestamp_text: str = ""
    name: str = ""
    depth_ms: float = 0.0

    def __post_init__(self) -> None:
        if not self.timestamp_text:
            object.__setattr__(self, "timestamp_text", f"{self.timestamp:.6f}")
        if not self.name:
            object.__setattr__(self, "name", self.timestamp_text)


@dataclass(frozen=True)
class FrameTiming:
    """Time that a frame took, ms.

    tracking_ms: until the pose was known; mapping_ms: all work after that; mask_ms: the frame's
    wait for its mask; depth_ms: to compute its depth, 0 for a depth camera.
    """

    tracking_ms: float
    mapping_ms: float
    mask_ms: float = 0.0
    depth_ms: float = 0.0


@dataclass(frozen=True)
class FrameResult:
    """Result of tracking one frame.

    timestamp: s; T_wc: [4, 4] camera to world, m, None unless tracked; status: "initializing" until
    the first keyframe, then "tracking" or "lost"; source: "map" or "flow", which the pose was
    estimated by; num_matches: map points that the frame is matched with; num_inliers: matches that
    agree with the pose; features: keypoints; dynamic_mask: [H, W] bool, pixels that tracking did
    not use: the given mask without static objects, and moving objects detected by depth;
    given_mask: [H, W] bool.
    """

    timestamp: float
    T_wc: Array | None
    status: Status
    source: PoseSource
    is_keyframe: bool
    num_matches: int
    num_inliers: int
    features: Features | None
    dynamic_mask: NDArray[np.bool_] | None
    given_mask: NDArray[np.bool_] | None
    timing: FrameTiming

    @property
    def is_tracked(self) -> bool:
        """Return whether the frame has a pose."""
        return self.T_wc is not None

    @property
    def union_mask(self) -> NDArray[np.bool_] | None:
        """Return the union [H, W] of the given and the dynamic mask, for the dense cloud.

        A static person is not part of the dense cloud either.
        """
        if self.given_mask is None or self.dynamic_mask is None:
            return self.dynamic_mask
        return np.asarray(self.given_mask | self.dynamic_mask)


PoseCallback = Callable[[FrameResult], None]


@dataclass(frozen=True)
class FrameRecord:
    """Row of frames.csv.

    masked_ratio: share of the pixels under the dynamic mask.
    """

    timestamp_text: str
    is_tracked: bool
    is_keyframe: bool
    num_matches: int
    num_inliers: int
    masked_ratio: float
    timing: FrameTiming
