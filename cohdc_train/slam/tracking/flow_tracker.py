"""Optical-flow tracking of the frames between two that are matched with the map.

Keypoint detection, description, and matching take most of a frame's time. In the next frame the
same points have moved by a few pixels, and optical flow of the patches around them measures by how
much. Flow always starts from the matched frame, never from a frame that flow tracked itself, so
that errors do not accumulate.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FlowConfig
from cohdc_train.slam.features.keypoints import Keypoints
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import gray_of
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.pose import optimize_pose, pose_information
from cohdc_train.slam.optimization.reprojection import MIN_DEPTH_M, ReprojectionModel
from cohdc_train.slam.tracking.frame_measurer import FrameMeasurer
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.pose_estimate import FrameFeatures, PoseEstimate


@dataclass(frozen=True)
class FlowState:
    """Matched frame that optical flow starts from, and statistics of the latest tracked frame.

    gray: [H, W] uint8; point_ids: [m] int64 matched map points; keypoints: m of them; offsets: [m,
    2] px from a point's projection to its keypoint; under_mask: [m] bool, matched although masked;
    reference: the keyframe that observes most of the points; num_frames: frames tracked from here;
    num_started: points that flow started from in the latest frame; num_agreeing: inliers of its
    pose.
    """

    gray: NDArray[np.uint8]
    point_ids: NDArray[np.int64]
    keypoints: Keypoints
    offsets: Array
    under_mask: NDArray[np.bool_]
    reference: Keyframe | None
    num_frames: int = 0
    num_started: int = 0
    num_agreeing: int = 0

    @property
    def tracked_ratio(self) -> float:
        """Return the share of the points that are inliers of the latest pose."""
        return self.num_agreeing / self.num_started

    def take(self, rows: NDArray[np.int64]) -> "FlowState":
        """Return the state with the chosen points."""
        return replace(
            self,
            point_ids=self.point_ids[rows],
            keypoints=self.keypoints.take(rows),
            offsets=self.offsets[rows],
            under_mask=self.under_mask[rows],
        )


@dataclass(frozen=True)
class FlowTracks:
    """Points that flow tracked into a frame.

    point_ids: [m] int64 map points; keypoints: m of them, at the tracked positions.
    """

    point_ids: NDArray[np.int64]
    keypoints: Keypoints


class FlowTracker:
    """Optical-flow tracker that estimates poses without detecting keypoints."""

    def __init__(
        self,
        point_map: Map,
        reprojection: ReprojectionModel,
        measurer: FrameMeasurer,
        config: FlowConfig = FlowConfig(),
    ) -> None:
        self.map = point_map
        self._reprojection = reprojection
        self._measurer = measurer
        self._config = config

    def start(
        self, rgb: NDArray[np.uint8], estimate: PoseEstimate, mask: NDArray[np.bool_] | None
    ) -> FlowState | None:
        """Return the state of a matched frame, None where it has too few matches.

        mask: [H, W] bool, as given. Points that were matched under it, because they are static, are
        tracked there as well.
        """
        if len(estimate.matches) < self._config.min_inliers:
            return None
        ids = estimate.matches.point_ids
        keypoints = estimate.features.keypoints(estimate.matches.keypoints)
        offsets = keypoints.pixels - self._project(estimate.T_cw, ids)
        under_mask = _is_covered(keypoints.pixels, mask)
        gray = gray_of(rgb)
        return FlowState(gray, ids, keypoints, offsets, under_mask, estimate.reference)

    def track(
        self,
        frame: RGBDFrame,
        mask: NDArray[np.bool_] | None,
        state: FlowState,
        prediction: Prediction,
    ) -> tuple[PoseEstimate | None, FlowState]:
        """Track the points into a frame, and estimate its pose.

        Args:
            frame: the next frame.
            mask: [H, W] bool, True = dynamic; no point is tracked there.
            state: the matched frame.
            prediction: predicted pose of the frame.

        Returns:
            The pose, None where too few points agree, and the new state.
        """
        tracks, state = self.track_points(frame.rgb, mask, state, prediction.prior.T_cw)
        features = self._measurer.measure(tracks.keypoints, frame, mask)
        return self.estimate_pose(tracks, FrameFeatures(features, mask), state, prediction)

    def track_points(
        self,
        rgb: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        state: FlowState,
        T_cw: Array,
    ) -> tuple[FlowTracks, FlowState]:
        """Track the points into the next frame, whose predicted pose is T_cw [4, 4]."""
        config = self._config
        num_frames = state.num_frames + 1
        start = state
        if len(state.point_ids) >= config.subsample_above:
            # Frames track different subsets in turn, since a pose needs no more points.
            turn = num_frames % config.subsample
            start = state.take(np.flatnonzero(state.point_ids % config.subsample == turn))
        num_started = len(start.point_ids)

        pixels, is_found = self._flow(start, gray_of(rgb), T_cw)
        rows = np.flatnonzero(is_found & _is_inside(pixels, self.map.camera))
        rows = rows[start.under_mask[rows] | ~_is_covered(pixels[rows], mask)]

        # Points may have been merged: each is tracked once, and a merged one does not stay refined.
        known = start.point_ids[rows]
        ids, first = np.unique(self.map.resolve_merged(known), return_index=True)
        rows, is_same = rows[first], ids == known[first]
        keypoints = start.keypoints.take(rows)
        is_subpixel = keypoints.is_subpixel & is_same
        tracks = FlowTracks(ids, replace(keypoints, pixels=pixels[rows], is_subpixel=is_subpixel))
        return tracks, replace(state, num_frames=num_frames, num_started=num_started)

    def estimate_pose(
        self,
        tracks: FlowTracks,
        frame_features: FrameFeatures,
        state: FlowState,
        prediction: Prediction,
    ) -> tuple[PoseEstimate | None, FlowState]:
        """Estimate the pose from tracked points, None where too few agree, and the new state.

        frame_features: keypoints of the tracks.
        """
        features = frame_features.features
        needed = max(self._config.min_inliers, self._config.min_inlier_ratio * state.num_started)
        if len(features) < needed:
            return None, state
        matches = Matches(tracks.point_ids, np.arange(len(features)))
        points, observations = self.map.measured(matches, features)
        prior = prediction.prior_for(len(features))
        start = prediction.prior.T_cw
        T_cw, inlier = optimize_pose(start, points, observations, self._reprojection, prior=prior)
        num_inliers = int(inlier.sum())
        state = replace(state, num_agreeing=num_inliers)
        if num_inliers < needed:
            return None, state
        information = pose_information(
            T_cw, points[inlier], observations.take(inlier), self._reprojection
        )
        estimate = PoseEstimate(
            T_cw,
            matches.take(inlier),
            frame_features,
            num_inliers=num_inliers,
            reference=state.reference,
            prior=prior,
            information=information,
            source="flow",
            allows_keyframe=False,
        )
        return estimate, state

    def needs_match(self, state: FlowState, in_hurry: bool, mapper_is_busy: bool) -> bool:
        """Decide whether the frame that flow tracked is matched with the map as well.

        in_hurry: there is no time for matching; mapper_is_busy: the frame would not become a
        keyframe, so that matching may wait unless the view has changed much.
        """
        config = self._config
        if in_hurry:
            return state.num_frames > config.max_frames_between_matches
        limit = (
            config.max_frames_between_matches if mapper_is_busy else config.frames_between_matches
        )
        return state.num_frames > limit or state.tracked_ratio < config.rematch_below_ratio

    def _flow(
        self, start: FlowState, gray: NDArray[np.uint8], T_cw: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Run Lucas-Kanade optical flow; returns positions [m, 2] px and [m] bool, True = found."""
        if len(start.point_ids) == 0:
            return np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
        config = self._config
        count_and_epsilon = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS
        guess = self._project(T_cw, start.point_ids) + start.offsets
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            start.gray,
            gray,
            start.keypoints.pixels.astype(np.float32),
            guess.astype(np.float32),
            None,
            None,
            (config.window_px, config.window_px),
            config.pyramid_levels,
            (count_and_epsilon, config.max_iterations, config.epsilon_px),
            cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(found, dtype=np.float64), np.asarray(status[:, 0] > 0)

    def _project(self, T_cw: Array, ids: NDArray[np.int64]) -> Array:
        """Return the distorted projections [m, 2] px of map points."""
        local = to_local(T_cw, self.map.positions[ids])
        local[:, 2] = np.maximum(local[:, 2], MIN_DEPTH_M)
        camera = self.map.camera
        return camera.distort(camera.project(local))


def _is_inside(pixels: Array, camera: Camera) -> NDArray[np.bool_]:
    """Return [m] bool, True = the pixel lies in the image."""
    x, y = np.rint(pixels).T
    return np.asarray((x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))


def _is_covered(pixels: Array, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return [m] bool, True = the pixel lies under the mask."""
    if mask is None:
        return np.zeros(len(pixels), dtype=np.bool_)
    x, y = np.rint(pixels).astype(np.int64).T
    return np.asarray(mask[y, x])
