"""Decision whether a tracked frame becomes a keyframe."""

import numpy as np

from cohdc_train.slam.config import KeyframeConfig
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.tracking.pose_estimate import PoseEstimate
from cohdc_train.slam.tracking.tracker_state import TrackerState


class KeyframePolicy:
    """Keyframe decision of ORB-SLAM2, and a stricter one in known places."""

    def __init__(self, config: KeyframeConfig, has_flow: bool) -> None:
        """Select the limits; has_flow: only some frames are matched and can become keyframes."""
        self._config = config
        self._min_tracked_ratio = (
            config.min_tracked_ratio_flow if has_flow else config.min_tracked_ratio
        )

    def needs_keyframe(self, estimate: PoseEstimate, point_map: Map, state: TrackerState) -> bool:
        """Decide whether a frame becomes a keyframe, by its matches including outliers."""
        if not estimate.allows_keyframe:
            return False
        if estimate.reference is None:  # the first frame of a map
            return True
        config = self._config
        num_tracked = len(estimate.matches)

        # A known place gets a keyframe only when few of its points are tracked.
        oldest_new = point_map.num_inserted - config.known_point_age
        is_old = point_map.first_keyframe[: point_map.size] < oldest_new
        num_old = np.count_nonzero(is_old[estimate.matches.point_ids])
        if num_old >= config.known_place_ratio * num_tracked:
            num_old_in_reference = float(is_old[estimate.reference.observed_point_ids()].sum())
            return num_tracked < config.min_known_ratio * num_old_in_reference

        # Elsewhere: tracking has become weak, or the last keyframe is old.
        is_weak = num_tracked < self._min_tracked_ratio * state.max_tracked
        return is_weak or state.frames_since_keyframe >= config.max_interval_frames
