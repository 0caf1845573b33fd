"""Keyframes that show nothing the others do not show as well go, so that a map grows with the
space, not with time.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import KeyframeCullingConfig
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import drop_points

_UNSEEN = 100  # level of a point that a keyframe does not observe


def cull_keyframes(
    world: Map,
    newest: Keyframe,
    keep: set[int],
    config: KeyframeCullingConfig,
    num_protected: int,
) -> list[Keyframe]:
    """Remove redundant keyframes around the newest (ORB-SLAM's criterion), and points that too few
    still observe.

    A keyframe is redundant when enough others observe nearly all of its points at the same scale, a
    finer or the next coarser one. The map's first keyframe stays, and the num_protected keyframes
    that share most points with the newest, and those of the indices `keep`. Younger ones go first.
    The keyframe that shares most points with a removed one is its successor. Returns the removed.
    """
    around = world.covisible(newest.seen_points(), config.neighborhood)
    ids = world.points_of(around)
    levels = _levels(ids, around, world.size)
    keep = keep | {world.keyframes[0].index, newest.index}
    rows = [row for row in range(num_protected, len(around)) if around[row].index not in keep]
    removed = []
    for row in sorted(rows, key=lambda row: -around[row].index):
        own = np.flatnonzero(levels[row] < _UNSEEN)
        is_as_fine = levels[:, own] <= levels[row, own] + config.max_coarser_levels
        num_others = np.count_nonzero(is_as_fine, axis=0) - 1
        num_redundant = np.count_nonzero(num_others >= config.min_other_observers)
        if num_redundant >= config.redundancy_ratio * len(own):
            levels[row] = _UNSEEN
            _remove(world, around[row])
            removed.append(around[row])
    return removed


def _levels(ids: NDArray[np.int64], keyframes: list[Keyframe], size: int) -> NDArray[np.int8]:
    """Return [keyframes, ids] at which pyramid level each keyframe observes each point, or _UNSEEN."""
    column = np.full(size + 1, -1)
    column[ids] = np.arange(len(ids))
    levels = np.full((len(keyframes), len(ids)), _UNSEEN, dtype=np.int8)
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
    drop_points(world, points[world.num_observations[points] < world.config.min_observations])
