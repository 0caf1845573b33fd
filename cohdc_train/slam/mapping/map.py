"""The map: points, keyframes, and which keyframe sees which point."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MappingConfig, MatchingConfig, MotionSegmentationConfig
from cohdc_train.slam.features.keypoints import Features, ScalePyramid
from cohdc_train.slam.features.matching import Matches, Projected
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.optimization.reprojection import Observations


class Map:
    """Sparse map of keyframes and points.

    Points live in arrays that grow by doubling; an id is a row, which a new point takes when no
    keyframe observes the point in it any more.

    keyframes: those in the map, index rising; joined: how many were ever inserted.
    """

    def __init__(
        self,
        camera: Camera,
        pyramid: ScalePyramid = ScalePyramid(),
        config: MappingConfig = MappingConfig(),
        matching: MatchingConfig = MatchingConfig(),
        static_odds: MotionSegmentationConfig = MotionSegmentationConfig(),
    ) -> None:
        self.camera = camera
        self.pyramid = pyramid
        self.config = config
        self.matching = matching
        self._static_odds = static_odds
        self.keyframes: list[Keyframe] = []
        self.num_inserted = 0
        self._by_index: dict[int, Keyframe] = {}
        self._successors: dict[
            int, tuple[int, Array]
        ] = {}  # of removed keyframes: whom each hangs on, and by what
        self.size = 0
        self.positions = np.zeros((1024, 3))
        self.descriptors = np.zeros((1024, 4), dtype=np.uint64)
        self.directions = np.zeros(
            (1024, 3)
        )  # sum of unit vectors from camera centres to the point
        self.max_distance_m = np.zeros(
            1024
        )  # m: from further away not even the finest level shows the point
        self.num_observations = np.zeros(1024, dtype=np.int64)  # keyframes
        # Keyframe index + 1, 0 = none, in any order; mostly the newest observers.
        self.observers = np.zeros((1024, config.observers_per_point), dtype=np.int32)
        self.first_keyframe = np.zeros(1024, dtype=np.int64)  # keyframe index
        self.merged_into = np.full(1024, -1)  # the point that took over the one in this row
        self.visible = np.zeros(1024, dtype=np.int64)  # frames that should have seen it
        self.found = np.zeros(1024, dtype=np.int64)  # frames that did
        self.moving_log_odds = np.zeros(
            1024
        )  # log-odds against standing still, beyond those of a new point

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Append a keyframe whose `point_ids` already name the points that were tracked in it."""
        self.keyframes.append(keyframe)
        self._by_index[keyframe.index] = keyframe
        self.num_inserted = keyframe.index + 1
        self._add_observer(keyframe.observed_point_ids(), keyframe)

    def remove_keyframe(self, keyframe: Keyframe, successor: Keyframe) -> None:
        """Take out a keyframe; what hung on it, frames and points, hangs on another from now on,
        where it is now.

        The directions its points were seen from stay known.
        """
        self.forget(keyframe, np.flatnonzero(keyframe.point_ids >= 0))
        self.keyframes.remove(keyframe)
        del self._by_index[keyframe.index]
        self._successors[keyframe.index] = successor.index, keyframe.T_cw @ inverse(successor.T_cw)

    def anchor(self, index: int) -> tuple[Keyframe, Array]:
        """Return the keyframe that another one is relative to, and [4, 4] from its camera to the
        other's, m.

        It is the keyframe itself while it is in the map, and else its successor.
        """
        T = np.eye(4)
        while index not in self._by_index:
            index, step = self._successors[index]
            T = T @ step
        return self._by_index[index], T

    def pose(self, index: int) -> Array:
        """T_cw [4, 4], m, of a keyframe that joined once."""
        keyframe, T = self.anchor(index)
        return np.asarray(T @ keyframe.T_cw)

    def keyframe_trajectory(self) -> Array:
        """[joined, 4, 4] T_wc, m, of all keyframes, removed ones too."""
        return inverse(np.stack([self.pose(index) for index in range(self.num_inserted)]))

    def add_points(self, keyframe: Keyframe, keypoints: NDArray[np.int64]) -> None:
        """New points at the depth that was measured at corners of a keyframe."""
        features, count = keyframe.features, len(keypoints)
        ids = self._free_rows(count)
        local = self.camera.backproject(features.undistorted[keypoints], features.depths[keypoints])
        self.positions[ids] = (local - keyframe.T_cw[:3, 3]) @ keyframe.T_cw[:3, :3]
        self.descriptors[ids] = features.descriptors[keypoints]
        self.max_distance_m[ids] = np.linalg.norm(local, axis=1) * features.scales[keypoints]
        self.first_keyframe[ids] = keyframe.index
        self.merged_into[ids] = -1
        self.directions[ids] = 0.0
        self.moving_log_odds[ids] = 0.0
        self.visible[ids] = self.found[ids] = 1
        self.observe(keyframe, Matches(ids, keypoints))

    def observe(self, keyframe: Keyframe, matches: Matches) -> None:
        """Corners of a keyframe, free so far, are measurements of points, held against none of
        their patches.
        """
        keyframe.point_ids[matches.keypoints] = matches.point_ids
        keyframe.features = keyframe.features.marked_subpixel(matches.keypoints, False)
        self._add_observer(matches.point_ids, keyframe)

    def forget(self, keyframe: Keyframe, keypoints: NDArray[np.int64]) -> None:
        """Corners of a keyframe are no measurements of their points."""
        ids = keyframe.point_ids[keypoints]
        np.subtract.at(self.num_observations, ids, 1)
        self.observers[ids] = np.where(
            self.observers[ids] == keyframe.index + 1, 0, self.observers[ids]
        )
        keyframe.point_ids[keypoints] = -1

    def replace(
        self, old: NDArray[np.int64], new: NDArray[np.int64], keyframes: list[Keyframe]
    ) -> None:
        """Points `old` are the points `new`: their measurements move over; a keyframe keeps one
        corner per point.

        The log-odds of having moved become the larger of both: the same frames have judged them, so
        that their sum would count what a group did twice.
        """
        np.maximum.at(self.moving_log_odds, new, self.moving_log_odds[old])
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
            keypoint = np.full(self.size + 1, -1)  # that an successor gets, the first of several
            keypoint[successors[::-1]] = changed[::-1]
            keypoint[keyframe.point_ids] = -1  # it has one
            keep = keypoint[successors] == changed
            self.observe(keyframe, Matches(successors[keep], changed[keep]))

    def resolve_merged(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """[n] what the points `ids` have become, by however many steps: themselves where none took
        them over.
        """
        while True:
            successors = self.merged_into[ids]
            # Where the successor's row holds a younger point, the successor is gone.
            taken = (successors >= 0) & (
                self.first_keyframe[successors] <= self.first_keyframe[ids]
            )
            if not taken.any():
                return ids
            ids = np.where(taken, successors, ids)

    def static_weight(self, ids: NDArray[np.int64]) -> Array:
        """[n] probability that each point stands still, as a share of a new point's: its weight,
        above 0 up to 1.
        """
        prior = self._static_odds.static_log_odds
        return np.asarray((1 + np.exp(-prior)) / (1 + np.exp(self.moving_log_odds[ids] - prior)))

    def measured(self, matches: Matches, features: Features) -> tuple[Array, Observations]:
        """Where the map has the matched points, [m, 3] m, and what a frame measured of them."""
        seen = observations(features, matches.keypoints).weighted(
            self.static_weight(matches.point_ids)
        )
        return self.positions[matches.point_ids], seen

    def update_static_odds(self, still: NDArray[np.int64], moving: NDArray[np.int64]) -> None:
        """A frame has seen points stand still, and others move with a group that does not."""
        odds = self._static_odds
        self.moving_log_odds[still] = np.maximum(
            self.moving_log_odds[still] - odds.static_step, 0.0
        )
        self.moving_log_odds[moving] = np.minimum(
            self.moving_log_odds[moving] + odds.moving_step, odds.max_log_odds
        )

    def shared(self, ids: NDArray[np.int64], keyframes: list[Keyframe]) -> NDArray[np.int64]:
        """[keyframes] how many of the points each of them sees."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        flags[ids] = True
        return np.array([np.count_nonzero(flags[k.point_ids]) for k in keyframes], dtype=np.int64)

    def covisible(self, ids: NDArray[np.int64], limit: int) -> list[Keyframe]:
        """Keyframes that see at least one of the points, those that see most first.

        Only those that occur most often among the points' observers are compared, so that the time
        this takes does not grow with the map.
        """
        often = np.bincount(self.observers[ids].ravel(), minlength=1)[1:]
        num_candidates = self.config.covisibility_candidates
        near = np.sort(np.argsort(-often, kind="stable")[:num_candidates])
        keyframes = [self._by_index[i] for i in near.tolist() if often[i] > 0]
        shared = self.shared(ids, keyframes)
        order = np.argsort(-shared, kind="stable")[:limit]
        return [keyframes[i] for i in order if shared[i] > 0]

    def observers_of(self, ids: NDArray[np.int64]) -> list[Keyframe]:
        """Return the keyframes that see at least one of the points.

        A point remembers a few of its observers; where it has more, all keyframes are returned.
        """
        if (self.num_observations[ids] > self.config.observers_per_point).any():
            return list(self.keyframes)
        return [self._by_index[i - 1] for i in np.unique(self.observers[ids]).tolist() if i > 0]

    def move(self, poses: Array) -> None:
        """Keyframes go to poses [keyframes, 4, 4] T_cw, m, and every point goes along with the one
        it was born in.
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
        """Ids of the points that any of the keyframes sees, rising."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        for keyframe in keyframes:
            flags[keyframe.point_ids] = True
        return np.flatnonzero(flags[:-1])

    def unseen(self, ids: NDArray[np.int64], keyframe: Keyframe) -> NDArray[np.int64]:
        """Those of the points that a keyframe does not see, rising, each once."""
        flags = np.zeros(self.size + 1, dtype=np.bool_)
        flags[ids] = True
        flags[keyframe.point_ids] = False
        return np.flatnonzero(flags[:-1])

    def project(self, ids: NDArray[np.int64], T_cw: Array) -> Projected:
        """The points among `ids` that a camera at T_cw should see."""
        camera, local = self.camera, to_local(T_cw, self.positions[ids])
        near, num_levels = self.config.min_depth_m, self.pyramid.num_levels
        z = np.maximum(local[:, 2], near)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (
            (local[:, 2] > near) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        )
        ids, local = ids[inside], local[inside]
        distance = np.sqrt(np.einsum("nj,nj->n", local, local))
        sums = self.directions[ids]
        along = np.einsum(
            "nj,nj->n", local @ T_cw[:3, :3], sums
        )  # cosine times distance times length of the sum
        level = np.log(np.maximum(self.max_distance_m[ids], 1e-9) / distance) / np.log(
            self.pyramid.factor
        )
        length = np.sqrt(np.einsum("nj,nj->n", sums, sums))
        seen = along > self.matching.min_view_cosine * distance * length
        seen &= (level > -1.0) & (level < num_levels)
        levels = np.clip(np.rint(level[seen]), 0, num_levels - 1).astype(np.int64)
        pixels = np.stack([u[inside][seen], v[inside][seen]], axis=1)
        return Projected(ids[seen], pixels, levels, self.descriptors[ids[seen]])

    def _add_observer(self, ids: NDArray[np.int64], keyframe: Keyframe) -> None:
        self.observers[ids, self.observers[ids].argmin(axis=1)] = (
            keyframe.index + 1
        )  # a free place, or the oldest's
        self.num_observations[ids] += 1
        offset = self.positions[ids] - keyframe.center()
        self.directions[ids] += offset / (np.linalg.norm(offset, axis=1, keepdims=True) + 1e-12)

    def _free_rows(self, count: int) -> NDArray[np.int64]:
        """Rows that hold no point, those of former points first."""
        free = np.flatnonzero(self.num_observations[: self.size] == 0)[:count]
        end = self.size + count - len(free)
        ids = np.concatenate([free, np.arange(self.size, end)])
        self._reserve(end)
        self.size = end
        return ids

    def _reserve(self, count: int) -> None:
        counters = (
            "num_observations",
            "observers",
            "first_keyframe",
            "merged_into",
            "visible",
            "found",
            "moving_log_odds",
        )
        names = ("positions", "descriptors", "directions", "max_distance_m", *counters)
        while len(self.positions) < count:
            for name in names:
                array = getattr(self, name)
                blank = -1 if name == "merged_into" else 0
                setattr(self, name, np.concatenate([array, np.full_like(array, blank)]))
