"""Keyframes that show nothing the others do not show as well go, so that a map grows with the
space, not with time.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import LEVELS
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.local_bundle_adjustment import WINDOW
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import MIN_SEEN_BY, drop_points

_AROUND = 64  # keyframes that are looked at, those that share most points with the newest
_REDUNDANT = 0.9  # share of a keyframe's points that others must see as well
_OTHERS = 3  # keyframes that see a point as well as this one
_COARSER = 1  # pyramid level at which a point is still seen as well


def cull_keyframes(world: Map, newest: Keyframe, keep: set[int]) -> list[Keyframe]:
    """Remove redundant keyframes around the newest (ORB-SLAM's criterion), and points that too few
    still see.

    A keyframe goes when at least three others see 90 % of its points at the same scale, a finer or
    the next coarser. The map's first keyframe stays, and the newest one's window, and those of the
    indices `keep`. Younger ones go first. What hung on a removed keyframe hangs on the one that
    shares most points with it. Returns the removed.
    """
    around = world.covisible(newest.seen_points(), _AROUND)
    ids = world.points_of(around)
    levels = _levels(ids, around, world.size)
    keep = keep | {world.keyframes[0].index, newest.index}
    rows = [row for row in range(WINDOW, len(around)) if around[row].index not in keep]
    removed = []
    for row in sorted(rows, key=lambda row: -around[row].index):
        own = np.flatnonzero(levels[row] < LEVELS)
        as_well = np.count_nonzero(levels[:, own] <= levels[row, own] + _COARSER, axis=0) - 1
        if np.count_nonzero(as_well >= _OTHERS) >= _REDUNDANT * len(own):
            levels[row] = 2 * LEVELS
            _remove(world, around[row])
            removed.append(around[row])
    return removed


def _levels(ids: NDArray[np.int64], keyframes: list[Keyframe], size: int) -> NDArray[np.int8]:
    """[keyframes, ids] at which pyramid level each keyframe sees each point; 2 LEVELS where it does
    not.
    """
    column = np.full(size + 1, -1)
    column[ids] = np.arange(len(ids))
    levels = np.full((len(keyframes), len(ids)), 2 * LEVELS, dtype=np.int8)
    for row, keyframe in zip(levels, keyframes, strict=True):
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        row[column[keyframe.point_ids[keypoints]]] = keyframe.features.octaves[keypoints]
    return levels


def _remove(world: Map, keyframe: Keyframe) -> None:
    points = keyframe.seen_points()
    successor = next(
        (k for k in world.covisible(points, 2) if k is not keyframe), world.keyframes[0]
    )
    world.remove_keyframe(keyframe, successor)
    drop_points(world, points[world.num_observations[points] < MIN_SEEN_BY])
