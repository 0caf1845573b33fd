"""Tracker that estimates the pose of each frame and decides on keyframes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cohdc_train.slam.config import RealtimeConfig, TrackingConfig
from cohdc_train.slam.features.descriptors import thumbnail
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import gray_of
from cohdc_train.slam.features.patch_alignment import Pyramid
from cohdc_train.slam.frame import FrameResult, PoseCallback, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.depth_image import make_depth_image
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.tracking.frame_matcher import FrameMatcher
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.pose_estimate import PoseEstimate
from cohdc_train.slam.tracking.pose_reporter import PoseReporter
from cohdc_train.slam.tracking.tracker_parts import TrackerParts
from cohdc_train.slam.tracking.tracker_state import TrackerState
from cohdc_train.types import Mask


class Tracker:
    """Tracker of frames against the map.

    The same frames and seed give the same poses, bit for bit, unless mapping runs in parallel.
    frame_time_used: returns which share of the time until the next frame has elapsed; work that
    would delay that frame is postponed.
    """

    def __init__(
        self,
        camera: Camera,
        parts: TrackerParts,
        config: TrackingConfig,
        realtime: RealtimeConfig,
        frame_time_used: Callable[[], float],
    ) -> None:
        self.camera = camera
        self.map = parts.point_map
        self.parts = parts
        self.state = TrackerState()
        self._matcher = FrameMatcher(parts, config)
        self._realtime = realtime
        self._frame_time_used = frame_time_used

    def track(
        self, frame: RGBDFrame, mask: Mask | None = None, on_pose: PoseCallback | None = None
    ) -> FrameResult:
        """Estimate the camera pose of the next frame, and extend the map where it shows new places.

        Args:
            frame: the frame.
            mask: [H, W] bool, True = dynamic; nothing under it is added to the map. Where the
                rest of the image does not suffice for a pose, the whole image is matched with the
                map, whose points are static; such a frame does not become a keyframe.
            on_pose: called as soon as the pose is known, before mapping; the returned pose may be
                more accurate.
        """
        parts, state = self.parts, self.state
        report = PoseReporter(frame, mask, bool(self.map.keyframes), on_pose)

        # Parallel bundle adjustment may move keyframes; the last pose moves with its reference.
        self._apply_map_updates(parts.mapper.apply_finished_adjustment)

        # Predict the pose with constant velocity; None before the first frame and while lost.
        is_tracking = state.status == "tracking"
        prediction = parts.motion.predict(frame.timestamp) if is_tracking else None

        # Real time: optical flow from the last matched frame gives a pose within milliseconds.
        flow_estimate = self._track_by_flow(frame, mask, prediction)
        if flow_estimate is not None:
            report.publish(flow_estimate)
            time_used = self._frame_time_used()
            if not self._needs_match(time_used):
                self._finish_flow_frame(frame, flow_estimate, time_used)
                return report.result(flow_estimate)

        # Match the local map, or relocalize in the whole map; the flow estimate is the fallback.
        estimate, frame_features = self._matcher.match(
            frame, mask, state.last, prediction, flow_estimate
        )
        report.publish(estimate or frame_features)
        if estimate is None:
            self._set_lost()
            return report.result(frame_features)
        self._update_motion(frame, estimate)

        # Insert a keyframe, unless mapping is still busy with the one before.
        needs_keyframe = parts.keyframe_policy.needs_keyframe(estimate, self.map, state)
        is_keyframe = needs_keyframe and parts.mapper.is_idle
        if is_keyframe:
            estimate = self._insert_keyframe(frame, estimate)

        # Store the frame: flow starts from it, and the history has its pose.
        state.update(estimate, is_keyframe)
        self._restart_flow(frame, mask, estimate)
        self._record(frame, estimate)
        if needs_keyframe and not is_keyframe:
            self._apply_map_updates(parts.mapper.run_next_task)
        return report.result(estimate, is_keyframe)

    def _track_by_flow(
        self, frame: RGBDFrame, mask: Mask | None, prediction: Prediction | None
    ) -> PoseEstimate | None:
        """Track by optical flow; None where there is no frame to start from, or where it fails."""
        state = self.state
        state.flow_ratio = 1.0
        if self.parts.flow is None or state.flow is None or prediction is None:
            return None
        estimate, state.flow = self.parts.flow.track(frame, mask, state.flow, prediction)
        if estimate is not None:
            state.flow_ratio = state.flow.tracked_ratio
        return estimate

    def _needs_match(self, time_used: float) -> bool:
        """Decide whether a frame that flow tracked is matched with the map as well."""
        if self.parts.flow is None or self.state.flow is None:
            return True
        in_hurry = time_used > self._realtime.match_until
        return self.parts.flow.needs_match(self.state.flow, in_hurry, not self.parts.mapper.is_idle)

    def _finish_flow_frame(
        self, frame: RGBDFrame, estimate: PoseEstimate, time_used: float
    ) -> None:
        """Store a frame that only flow tracked, and use the remaining time for mapping."""
        has_time = time_used <= self._realtime.map_until
        self._update_motion(frame, estimate)
        self.state.update(estimate, is_keyframe=False)
        self._record(frame, estimate, refine=has_time)
        if has_time:
            self._apply_map_updates(self.parts.mapper.run_next_task)

    def _update_motion(self, frame: RGBDFrame, estimate: PoseEstimate) -> None:
        """Update the motion model with a frame's pose."""
        self.parts.motion.update(
            frame.timestamp, estimate.T_cw, estimate.information, estimate.prior_gradient
        )

    def _insert_keyframe(self, frame: RGBDFrame, estimate: PoseEstimate) -> PoseEstimate:
        """Insert the frame into the map, and return its estimate as a keyframe."""
        features, mask = estimate.features, estimate.frame_features.dynamic_mask
        point_ids = np.full(len(features), -1)
        point_ids[estimate.matches.keypoints] = estimate.matches.point_ids
        keyframe = Keyframe(
            self.map.num_inserted,
            frame.timestamp,
            estimate.T_cw,
            features,
            point_ids,
            thumbnail(frame.rgb),
            self.parts.free_space.min_depth_grid(frame.depth),
        )
        self.parts.mapper.insert(
            keyframe,
            estimate.frame_features.pyramid,
            lambda side_px: make_depth_image(frame.rgb, frame.depth, mask, self.camera, side_px),
        )
        self.parts.motion.correct(inverse(estimate.T_cw) @ keyframe.T_cw)
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        is_first = estimate.reference is None
        return replace(
            estimate,
            T_cw=keyframe.T_cw,
            matches=Matches(keyframe.point_ids[keypoints], keypoints),
            num_inliers=len(keypoints) if is_first else estimate.num_inliers,
            frame_features=replace(estimate.frame_features, features=keyframe.features),
            reference=keyframe,
            prior=None,
        )

    def _restart_flow(self, frame: RGBDFrame, mask: Mask | None, estimate: PoseEstimate) -> None:
        """Start optical flow from a matched frame; after a fallback to flow, it continues."""
        if self.parts.flow is not None and estimate.source == "map":
            self.state.flow = self.parts.flow.start(frame.rgb, estimate, mask)

    def _record(self, frame: RGBDFrame, estimate: PoseEstimate, refine: bool = True) -> None:
        """Store the frame for the trajectory and for global bundle adjustment.

        refine: refine the keypoints that flow tracked, where they are stored.
        """
        row = self.parts.history.append(
            frame.timestamp,
            estimate.T_cw,
            estimate.reference,
            estimate.information,
            estimate.prior_gradient,
            self.map,
        )

        def features_of(matches: Matches) -> Features:
            refiner = self.parts.refiner
            if estimate.source == "map" or refiner is None or not refine:
                return estimate.features
            pyramid: Pyramid = refiner.pyramid(gray_of(frame.rgb))
            return refiner.refine(estimate.features, matches, estimate.T_cw, pyramid)

        if self.parts.intermediate_frames is not None:
            from_map = estimate.source == "map"
            self.parts.intermediate_frames.add(
                row, estimate.matches, from_map, features_of, self.map
            )

    def _set_lost(self) -> None:
        """Reset the motion model and the dynamic mask after the track is lost."""
        self.state.set_lost(bool(self.map.keyframes))
        self.parts.motion.reset()
        if self.parts.dynamic_mask is not None:
            self.parts.dynamic_mask.reset()

    def _apply_map_updates(self, update: Callable[[], None]) -> None:
        """Run an update of the map, and move the last pose with its reference keyframe."""
        last = self.state.last
        if last is None or last.reference is None:
            update()
            return
        index = last.reference.index
        before = self.map.pose(index)
        update()
        after = self.map.pose(index)
        if np.array_equal(before, after):
            return
        motion = inverse(before) @ after
        self.state.last = replace(last, T_cw=last.T_cw @ motion)
        self.parts.motion.correct(motion)
