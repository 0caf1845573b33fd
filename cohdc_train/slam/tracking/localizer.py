"""Pose of one frame against the map: from the last pose, or from nothing after a loss."""

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
    """Localization of frames in a map.

    First the points that a frame observes (`track_local_map`, `relocalize`), then its final pose
    (`refine_pose`).
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
        """Return the pose of the frame after `last`, None where tracking fails.

        Relocalizes where not even the points of the last frame are found.

        flow_estimate: pose by optical flow. It and a consistent prediction are exact to a few px:
        the local map is searched at once. Otherwise, and where that fails, a rough pose comes
        first. Where a frame sees little, the prediction counts as a prior.
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
        """Return the pose of a frame without a prediction, None where no keyframe fits.

        Tries the keyframes that look most like the frame, and the newest.
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
        """Return the final pose, by keypoints that may have been refined; None where few agree.

        Outliers stay matched, unless they belong to a moving cluster. The prior counts if it did
        in the estimate: a relocalized pose speaks against it.
        """
        ids = estimate.matches.point_ids
        points, seen = self.map.measured(estimate.matches, frame.features)
        segments_motion = self._config.motion_segmentation.enabled
        if segments_motion:
            num_found = self.map.found[ids]
            T_cw, inlier, moving = estimate_static_pose(
                estimate.T_cw,
                points,
                seen,
                self._reprojection,
                num_found,
                estimate.prior,
                self._config.motion_segmentation,
            )
        else:
            T_cw, inlier = optimize_pose(
                estimate.T_cw, points, seen, self._reprojection, prior=estimate.prior
            )
            moving = np.zeros(len(ids), dtype=np.bool_)
        num_inliers = int(inlier.sum())
        if num_inliers < self._config.tracking.min_inliers:
            return None
        if segments_motion:
            self.map.update_static_odds(ids[inlier], ids[moving])
        information = pose_information(T_cw, points[inlier], seen.take(inlier), self._reprojection)
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
        """Return a rough pose from the points of the last frame.

        They are searched near the predicted projections, then further around the last ones.
        """
        config = self._config.tracking
        attempts = (
            (prediction.prior.T_cw, config.radius_predicted_px),
            (last.T_cw, config.radius_last_pose_px),
        )
        for guess, radius in attempts:
            projected = self.map.project(last.matches.point_ids, guess)
            matches = match_projected(projected, frame.features, radius, self._config.matching)
            rough = self._solve(frame, matches, guess, self._config.ransac.hypotheses)
            if rough is not None:
                return rough
        return None

    def _solve(
        self, frame: FrameFeatures, matches: Matches, guess: Array | None, hypotheses: int
    ) -> PoseEstimate | None:
        """Return a rough pose by RANSAC, None where few matches agree."""
        needed = self._config.tracking.min_inliers_rough
        if len(matches) < needed:
            return None
        points, seen = self.map.measured(matches, frame.features)
        found = ransac_pose(
            points, seen, self.map.camera, self._rng, self._config.ransac, hypotheses, guess
        )
        if found is None or found[1].sum() < needed:
            return None
        T_cw, agree = found
        matches = matches.take(agree)
        T_cw, inlier = optimize_pose(
            T_cw, points[agree], seen.take(agree), self._reprojection, rounds=1
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
        """Return the pose by all points of the keyframes around, None where few agree."""
        config = self._config.tracking
        keyframes = self.map.covisible(rough.matches.point_ids, config.local_keyframes)
        projected = self.map.project(self.map.points_of(keyframes), rough.T_cw)
        radius = config.radius_local_map_px
        matches = match_projected(projected, frame.features, radius, self._config.matching)
        points, seen = self.map.measured(matches, frame.features)
        prior = None if prediction is None else prediction.prior_for(len(matches))
        T_cw, inlier = optimize_pose(rough.T_cw, points, seen, self._reprojection, prior=prior)
        num_inliers = int(inlier.sum())
        if num_inliers < min_inliers:
            return None
        matches = matches.take(inlier)
        reference = self.map.covisible(matches.point_ids, 1)
        if not reference:  # no keyframe is remembered that observes one of them
            return None
        self.map.visible[projected.ids] += 1
        self.map.found[matches.point_ids] += 1
        return PoseEstimate(T_cw, matches, frame, num_inliers, reference[0], prior)
