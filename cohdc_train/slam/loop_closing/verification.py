"""Geometric and photometric verification of loop candidates."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import LoopVerificationConfig, MatchingConfig, RansacConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches, match_descriptors, match_projected
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.geometry.se3 import Array, inverse
from cohdc_train.slam.mapping.keyframe import Keyframe, observations_at
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.projection import project_points
from cohdc_train.slam.optimization.image_alignment import align
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.ransac import ransac_pose
from cohdc_train.slam.optimization.reprojection import ReprojectionModel


@dataclass(frozen=True)
class LoopVerifierConfig:
    """Options of a loop verifier.

    Attributes:
        verification: thresholds, and image alignment.
        matching: matching of the place's points.
        ransac: pose from descriptor matches.
    """

    verification: LoopVerificationConfig = LoopVerificationConfig()
    matching: MatchingConfig = MatchingConfig()
    ransac: RansacConfig = RansacConfig()


@dataclass(frozen=True)
class LoopConstraint:
    """Verified loop between an old keyframe and the newest ones.

    Attributes:
        old: index of the old keyframe.
        new: [l] indices of the new keyframes; the first one found the loop.
        T: [l, 4, 4] m, camera of the old keyframe to the camera of each new one.
    """

    old: int
    new: NDArray[np.int64]
    T: Array


class LoopVerifier:
    """Verifier of loop candidates."""

    def __init__(
        self,
        point_map: Map,
        reprojection: ReprojectionModel,
        config: LoopVerifierConfig,
        rng: np.random.Generator,
    ) -> None:
        """Set the map and the options. rng: source of all random samples."""
        self._map = point_map
        self._reprojection = reprojection
        self._config = config.verification
        self._matching = config.matching
        self._ransac_config = config.ransac
        self._rng = rng

    def verify(
        self, keyframe: Keyframe, old: Keyframe, images: Mapping[int, DepthImage]
    ) -> LoopConstraint | None:
        """Verify that a keyframe shows the place of an old one.

        Args:
            keyframe: the newest.
            old: the candidate.
            images: of both, by keyframe index.

        Returns:
            The loop, or None where points, neighbors or images contradict it.
        """
        config = self._config
        ids = old.observed_point_ids()
        place = self._map.points_of(self._map.covisible(ids, config.place_keyframes))
        T_cw = self._locate(keyframe, ids, place)
        if T_cw is None:
            return None
        neighbors = self._agreeing_neighbors(keyframe, T_cw, place)
        if len(neighbors) < config.min_agreeing:
            return None
        T = self._align(T_cw @ inverse(old.T_cw), images[old.index], images[keyframe.index])
        if T is None:
            return None
        new = [keyframe.index, *(neighbor.index for neighbor, _ in neighbors)]
        # Neighbors keep their own poses, so that an error of one edge is not repeated in all.
        transforms = [T, *(pose @ inverse(old.T_cw) for _, pose in neighbors)]
        return LoopConstraint(old.index, np.array(new), np.stack(transforms))

    def _locate(
        self, keyframe: Keyframe, ids: NDArray[np.int64], place: NDArray[np.int64]
    ) -> Array | None:
        """Locate a keyframe in an old place, without using its current pose.

        Args:
            keyframe: to locate.
            ids: points of the place to match by descriptors alone.
            place: all points of the place, matched by projection afterwards.

        Returns:
            T_cw [4, 4], or None.
        """
        config, point_map = self._config, self._map
        features = keyframe.features.without_subpixel
        candidates = match_descriptors(ids, point_map.descriptors[ids], features, self._matching)
        T_cw = self._solve_rough(features, candidates)
        if T_cw is None:
            return None
        num_inliers = 0
        for radius in (config.radius_rough_px, config.radius_px):
            projected = project_points(point_map, place, T_cw)
            matches = match_projected(projected, features, radius, self._matching)
            observed = observations_at(features, matches.keypoints)
            points = point_map.positions[matches.point_ids]
            T_cw, inlier = optimize_pose(T_cw, points, observed, self._reprojection)
            num_inliers = int(inlier.sum())
        return T_cw if num_inliers >= config.min_inliers else None

    def _solve_rough(self, features: Features, matches: Matches) -> Array | None:
        """Estimate a pose T_cw [4, 4] from descriptor matches alone, or return None."""
        config = self._config
        points = self._map.positions[matches.point_ids]
        observed = observations_at(features, matches.keypoints)
        if len(matches) < config.min_inliers_rough:
            return None
        found = ransac_pose(
            points,
            observed,
            self._map.camera,
            self._rng,
            self._ransac_config,
            config.hypotheses,
        )
        if found is None or found[1].sum() < config.min_inliers_rough:
            return None
        T_cw, inlier = found
        inlier_points, inlier_observed = points[inlier], observed.take(inlier)
        refined = optimize_pose(T_cw, inlier_points, inlier_observed, self._reprojection, rounds=1)
        return refined[0]

    def _agreeing_neighbors(
        self, keyframe: Keyframe, T_cw: Array, place: NDArray[np.int64]
    ) -> list[tuple[Keyframe, Array]]:
        """Locate the covisible keyframes by themselves, and keep those that agree with T_cw.

        Returns:
            Neighbors, each with its own pose T_cw [4, 4] in the old place.
        """
        config = self._config
        covisible = self._map.covisible(keyframe.observed_point_ids(), config.neighbors + 1)
        neighbors = [neighbor for neighbor in covisible if neighbor is not keyframe]
        agreeing = []
        for neighbor in neighbors[: config.neighbors]:
            located = self._locate(neighbor, place, place)
            if located is None:
                continue
            expected = neighbor.T_cw @ inverse(keyframe.T_cw) @ T_cw
            if _is_small(located @ inverse(expected), config.agree_m, config.agree_rad):
                agreeing.append((neighbor, located))
        return agreeing

    def _align(self, T: Array, old: DepthImage, new: DepthImage) -> Array | None:
        """Refine T by direct image alignment (paper section 2.3, eqs. 10 to 12).

        Returns:
            [4, 4] camera of the old image to that of the new one; None where the images contradict.
        """
        config = self._config
        alignment = align(old, new, T, config)
        if alignment is None or alignment.after > config.max_error_ratio * alignment.before:
            return None
        is_confirmed = (
            alignment.correlation >= config.min_correlation
            and alignment.overlap >= config.min_overlap
            and alignment.agreement >= config.min_depth_agreement
        )
        correction = alignment.T @ inverse(T)
        limits = config.max_correction_m, config.max_correction_rad
        return alignment.T if is_confirmed and _is_small(correction, *limits) else None


def _is_small(T: Array, max_distance_m: float, max_angle_rad: float) -> bool:
    """Check that a rigid motion [4, 4] stays below a translation and a rotation."""
    cosine = (np.trace(T[:3, :3]) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    return bool(np.linalg.norm(T[:3, 3]) < max_distance_m and angle < max_angle_rad)
