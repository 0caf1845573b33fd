"""Localization of one frame in the map, by its predicted pose or by relocalization."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import (
    MatchingConfig,
    MotionSegmentationConfig,
    RansacConfig,
    TrackingConfig,
)
from cohdc_train.slam.dynamics.motion_segmentation import estimate_static_pose
from cohdc_train.slam.features.descriptors import thumbnail
from cohdc_train.slam.features.matching import Matches, match_descriptors, match_projected
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.projection import project_points
from cohdc_train.slam.optimization.pose import optimize_pose, pose_information
from cohdc_train.slam.optimization.ransac import ransac_pose
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.pose_estimate import FrameFeatures, PoseEstimate


@dataclass(frozen=True)
class LocalizerConfig:
    """Options of a localizer."""

    tracking: TrackingConfig
    ransac: RansacConfig
    matching: MatchingConfig
    motion_segmentation: MotionSegmentationConfig


class Localizer:
    """Localizer of frames in a map.

    `track_local_map` and `relocalize` match a frame with the map; `refine_pose` estimates its final
    pose.
    """

    def __init__(
        self, point_map: Map, reprojection: ReprojectionModel, config: LocalizerConfig, seed: int
    ) -> None:
        self.map = point_map
        self._reprojection = reprojection
        self._config = config
        self._rng = np.random.default_rng(seed)

    def track_local_map(
        self,
        frame: FrameFeatures,
        rgb: NDArray[np.uint8],
        last: PoseEstimate,
        prediction: Prediction,
        flow_estimate: PoseEstimate | None = None,
    ) -> PoseEstimate | None:
        """Match the frame after `last` with the local map, and estimate its pose.

        A flow estimate or a consistent prediction is exact to a few px, so that the local map is
        searched directly. Otherwise, and where that fails, a rough pose is estimated first from the
        points of the last frame. The frame is relocalized where that fails, too.

        Args:
            frame: its keypoints.
            rgb: [H, W, 3] its image.
            last: estimate of the frame before.
            prediction: predicted pose; it counts as a prior where the frame has few matches.
            flow_estimate: pose by optical flow.

        Returns:
            The pose, None where tracking and relocalization fail.
        """
        config = self._config.tracking
        if prediction.is_consistent or flow_estimate is not None:
            start = flow_estimate or PoseEstimate(prediction.prior.T_cw, last.matches, frame)
            needed = max(config.min_inliers, round(config.min_match_ratio * len(last.matches)))
            estimate = self._search_local_map(frame, start, needed, prediction)
            if estimate is not None:
                return estimate
        rough = self._track_last_points(frame, last, prediction)
        if rough is None:
            return self.relocalize(frame, rgb)
        return self._search_local_map(frame, rough, config.min_inliers, prediction)

    def relocalize(self, frame: FrameFeatures, rgb: NDArray[np.uint8]) -> PoseEstimate | None:
        """Estimate the pose of a frame without a prediction, None where no keyframe matches.

        The keyframes with the most similar thumbnails are tried, and the newest one.
        """
        config = self._config.tracking
        image = thumbnail(rgb)
        similarity = np.array([float((k.thumbnail * image).sum()) for k in self.map.keyframes])
        best = np.argsort(-similarity, kind="stable")[: config.relocalization_candidates - 1]
        order = [*best.tolist(), len(similarity) - 1]
        for index in dict.fromkeys(order):
            ids = self.map.keyframes[index].observed_point_ids()
            descriptors = self.map.descriptors[ids]
            matches = match_descriptors(ids, descriptors, frame.features, self._config.matching)
            hypotheses = self._config.ransac.hypotheses_relocalization
            rough = self._solve(frame, matches, None, hypotheses)
            if rough is None:
                continue
            estimate = self._search_local_map(frame, rough, config.min_inliers_relocalization)
            if estimate is not None:
                return estimate
        return None

    def refine_pose(self, frame: FrameFeatures, estimate: PoseEstimate) -> PoseEstimate | None:
        """Estimate the final pose by keypoints that may be refined, None with too few inliers.

        Outliers stay matched, unless they belong to a moving cluster. The prior counts if it did in
        the estimate; it does not after relocalization.
        """
        ids = estimate.matches.point_ids
        points, observations = self.map.measured(estimate.matches, frame.features)
        segments_motion = self._config.motion_segmentation.enabled
        if segments_motion:
            num_found = self.map.found[ids]
            T_cw, inlier, moving = estimate_static_pose(
                estimate.T_cw,
                points,
                observations,
                self._reprojection,
                num_found,
                estimate.prior,
                self._config.motion_segmentation,
            )
        else:
            T_cw, inlier = optimize_pose(
                estimate.T_cw, points, observations, self._reprojection, prior=estimate.prior
            )
            moving = np.zeros(len(ids), dtype=np.bool_)
        num_inliers = int(inlier.sum())
        if num_inliers < self._config.tracking.min_inliers:
            return None
        if segments_motion:
            self.map.static_odds.update(ids[inlier], ids[moving])
        information = pose_information(
            T_cw, points[inlier], observations.take(inlier), self._reprojection
        )
        return PoseEstimate(
            T_cw,
            estimate.matches.take(~moving),
            frame,
            num_inliers=num_inliers,
            reference=estimate.reference,
            prior=estimate.prior,
            information=information,
        )

    def _track_last_points(
        self, frame: FrameFeatures, last: PoseEstimate, prediction: Prediction
    ) -> PoseEstimate | None:
        """Estimate a rough pose from the points of the last frame.

        They are searched near the projections by the predicted pose, then in a larger radius around
        those by the last pose.
        """
        config = self._config.tracking
        attempts = (
            (prediction.prior.T_cw, config.radius_predicted_px),
            (last.T_cw, config.radius_last_pose_px),
        )
        for guess, radius in attempts:
            projected = project_points(self.map, last.matches.point_ids, guess)
            matches = match_projected(projected, frame.features, radius, self._config.matching)
            rough = self._solve(frame, matches, guess, self._config.ransac.hypotheses)
            if rough is not None:
                return rough
        return None

    def _solve(
        self, frame: FrameFeatures, matches: Matches, guess: Array | None, hypotheses: int
    ) -> PoseEstimate | None:
        """Estimate a rough pose by RANSAC, None with too few inliers."""
        needed = self._config.tracking.min_inliers_rough
        if len(matches) < needed:
            return None
        points, observations = self.map.measured(matches, frame.features)
        found = ransac_pose(
            points, observations, self.map.camera, self._rng, self._config.ransac, hypotheses, guess
        )
        if found is None or found[1].sum() < needed:
            return None
        T_cw, is_inlier = found
        matches = matches.take(is_inlier)
        T_cw, inlier = optimize_pose(
            T_cw, points[is_inlier], observations.take(is_inlier), self._reprojection, rounds=1
        )
        num_inliers = int(inlier.sum())
        if num_inliers < needed:
            return None
        return PoseEstimate(T_cw, matches.take(inlier), frame, num_inliers)

    def _search_local_map(
        self,
        frame: FrameFeatures,
        rough: PoseEstimate,
        min_inliers: int,
        prediction: Prediction | None = None,
    ) -> PoseEstimate | None:
        """Estimate the pose by all points of the covisible keyframes, None with too few inliers."""
        config = self._config.tracking
        keyframes = self.map.covisible(rough.matches.point_ids, config.local_keyframes)
        projected = project_points(self.map, self.map.points_of(keyframes), rough.T_cw)
        radius = config.radius_local_map_px
        matches = match_projected(projected, frame.features, radius, self._config.matching)
        points, observations = self.map.measured(matches, frame.features)
        prior = None if prediction is None else prediction.prior_for(len(matches))
        T_cw, inlier = optimize_pose(
            rough.T_cw, points, observations, self._reprojection, prior=prior
        )
        num_inliers = int(inlier.sum())
        if num_inliers < min_inliers:
            return None
        matches = matches.take(inlier)
        reference = self.map.covisible(matches.point_ids, 1)
        if not reference:  # no stored observer of these points is left in the map
            return None
        self.map.visible[projected.ids] += 1
        self.map.found[matches.point_ids] += 1
        return PoseEstimate(T_cw, matches, frame, num_inliers, reference[0], prior)
