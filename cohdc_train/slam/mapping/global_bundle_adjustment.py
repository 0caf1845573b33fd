"""The adjustment when a sequence is over: all keyframes, and what frames between them saw.

A keyframe every half second is what mapping has time for on the way. The frames between have seen
every point ten times more often.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import BundleAdjustmentConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.frame_history import FrameHistory
from cohdc_train.slam.mapping.keyframe import observations
from cohdc_train.slam.mapping.local_bundle_adjustment import (
    FrameObservations,
    apply_solution,
    select_window,
    solve,
)
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel


class _Kept(NamedTuple):
    """row: of the frame in the history; ids: [m] points that it saw; born: [m] keyframe index of each,
    for a younger point may take the row of one that is gone; seen: the m measurements."""

    row: int
    ids: NDArray[np.int64]
    first_keyframe: NDArray[np.int64]
    seen: Observations


class IntermediateFrames:
    """Frames by what they saw of the map, evenly thinned: so many are kept that memory is bounded."""

    def __init__(self, config: BundleAdjustmentConfig, min_points: int) -> None:
        """Keep at most config.max_frames frames, of min_points points or more."""
        self._config = config
        self._min_points = min_points
        self._kept: list[_Kept] = []
        self._every = 1
        self._count = 0

    def add(
        self,
        row: int,
        matches: Matches,
        from_map: bool,
        features_of: Callable[[Matches], Features],
        point_map: Map,
    ) -> None:
        """Add the next tracked frame, of which all, some, or no measurements are kept.

        row: of the frame in the history; from_map: it was matched with the map, so that it sees all
        it can; features_of: makes the frame's keypoints once it is known which matches are kept. A
        frame that sees too few points for a pose is not kept.
        """
        turns = self._config.point_subsample if from_map else 1
        if len(matches) < turns * self._min_points:
            return
        number, self._count = self._count, self._count + 1
        if number % self._every:
            return
        # Odd and even in turns, whichever powers of two are left out later on.
        turn = number.bit_count()
        kept = matches.take((matches.point_ids + turn) % turns == 0)
        seen = observations(features_of(kept), kept.keypoints)
        self._kept.append(
            _Kept(row, kept.point_ids, point_map.first_keyframe[kept.point_ids], seen)
        )
        if len(self._kept) > self._config.max_frames:
            self._kept = self._kept[::2]
            self._every *= 2

    def adjust(
        self, point_map: Map, reprojection: ReprojectionModel, history: FrameHistory
    ) -> None:
        """Bundle-adjust the whole map by its keyframes, and then by these frames as well, which are
        moved in the history; others stay where they lie from their reference keyframes.

        Without the first step a map that loops have moved is still too far off when the few of the
        second are over.
        """
        adjust_everything(point_map, reprojection, self._config)
        stamps, keyframes = (
            history.timestamps,
            {keyframe.timestamp for keyframe in point_map.keyframes},
        )
        others = [kept for kept in self._kept if stamps[kept.row] not in keyframes]
        if not others:
            return
        poses = history.poses(point_map)
        observed = [_frame_observations(kept, poses[kept.row], point_map) for kept in others]
        adjusted = adjust_everything(point_map, reprojection, self._config, observed)
        history.update_poses(point_map, [kept.row for kept in others], adjusted)


def _frame_observations(kept: _Kept, T_cw: Array, point_map: Map) -> FrameObservations:
    """What a frame saw of points that are still there."""
    same = np.flatnonzero(point_map.first_keyframe[kept.ids] == kept.first_keyframe)
    ids = point_map.resolve_merged(kept.ids[same])
    there = np.flatnonzero(point_map.num_observations[ids] > 0)
    ids, first = np.unique(ids[there], return_index=True)
    return FrameObservations(T_cw, ids, kept.seen.take(same[there[first]]))


def adjust_everything(
    point_map: Map,
    reprojection: ReprojectionModel,
    config: BundleAdjustmentConfig,
    observed: Sequence[FrameObservations] = (),
) -> Array:
    """Bundle-adjust all keyframes and points at once, and what other frames saw of them; the first
    keyframe holds still. Returns [s, 4, 4] T_cw of those frames, m."""
    window = select_window(point_map, list(point_map.keyframes), 1, observed)
    poses = np.stack(window.poses)
    solution = solve(poses, window.points, window.problem, reprojection, config)
    apply_solution(point_map, window, solution)
    return solution.poses[len(window.keyframes) :]
