"""Bundle adjustment of all keyframes when the sequence is over, with the frames between them.

Mapping has time for a keyframe every half second. The frames between observe each point ten times
more often.
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
    """Observations of one frame.

    row: of the frame in the history; ids: [m] map points; first_keyframe: [m] keyframe in which
    each was created, for a younger point may take the row of a removed one; seen: measurements.
    """

    row: int
    ids: NDArray[np.int64]
    first_keyframe: NDArray[np.int64]
    seen: Observations


class IntermediateFrames:
    """Observations of tracked frames, thinned evenly so that memory is bounded."""

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
        """Bundle-adjust the map by its keyframes, then by these frames as well.

        The frames move in the history; others stay relative to their reference keyframes. The first
        step brings a map that loop closure has moved close enough for the few steps of the second.
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
    """Return a frame's observations of points that are still in the map."""
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
    """Bundle-adjust all keyframes and points together, with the first keyframe fixed.

    observed: observations of other frames. Returns the poses [s, 4, 4] T_cw of these frames, m.
    """
    window = select_window(point_map, list(point_map.keyframes), 1, observed)
    poses = np.stack(window.poses)
    solution = solve(poses, window.points, window.problem, reprojection, config)
    apply_solution(point_map, window, solution)
    return solution.poses[len(window.keyframes) :]
