"""Report of a frame's pose as soon as it is known."""

import time

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.frame import FrameResult, FrameTiming, PoseCallback, RGBDFrame, Status
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.tracking.pose_estimate import FrameFeatures, PoseEstimate


class PoseReporter:
    """Result of one frame, and the time until its pose was known."""

    def __init__(
        self,
        frame: RGBDFrame,
        mask: NDArray[np.bool_] | None,
        is_initialized: bool,
        on_pose: PoseCallback | None,
    ) -> None:
        """Start the clock of a frame.

        is_initialized: there is a map; on_pose: called with the first result.
        """
        self._start_s = time.perf_counter()
        self._frame = frame
        self._mask = mask
        self._status_without_pose: Status = "lost" if is_initialized else "initializing"
        self._on_pose = on_pose
        self._known_s: float | None = None

    def publish(self, result: PoseEstimate | FrameFeatures) -> None:
        """Publish the frame's pose, or that it has none; only the first call has an effect."""
        if self._known_s is not None:
            return
        self._known_s = time.perf_counter()
        if self._on_pose is not None:
            self._on_pose(self.result(result))

    def result(
        self, result: PoseEstimate | FrameFeatures, is_keyframe: bool = False
    ) -> FrameResult:
        """Return the result so far; `result` is the keypoints alone where the frame has no pose."""
        now = time.perf_counter()
        known_s = now if self._known_s is None else self._known_s
        tracking_ms, mapping_ms = 1e3 * (known_s - self._start_s), 1e3 * (now - known_s)
        estimate = result if isinstance(result, PoseEstimate) else None
        frame_features = result.frame_features if isinstance(result, PoseEstimate) else result
        return FrameResult(
            timestamp=self._frame.timestamp,
            T_wc=None if estimate is None else inverse(estimate.T_cw),
            status=self._status_without_pose if estimate is None else "tracking",
            source="map" if estimate is None else estimate.source,
            is_keyframe=is_keyframe,
            num_matches=0 if estimate is None else len(estimate.matches),
            num_inliers=0 if estimate is None else estimate.num_inliers,
            features=frame_features.features,
            dynamic_mask=frame_features.dynamic_mask,
            given_mask=self._mask,
            timing=FrameTiming(tracking_ms, mapping_ms, depth_ms=self._frame.depth_ms),
        )
