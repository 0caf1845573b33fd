"""State of a tracker between two frames."""

from dataclasses import dataclass

from cohdc_train.slam.frame import Status
from cohdc_train.slam.tracking.flow_tracker import FlowState
from cohdc_train.slam.tracking.pose_estimate import PoseEstimate


@dataclass
class TrackerState:
    """State of a tracker between two frames.

    last: estimate of the latest frame, None unless tracking; flow: matched frame that optical flow
    starts from; max_tracked: most matches of a frame since the last keyframe;
    frames_since_keyframe: tracked frames; flow_ratio: share of the points that flow kept in this
    frame, 1 without a flow pose.
    """

    status: Status = "initializing"
    last: PoseEstimate | None = None
    flow: FlowState | None = None
    max_tracked: float = 0.0
    frames_since_keyframe: int = 0
    flow_ratio: float = 1.0

    def update(self, estimate: PoseEstimate, is_keyframe: bool) -> None:
        """Store the estimate of a tracked frame."""
        self.status = "tracking"
        self.last = estimate
        self.frames_since_keyframe += 1
        if is_keyframe:
            self.frames_since_keyframe = 1
            self.max_tracked = 0.0
        elif estimate.source == "map":
            # Compensate for the points that have left the view since the last matched frame.
            num_tracked = len(estimate.matches) / self.flow_ratio
            self.max_tracked = max(self.max_tracked, num_tracked)

    def set_lost(self, is_initialized: bool) -> None:
        """Set the state of a lost frame; is_initialized: there is a map."""
        self.status = "lost" if is_initialized else "initializing"
        self.last = None
        self.flow = None
