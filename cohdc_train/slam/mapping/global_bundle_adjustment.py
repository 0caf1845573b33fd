"""Bundle adjustment of all keyframes, and of frames between them, after the sequence has ended.

The map gets a keyframe every half second. The frames in between observe each point ten times as
often.
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
from cohdc_train.slam.mapping.keyframe import observations_at
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
    each was created, which tells it from a younger point in the same row; observations: the m
    measurements.
    """

    row: int
    ids: NDArray[np.int64]
    first_keyframe: NDArray[np.int64]
    observations: Observations


class IntermediateFrames:
    """Observations of tracked frames, thinned evenly to bound the memory."""

    def __init__(self, config: BundleAdjustmentConfig, min_points: int) -> None:
        """Keep at most config.max_frames frames, each with min_points points or more."""
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
        """Add the next tracked frame; all, some, or none of its measurements are kept.

        A frame that observes too few points for a pose is not kept.

        Args:
            row: of the frame in the history.
            matches: map points that the frame observes.
            from_map: True = the frame was matched with the map; only some of its points are kept.
            features_of: returns the frame's keypoints for the matches that are kept.
            point_map: the map.
        """
        turns = self._config.point_subsample if from_map else 1
        if len(matches) < turns * self._min_points:
            return
        number, self._count = self._count, self._count + 1
        if number % self._every:
            return
        # The parity of set bits alternates, whichever powers of two are dropped later.
        turn = number.bit_count()
        kept = matches.take((matches.point_ids + turn) % turns == 0)
        observations = observations_at(features_of(kept), kept.keypoints)
        self._kept.append(
            _Kept(row, kept.point_ids, point_map.first_keyframe[kept.point_ids], observations)
        )
        if len(self._kept) > self._config.max_frames:
            self._kept = self._kept[::2]
            self._every *= 2

    def adjust(
        self, point_map: Map, reprojection: ReprojectionModel, history: FrameHistory
    ) -> None:
        """Bundle-adjust the map by its keyframes, and then by these frames as well.

        The history gets the new poses of these frames; others stay relative to their reference
        keyframes. The first adjustment brings a map that loop closure has moved close to its
        optimum, so that few steps suffice for the second.
        """
        adjust_everything(point_map, reprojection, self._config)
        stamps = history.timestamps
        keyframes = {keyframe.timestamp for keyframe in point_map.keyframes}
        others = [kept for kept in self._kept if stamps[kept.row] not in keyframes]
        if not others:
            return
        poses = history.poses(point_map)
        observed = [_frame_observations(kept, poses[kept.row], point_map) for kept in others]
        adjusted = adjust_everything(point_map, reprojection, self._config, observed)
        history.update_poses(point_map, [kept.row for kept in others], adjusted)


def _frame_observations(kept: _Kept, T_cw: Array, point_map: Map) -> FrameObservations:
    """Return a frame's observations of the points that are still in the map."""
    same = np.flatnonzero(point_map.first_keyframe[kept.ids] == kept.first_keyframe)
    ids = point_map.resolve_merged(kept.ids[same])
    observed_rows = np.flatnonzero(point_map.num_observations[ids] > 0)
    ids, first = np.unique(ids[observed_rows], return_index=True)
    return FrameObservations(T_cw, ids, kept.observations.take(same[observed_rows[first]]))


def adjust_everything(
    point_map: Map,
    reprojection: ReprojectionModel,
    config: BundleAdjustmentConfig,
    observed: Sequence[FrameObservations] = (),
) -> Array:
    """Bundle-adjust all keyframes and points, with the first keyframe fixed.

    observed: observations of s other frames. Returns the poses [s, 4, 4] T_cw of these frames, m.
    """
    window = select_window(point_map, list(point_map.keyframes), 1, observed)
    poses = np.stack(window.poses)
    solution = solve(poses, window.points, window.problem, reprojection, config)
    apply_solution(point_map, window, solution)
    return solution.poses[len(window.keyframes) :]
