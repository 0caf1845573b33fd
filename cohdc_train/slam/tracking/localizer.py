"""The pose of one frame against the map: from the last pose, or from nothing when the place was
lost.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.motion_segmentation import estimate_static_pose
from cohdc_train.slam.features.descriptors import thumbnail
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches, match_descriptors, match_projected
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.pose import optimize_pose, pose_information
from cohdc_train.slam.optimization.ransac import ransac_pose
from cohdc_train.slam.optimization.reprojection import Prior, ReprojectionModel
from cohdc_train.slam.tracking.motion_model import Prediction

LOCAL_KEYFRAMES = 15
_MIN_FIRST = 15  # inliers of the first, rough pose
_MIN_TRACKED = 25  # inliers of the pose against the local map
_MIN_FOUND_AGAIN = 40  # the same when the place was lost
_AS_BEFORE = 0.7  # of the last frame's matches: where a pose that was only expected finds fewer, it is not believed
_CANDIDATES = 6  # keyframes tried per lost frame


@dataclass(frozen=True)
class Fit:
    """Where a frame is. T_cw: [4, 4] world to camera, m; matches: the points it sees; reference:
    the keyframe that sees most of them, None while the pose is a rough one; prior: what was
    expected, where that counted as well;
    information: [6, 6] inverse covariance of the pose by what is seen alone, in the camera's frame,
    0 until the pose is settled."""

    T_cw: Array
    matches: Matches
    reference: Keyframe | None = None
    prior: Prior | None = None
    information: Array = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def pull(self) -> Array:
        """[6] `Prior.pull` of what was expected, 0 where it did not count."""
        return np.zeros(6) if self.prior is None else self.prior.pull(self.T_cw)


class Localizer:
    """Finds frames in a map, in two steps: which points a frame sees (`near`, `anywhere`), and
    where it is (`settle`).

    judges: groups of points that move against the rest are left out and lose weight.
    """

    def __init__(
        self, world: Map, reprojection: ReprojectionModel, seed: int, judges: bool
    ) -> None:
        self.map = world
        self._reprojection = reprojection
        self._judges = judges
        self._rng = np.random.default_rng(seed)

    def near(
        self,
        features: Features,
        rgb: NDArray[np.uint8],
        last: Fit,
        expected: Prediction,
        flown: Fit | None = None,
    ) -> Fit | None:
        """The frame after `last`. Where it sees little, what was expected counts as well.

        flown: where flow says it is. There, or where a camera that moves calmly is expected, it is
        to a few px: the map is asked at once. Where it does not answer, a rough pose comes first.
        """
        if expected.calm or flown is not None:
            there = Fit(expected.prior.T_cw, last.matches) if flown is None else flown
            enough = max(_MIN_TRACKED, round(_AS_BEFORE * len(last.matches)))
            fit = self._against_local_map(features, there, enough, expected)
            if fit is not None:
                return fit
        rough = self._follow(features, last, expected)
        if rough is None:
            return self.anywhere(features, rgb)
        return self._against_local_map(features, rough, _MIN_TRACKED, expected)

    def anywhere(self, features: Features, rgb: NDArray[np.uint8]) -> Fit | None:
        """Try the keyframes that look most like the frame, and the newest."""
        picture = thumbnail(rgb)
        likeness = np.array([float((k.thumbnail * picture).sum()) for k in self.map.keyframes])
        order = [*np.argsort(-likeness, kind="stable")[: _CANDIDATES - 1], len(likeness) - 1]
        for index in dict.fromkeys(int(i) for i in order):
            ids = self.map.keyframes[index].seen_points()
            matches = match_descriptors(ids, self.map.descriptors[ids], features)
            rough = self._solve(features, matches, None, hypotheses=256)
            fit = (
                None
                if rough is None
                else self._against_local_map(features, rough, _MIN_FOUND_AGAIN)
            )
            if fit is not None:
                return fit
        return None

    def _follow(self, features: Features, last: Fit, expected: Prediction) -> Fit | None:
        """A rough pose from the points of the last frame, first near where the velocity puts them,
        then further off.
        """
        for guess, radius in ((expected.prior.T_cw, 15.0), (last.T_cw, 40.0)):
            projected = self.map.project(last.matches.points, guess)
            matches = match_projected(projected, features, radius)
            fit = self._solve(features, matches, guess, hypotheses=64)
            if fit is not None:
                return fit
        return None

    def _solve(
        self, features: Features, matches: Matches, guess: Array | None, hypotheses: int
    ) -> Fit | None:
        if len(matches) < _MIN_FIRST:
            return None
        points, seen = self.map.measured(matches, features)
        found = ransac_pose(points, seen, self.map.camera, self._rng, hypotheses, guess=guess)
        if found is None or found[1].sum() < _MIN_FIRST:
            return None
        T_cw, agree = found
        matches = matches.take(agree)
        T_cw, inlier = optimize_pose(
            T_cw, points[agree], seen.take(agree), self._reprojection, rounds=1
        )
        return Fit(T_cw, matches.take(inlier)) if inlier.sum() >= _MIN_FIRST else None

    def _against_local_map(
        self, features: Features, rough: Fit, minimum: int, expected: Prediction | None = None
    ) -> Fit | None:
        """The pose from all points of the keyframes around."""
        keyframes = self.map.covisible(rough.matches.points, LOCAL_KEYFRAMES)
        projected = self.map.project(self.map.points_of(keyframes), rough.T_cw)
        matches = match_projected(projected, features, radius=5.0)
        points, seen = self.map.measured(matches, features)
        prior = None if expected is None else expected.given(len(matches))
        T_cw, inlier = optimize_pose(rough.T_cw, points, seen, self._reprojection, prior=prior)
        if inlier.sum() < minimum:
            return None
        matches = matches.take(inlier)
        reference = self.map.covisible(matches.points, 1)
        if not reference:  # no keyframe is remembered that sees one of them
            return None
        self.map.visible[projected.ids] += 1
        self.map.found[matches.points] += 1
        return Fit(T_cw, matches, reference[0], prior)

    def settle(self, features: Features, fit: Fit) -> Fit | None:
        """The final pose of a frame that was found, by corners that may have been moved since. None
        where hardly anything fits.

        What does not fit stays matched, unless it moves. What was expected counts if it did when
        the frame was found: a place found anew speaks against it.
        """
        ids = fit.matches.points
        points, seen = self.map.measured(fit.matches, features)
        if self._judges:
            known = self.map.found[ids]
            T_cw, inlier, moving = estimate_static_pose(
                fit.T_cw, points, seen, self._reprojection, known, fit.prior
            )
        else:
            T_cw, inlier = optimize_pose(
                fit.T_cw, points, seen, self._reprojection, prior=fit.prior
            )
            moving = np.zeros(len(ids), dtype=np.bool_)
        if inlier.sum() < _MIN_TRACKED:
            return None
        if self._judges:
            self.map.update_static_odds(ids[inlier], ids[moving])
        information = pose_information(T_cw, points[inlier], seen.take(inlier), self._reprojection)
        return Fit(T_cw, fit.matches.take(~moving), fit.reference, fit.prior, information)
