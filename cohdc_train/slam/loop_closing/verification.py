"""Is this the place seen before? Asked of the geometry of points, of neighbours and of the pictures
themselves.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import LoopVerificationConfig, MatchingConfig, RansacConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches, match_descriptors, match_projected
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.geometry.se3 import Array, inverse
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.image_alignment import align
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.ransac import ransac_pose
from cohdc_train.slam.optimization.reprojection import ReprojectionModel

_PLACE = 8  # keyframes around the old one whose points make up the place
_MIN_ROUGH = 20  # inliers of descriptor matches alone
_MIN_INLIERS = 40  # of all the place's points
_HYPOTHESES = 256
_NEIGHBORS = 4
_MIN_AGREE = 2  # of them
_AGREE_M = 0.03
_AGREE_RAD = 0.02
_NO_WORSE = 1.02  # times the photometric error before
_MIN_CORRELATION = 0.75
_MIN_OVERLAP = 0.2
_MIN_AGREEMENT = 0.7
_REFINED_M = 0.05  # the pictures may move the points' answer this far
_REFINED_RAD = 0.02


@dataclass(frozen=True)
class LoopConstraint:
    """A checked loop: for every entry, T carries from the camera of keyframe `old` to the camera of
    keyframe `new`.

    old: index; new: [l] indices, first the keyframe that found the loop; T: [l, 4, 4], m.
    """

    old: int
    new: NDArray[np.int64]
    T: Array


class LoopVerifier:
    """Checks candidates; all its randomness comes from `rng`."""

    def __init__(
        self,
        world: Map,
        reprojection: ReprojectionModel,
        rng: np.random.Generator,
        matching: MatchingConfig = MatchingConfig(),
        ransac: RansacConfig = RansacConfig(),
    ) -> None:
        self._world, self._reprojection, self._rng = world, reprojection, rng
        self._matching, self._ransac_config = matching, ransac

    def __call__(
        self, keyframe: Keyframe, old: Keyframe, pictures: Mapping[int, DepthImage]
    ) -> LoopConstraint | None:
        """The loop between a keyframe and an old one, or None. pictures: of both, by index."""
        ids = old.seen_points()
        place = self._world.points_of(self._world.covisible(ids, _PLACE))
        T_cw = self._locate(keyframe, ids, place)
        if T_cw is None:
            return None
        neighbors = self._agreeing(keyframe, T_cw, place)
        if len(neighbors) < _MIN_AGREE:
            return None
        T = self._align(T_cw @ inverse(old.T_cw), pictures[old.index], pictures[keyframe.index])
        if T is None:
            return None
        new = [keyframe.index, *(k.index for k, _ in neighbors)]
        # The neighbours' own answers stand for themselves: an error in one edge is then not
        # repeated in all.
        Ts = [T, *(pose @ inverse(old.T_cw) for _, pose in neighbors)]
        return LoopConstraint(old.index, np.array(new), np.stack(Ts))

    def _locate(
        self, keyframe: Keyframe, ids: NDArray[np.int64], place: NDArray[np.int64]
    ) -> Array | None:
        """T_cw of a keyframe as if nothing were known about where it is: from points `ids` of an
        old place by their descriptors, then from all its points."""
        world, features = self._world, keyframe.features.without_subpixel
        descriptors = world.descriptors[ids]
        rough = self._ransac(
            features, match_descriptors(ids, descriptors, features, self._matching)
        )
        if rough is None:
            return None
        T_cw, inliers = rough, 0
        for radius in (10.0, 5.0):
            matches = match_projected(world.project(place, T_cw), features, radius, self._matching)
            seen = observations(features, matches.keypoints)
            T_cw, inlier = optimize_pose(
                T_cw, world.positions[matches.points], seen, self._reprojection
            )
            inliers = int(inlier.sum())
        return T_cw if inliers >= _MIN_INLIERS else None

    def _ransac(self, features: Features, matches: Matches) -> Array | None:
        points, seen = (
            self._world.positions[matches.points],
            observations(features, matches.keypoints),
        )
        if len(matches) < _MIN_ROUGH:
            return None
        found = ransac_pose(
            points, seen, self._world.camera, self._rng, self._ransac_config, _HYPOTHESES
        )
        if found is None or found[1].sum() < _MIN_ROUGH:
            return None
        T_cw, agree = found
        return optimize_pose(T_cw, points[agree], seen.take(agree), self._reprojection, rounds=1)[0]

    def _agreeing(
        self, keyframe: Keyframe, T_cw: Array, place: NDArray[np.int64]
    ) -> list[tuple[Keyframe, Array]]:
        """Neighbours of the keyframe that, asked by themselves, find it in the same spot; with
        their own poses.
        """
        around = [
            k
            for k in self._world.covisible(keyframe.seen_points(), _NEIGHBORS + 1)
            if k is not keyframe
        ]
        result = []
        for neighbor in around[:_NEIGHBORS]:
            own = self._locate(neighbor, place, place)
            if own is None:
                continue
            expected = neighbor.T_cw @ inverse(keyframe.T_cw) @ T_cw
            if _near(own @ inverse(expected), _AGREE_M, _AGREE_RAD):
                result.append((neighbor, own))
        return result

    def _align(self, T: Array, of_map: DepthImage, local: DepthImage) -> Array | None:
        """T refined by the pictures, if they confirm it (paper 2.3, equations 10 to 12)."""
        found = align(of_map, local, T, LoopVerificationConfig())
        if found is None or found.after > _NO_WORSE * found.before:
            return None
        sure = found.correlation >= _MIN_CORRELATION
        sure &= found.overlap >= _MIN_OVERLAP and found.agreement >= _MIN_AGREEMENT
        return found.T if sure and _near(found.T @ inverse(T), _REFINED_M, _REFINED_RAD) else None


def _near(T: Array, meters: float, radians: float) -> bool:
    """Whether a rigid motion moves the camera and turns it by less than this."""
    cosine = (np.trace(T[:3, :3]) - 1) / 2
    return bool(np.linalg.norm(T[:3, 3]) < meters and np.arccos(np.clip(cosine, -1, 1)) < radians)
