"""Map of points, keyframes, and the observations that connect them."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MappingConfig, MatchingConfig, MotionSegmentationConfig
from cohdc_train.slam.features.keypoints import Features, ScalePyramid
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse
from cohdc_train.slam.mapping.keyframe import Keyframe, observations_at
from cohdc_train.slam.mapping.static_odds import StaticOdds
from cohdc_train.slam.optimization.reprojection import Observations


class Map:
    """Sparse map of keyframes and points.

    Points are rows of arrays that grow by doubling; the row is the point's id. A new point may
    reuse the row of a point that no keyframe observes any more.

    keyframes: keyframes in the map, index ascending; num_inserted: number of all keyframes inserted
    so far; size: number of rows in use.
    """

    def __init__(
        self,
        camera: Camera,
        pyramid: ScalePyramid = ScalePyramid(),
        config: MappingConfig = MappingConfig(),
        matching: MatchingConfig = MatchingConfig(),
        motion_segmentation: MotionSegmentationConfig = MotionSegmentationConfig(),
    ) -> None:
        self.camera = camera
        self.pyramid = pyramid
        self.config = config
        self.matching = matching

        self.keyframes: list[Keyframe] = []
        self.num_inserted = 0
        self._by_index: dict[int, Keyframe] = {}
        # Of removed keyframes: index of the successor, and the pose relative to it.
        self._successors: dict[int, tuple[int, Array]] = {}
        self.size = 0
        self.positions = np.zeros((1024, 3))
        self.descriptors = np.zeros((1024, 4), dtype=np.uint64)
        # Sum of unit vectors from the observing cameras to the point.
        self.directions = np.zeros((1024, 3))
        # Distance beyond which not even the finest level shows the point, m.
        self.max_distance_m = np.zeros(1024)
        self.num_observations = np.zeros(1024, dtype=np.int64)  # keyframes that observe the point
        # Keyframe index + 1, 0 = none, in any order; mostly the newest observers.
        self.observers = np.zeros((1024, config.observers_per_point), dtype=np.int32)
        self.first_keyframe = np.zeros(1024, dtype=np.int64)  # keyframe index
        self.merged_into = np.full(1024, -1)  # point that has replaced this one, or -1
        self.visible = np.zeros(1024, dtype=np.int64)  # frames that should have matched the point
        self.found = np.zeros(1024, dtype=np.int64)  # frames that have matched the point
        self.static_odds = StaticOdds(motion_segmentation)
        self.static_odds.reserve(1024)

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Append a keyframe whose `point_ids` already contain the points tracked in it."""
        self.keyframes.append(keyframe)
        self._by_index[keyframe.index] = keyframe
        self.num_inserted = keyframe.index + 1
        self._add_observer(keyframe.observed_point_ids(), keyframe)

    def remove_keyframe(self, keyframe: Keyframe, successor: Keyframe) -> None:
        """Remove a keyframe; frames and points relative to it become relative to its successor.

        They do not move. Viewing directions of the removed keyframe's points are kept.
        """
        self.forget(keyframe, np.flatnonzero(keyframe.point_ids >= 0))
        self.keyframes.remove(keyframe)
        del self._by_index[keyframe.index]
        self._successors[keyframe.index] = successor.index, keyframe.T_cw @ inverse(successor.T_cw)

    def anchor(self, index: int) -> tuple[Keyframe, Array]:
        """Return the keyframe in the map that represents a keyframe, and the pose relative to it.

        This is the keyframe itself while it is in the map, and its successor otherwise. The
        relative pose [4, 4] transforms from the camera of the returned keyframe to that of the
        given one, m.
        """
        T = np.eye(4)
        while index not in self._by_index:
            index, step = self._successors[index]
            T = T @ step
        return self._by_index[index], T

    def pose(self, index: int) -> Array:
        """Return the pose T_cw [4, 4], m, of a keyframe in the map or of a removed one."""
        keyframe, T = self.anchor(index)
        return np.asarray(T @ keyframe.T_cw)

    def keyframe_trajectory(self) -> Array:
        """Return the poses [num_inserted, 4, 4] T_wc, m, of all keyframes ever inserted."""
        return inverse(np.stack([self.pose(index) for index in range(self.num_inserted)]))

    def add_points(self, keyframe: Keyframe, keypoints: NDArray[np.int64]) -> None:
        """Create points at the measured depth of a keyframe's keypoints."""
        features, count = keyframe.features, len(keypoints)
        ids = self._free_rows(count)
        local = self.camera.backproject(features.undistorted[keypoints], features.depths[keypoints])
        self.positions[ids] = (local - keyframe.T_cw[:3, 3]) @ keyframe.T_cw[:3, :3]
        self.descriptors[ids] = features.descriptors[keypoints]
        self.max_distance_m[ids] = np.linalg.norm(local, axis=1) * features.scales[keypoints]
        self.first_keyframe[ids] = keyframe.index
        self.merged_into[ids] = -1
        self.directions[ids] = 0.0
        self.static_odds.reset(ids)
        self.visible[ids] = self.found[ids] = 1
        self.observe(keyframe, Matches(ids, keypoints))

    def observe(self, keyframe: Keyframe, matches: Matches) -> None:
        """Match points with keypoints of a keyframe that have none.

        The keypoints count as not refined, since they were not aligned with these points' patches.
        """
        keyframe.point_ids[matches.keypoints] = matches.point_ids
        keyframe.features = keyframe.features.marked_subpixel(matches.keypoints, False)
        self._add_observer(matches.point_ids, keyframe)

    def forget(self, keyframe: Keyframe, keypoints: NDArray[np.int64]) -> None:
        """Remove the observations at the given keypoints of a keyframe."""
        ids = keyframe.point_ids[keypoints]
        np.subtract.at(self.num_observations, ids, 1)
        self.observers[ids] = np.where(
            self.observers[ids] == keyframe.index + 1, 0, self.observers[ids]
        )
        keyframe.point_ids[keypoints] = -1

    def replace(
        self, old: NDArray[np.int64], new: NDArray[np.int64], keyframes: list[Keyframe]
    ) -> None:
        """Merge the points `old` into the points `new`, in all keyframes that observe them.

        A keyframe keeps one keypoint per point.
        """
        self.static_odds.merge(old, new)
        self.merged_into[old] = new
        alias = np.arange(self.size + 1)
        alias[old] = new
        alias[-1] = -1
        for keyframe in keyframes:
            ids = alias[keyframe.point_ids]
            changed = np.flatnonzero(ids != keyframe.point_ids)
            if len(changed) == 0:
                continue
            self.forget(keyframe, changed)
            successors = ids[changed]
            keypoint = np.full(self.size + 1, -1)  # of each successor, the first of several
            keypoint[successors[::-1]] = changed[::-1]
            keypoint[keyframe.point_ids] = -1  # observed already
            keep = keypoint[successors] == changed
            self.observe(keyframe, Matches(successors[keep], changed[keep]))

    def resolve_merged(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the points [n] that points [n] have been merged into; others stay as they are."""
        while True:
            successors = self.merged_into[ids]
            # A younger point in the successor's row means that the successor was removed.
            is_merged = (successors >= 0) & (
                self.first_keyframe[successors] <= self.first_keyframe[ids]
            )
            if not is_merged.any():
                return ids
            ids = np.where(is_merged, successors, ids)

    def measured(self, matches: Matches, features: Features) -> tuple[Array, Observations]:
        """Return the positions [m, 3] m of matched points, and a frame's measurements of them.

        The measurements have the weights of static points.
        """
        weight = self.static_odds.weight(matches.point_ids)
        observations = observations_at(features, matches.keypoints).weighted(weight)
        return self.positions[matches.point_ids], observations

    def shared(self, ids: NDArray[np.int64], keyframes: list[Keyframe]) -> NDArray[np.int64]:
        """Count how many of the points each keyframe observes; returns [keyframes]."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        flags[ids] = True
        return np.array([np.count_nonzero(flags[k.point_ids]) for k in keyframes], dtype=np.int64)

    def covisible(self, ids: NDArray[np.int64], limit: int) -> list[Keyframe]:
        """Return the keyframes that observe the most of the points, in descending order.

        Only the keyframes that occur most often among the points' observers are compared, so that
        the time does not grow with the map.
        """
        counts = np.bincount(self.observers[ids].ravel(), minlength=1)[1:]
        num_candidates = self.config.covisibility_candidates
        candidates = np.sort(np.argsort(-counts, kind="stable")[:num_candidates])
        keyframes = [self._by_index[i] for i in candidates.tolist() if counts[i] > 0]
        shared = self.shared(ids, keyframes)
        order = np.argsort(-shared, kind="stable")[:limit]
        return [keyframes[i] for i in order if shared[i] > 0]

    def observers_of(self, ids: NDArray[np.int64]) -> list[Keyframe]:
        """Return the keyframes that observe at least one of the points.

        A point stores a few of its observers; where it has more, all keyframes are returned.
        """
        if (self.num_observations[ids] > self.config.observers_per_point).any():
            return list(self.keyframes)
        return [self._by_index[i - 1] for i in np.unique(self.observers[ids]).tolist() if i > 0]

    def move(self, poses: Array) -> None:
        """Move the keyframes to poses [keyframes, 4, 4] T_cw, m.

        Each point moves with the keyframe in which it was created.
        """
        motions = inverse(poses) @ np.stack([k.T_cw for k in self.keyframes])
        row = {keyframe.index: i for i, keyframe in enumerate(self.keyframes)}
        first_keyframe, which = np.unique(self.first_keyframe[: self.size], return_inverse=True)
        motion = motions[[row[self.anchor(index)[0].index] for index in first_keyframe.tolist()]][
            which
        ]
        for keyframe, T_cw in zip(self.keyframes, poses, strict=True):
            keyframe.T_cw = T_cw
        moved = np.einsum("nij,nj->ni", motion[:, :3, :3], self.positions[: self.size])
        self.positions[: self.size] = moved + motion[:, :3, 3]
        self.directions[: self.size] = np.einsum(
            "nij,nj->ni", motion[:, :3, :3], self.directions[: self.size]
        )

    def points_of(self, keyframes: list[Keyframe]) -> NDArray[np.int64]:
        """Return the ids of the points that any of the keyframes observes, ascending."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        for keyframe in keyframes:
            flags[keyframe.point_ids] = True
        return np.flatnonzero(flags[:-1])

    def unseen(self, ids: NDArray[np.int64], keyframe: Keyframe) -> NDArray[np.int64]:
        """Return the ids of the points that a keyframe does not observe, ascending and unique."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        flags[ids] = True
        flags[keyframe.point_ids] = False
        return np.flatnonzero(flags[:-1])

    def _add_observer(self, ids: NDArray[np.int64], keyframe: Keyframe) -> None:
        # A free column, or that of the oldest observer.
        """Record a keyframe as observer of points."""
        column = self.observers[ids].argmin(axis=1)
        self.observers[ids, column] = keyframe.index + 1
        self.num_observations[ids] += 1
        offset = self.positions[ids] - keyframe.center()
        self.directions[ids] += offset / (np.linalg.norm(offset, axis=1, keepdims=True) + 1e-12)

    def _free_rows(self, count: int) -> NDArray[np.int64]:
        """Return rows for new points, first those of removed points."""
        free = np.flatnonzero(self.num_observations[: self.size] == 0)[:count]
        end = self.size + count - len(free)
        ids = np.concatenate([free, np.arange(self.size, end)])
        self._reserve(end)
        self.size = end
        return ids

    def _reserve(self, count: int) -> None:
        """Double the arrays until they have `count` rows."""
        counters = (
            "num_observations",
            "observers",
            "first_keyframe",
            "merged_into",
            "visible",
            "found",
        )
        names = ("positions", "descriptors", "directions", "max_distance_m", *counters)
        while len(self.positions) < count:
            for name in names:
                array = getattr(self, name)
                blank = -1 if name == "merged_into" else 0
                setattr(self, name, np.concatenate([array, np.full_like(array, blank)]))
            self.static_odds.reserve(len(self.positions))
