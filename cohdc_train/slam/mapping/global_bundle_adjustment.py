"""The adjustment when a sequence is over: all keyframes, and what frames between them saw.

A keyframe every half second is what mapping has time for on the way. The frames between have seen
every point ten times more often.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FEW
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.frame_history import FrameHistory
from cohdc_train.slam.mapping.keyframe import observations
from cohdc_train.slam.mapping.local_bundle_adjustment import (
    Sighting,
    close_window,
    select_window,
    solve,
)
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel

_MOST = 256  # frames, about 25 kB each; when there are more, every other one goes
_TURNS = 2  # a matched frame gives only every second of its points, another one the others: a quarter of the time


class _Kept(NamedTuple):
    """row: of the frame in the log; ids: [m] points that it saw; born: [m] keyframe index of each,
    for a younger point may take the row of one that is gone; seen: the m measurements."""

    row: int
    ids: NDArray[np.int64]
    first_keyframe: NDArray[np.int64]
    seen: Observations


class ObservedFrames:
    """Frames by what they saw of the map, evenly thinned: so many are kept that memory is bounded."""

    def __init__(self) -> None:
        self._kept: list[_Kept] = []
        self._every = 1
        self._count = 0

    def chosen(self, seen: Matches, matched: bool) -> Matches | None:
        """What is wanted of the next settled frame, if anything; seen: the points it sees; matched:
        against the map, so that it saw all it can.

        One that saw little is not kept: what it gives would not do for a pose.
        """
        turns = _TURNS if matched else 1
        if len(seen) < turns * FEW:
            return None
        number, self._count = self._count, self._count + 1
        if number % self._every:
            return None
        turn = (
            number.bit_count()
        )  # odd and even by turns, whichever powers of two are left out later on
        return seen.take((seen.points + turn) % turns == 0)

    def append(self, row: int, matches: Matches, features: Features, world: Map) -> None:
        """What was chosen of the frame in a row of the log, after those before it, and its corners."""
        ids, seen = matches.points, observations(features, matches.keypoints)
        self._kept.append(_Kept(row, ids, world.first_keyframe[ids], seen))
        if len(self._kept) > _MOST:
            self._kept = self._kept[::2]
            self._every *= 2

    def adjust(self, world: Map, reprojection: ReprojectionModel, log: FrameHistory) -> None:
        """Bundle-adjust the whole map by its keyframes, and then by these frames as well, which are
        moved in the log; others stay where they lie from their reference keyframes.

        Without the first step a map that loops have moved is still too far off when the few of the
        second are over.
        """
        adjust_everything(world, reprojection)
        stamps, keyframes = log.stamps, {keyframe.t for keyframe in world.keyframes}
        others = [kept for kept in self._kept if stamps[kept.row] not in keyframes]
        if not others:
            return
        poses = log.poses(world)
        sightings = [_sighting(kept, poses[kept.row], world) for kept in others]
        log.put(
            world, [kept.row for kept in others], adjust_everything(world, reprojection, sightings)
        )


def _sighting(kept: _Kept, T_cw: Array, world: Map) -> Sighting:
    """What a frame saw of points that are still there."""
    same = np.flatnonzero(world.first_keyframe[kept.ids] == kept.first_keyframe)
    ids = world.current(kept.ids[same])
    there = np.flatnonzero(world.num_observations[ids] > 0)
    ids, first = np.unique(ids[there], return_index=True)
    return Sighting(T_cw, ids, kept.seen.take(same[there[first]]))


def adjust_everything(
    world: Map, reprojection: ReprojectionModel, sightings: Sequence[Sighting] = ()
) -> Array:
    """Bundle-adjust all keyframes and points at once, and what other frames saw of them; the first
    keyframe holds still. Returns [s, 4, 4] T_cw of those frames, m."""
    window = select_window(world, list(world.keyframes), 1, sightings)
    solution = solve(np.stack(window.poses), window.points, window.problem, reprojection)
    close_window(world, window, solution)
    return solution.poses[len(window.keyframes) :]
