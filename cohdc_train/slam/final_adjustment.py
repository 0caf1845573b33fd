"""The adjustment when a sequence is over: all keyframes, and what frames between them saw.

A keyframe every half second is what mapping has time for on the way. The frames between have seen every point ten times
more often.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features import Features
from cohdc_train.slam.frame_log import FrameLog
from cohdc_train.slam.localization import Fit
from cohdc_train.slam.map import Keyframe, Map, observations
from cohdc_train.slam.motion import FEW
from cohdc_train.slam.optimization import Array, Observations, Weighing, inverse
from cohdc_train.slam.window import Sighting, adjust_everything

_MOST = 256  # frames, about 25 kB each; when there are more, every other one goes
_TURNS = 2  # a frame gives only every second of its points, another one the others: a quarter of the time


class _Kept(NamedTuple):
    """t: s; reference: index of a keyframe; relative: [4, 4] T of the frame in it, m; ids: [m] points that it saw;
    born: [m] keyframe index of each, for a younger point may take the row of one that is gone; seen: measurements."""

    t: float
    reference: int
    relative: Array
    ids: NDArray[np.int64]
    born: NDArray[np.int64]
    seen: Observations


class SeenFrames:
    """Frames by what they saw of the map, evenly thinned: so many are kept that memory is bounded."""

    def __init__(self) -> None:
        self._kept: list[_Kept] = []
        self._every = 1
        self._count = 0

    def append(self, t: float, fit: Fit, reference: Keyframe, features: Features, world: Map) -> None:
        """The settled frame at t, s, after those before it, and its corners.

        One that saw little is not kept: what it gives would not do for a pose.
        """
        if len(fit.matches) < _TURNS * FEW:
            return
        number, self._count = self._count, self._count + 1
        if number % self._every:
            return
        turn = number.bit_count()  # odd and even by turns, whichever powers of two are left out later on
        relative = fit.T_cw @ inverse(reference.T_cw)
        some = fit.matches.take((fit.matches.points + turn) % _TURNS == 0)
        ids, seen = some.points, observations(features, some.corners)
        self._kept.append(_Kept(t, reference.index, relative, ids, world.born[ids], seen))
        if len(self._kept) > _MOST:
            self._kept = self._kept[::2]
            self._every *= 2

    def adjust(self, world: Map, weighing: Weighing, log: FrameLog) -> None:
        """Bundle-adjust the whole map by its keyframes, and then by these frames as well; those of the log go with the
        nearest of them.

        Without the first step a map that loops have moved is still too far off when the few of the second are over.
        Where no frame was kept it is all that is done, and those of the log go with their reference keyframes.
        """
        before = log.poses(world)
        keyframes = {keyframe.t for keyframe in world.keyframes}
        others = [kept for kept in self._kept if kept.t not in keyframes]
        were = np.stack([k.T_cw for k in world.keyframes] + [_pose(kept, world) for kept in others])
        adjust_everything(world, weighing)
        sightings = [_sighting(kept, world) for kept in others]
        if not sightings:
            return
        stamps = np.array([k.t for k in world.keyframes] + [kept.t for kept in others])
        poses = adjust_everything(world, weighing, sightings)
        moved = inverse(were) @ np.concatenate([np.stack([k.T_cw for k in world.keyframes]), poses])
        log.put(world, before @ moved[_nearest(log.stamps, stamps)])


def _sighting(kept: _Kept, world: Map) -> Sighting:
    """What a frame saw of points that are still there."""
    there = np.flatnonzero((world.born[kept.ids] == kept.born) & (world.seen_by[kept.ids] > 0))
    return Sighting(_pose(kept, world), kept.ids[there], kept.seen.take(there))


def _pose(kept: _Kept, world: Map) -> Array:
    """T_cw [4, 4], m, as the map has it now."""
    return np.asarray(kept.relative @ world.pose(kept.reference))


def _nearest(stamps: Array, others: Array) -> NDArray[np.int64]:
    """[n] the row of others [m], s, in any order, that is nearest to each of stamps [n], s."""
    order = np.argsort(others)
    later = np.searchsorted(others[order], stamps).clip(1, len(others) - 1)
    before, after = others[order[later - 1]], others[order[later]]
    return np.asarray(order[np.where(stamps - before <= after - stamps, later - 1, later)])
