"""Culling of redundant keyframes, so that a map grows with the space, not with time."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import KeyframeCullingConfig
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import remove_points

_UNSEEN = 100  # level of a point that a keyframe does not observe


def cull_keyframes(
    point_map: Map,
    newest: Keyframe,
    keep: set[int],
    config: KeyframeCullingConfig,
    num_protected: int,
) -> list[Keyframe]:
    """Remove redundant keyframes around the newest, and points that too few still observe.

    A keyframe is redundant when enough others observe nearly all of its points at the same scale, a
    finer or the next coarser one. The map's first keyframe stays, and the num_protected keyframes
    that share most points with the newest, and those of the indices `keep`. Younger ones go first.
    The keyframe that shares most points with a removed one is its successor. Returns the removed.
    """
    around = point_map.covisible(newest.observed_point_ids(), config.neighborhood)
    ids = point_map.points_of(around)
    levels = _levels(ids, around, point_map.size)
    keep = keep | {point_map.keyframes[0].index, newest.index}
    rows = [row for row in range(num_protected, len(around)) if around[row].index not in keep]
    removed = []
    for row in sorted(rows, key=lambda row: -around[row].index):
        own = np.flatnonzero(levels[row] < _UNSEEN)
        is_as_fine = levels[:, own] <= levels[row, own] + config.max_coarser_levels
        num_others = np.count_nonzero(is_as_fine, axis=0) - 1
        num_redundant = np.count_nonzero(num_others >= config.min_other_observers)
        if num_redundant >= config.redundancy_ratio * len(own):
            levels[row] = _UNSEEN
            _remove(point_map, around[row])
            removed.append(around[row])
    return removed


def _levels(ids: NDArray[np.int64], keyframes: list[Keyframe], size: int) -> NDArray[np.int8]:
    """Return [keyframes, ids] the pyramid level of each observation, _UNSEEN without one."""
    column = np.full(size + 1, -1)
    column[ids] = np.arange(len(ids))
    levels = np.full((len(keyframes), len(ids)), _UNSEEN, dtype=np.int8)
    for row, keyframe in zip(levels, keyframes, strict=True):
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        row[column[keyframe.point_ids[keypoints]]] = keyframe.features.octaves[keypoints]
    return levels


def _remove(point_map: Map, keyframe: Keyframe) -> None:
    points = keyframe.observed_point_ids()
    successor = next(
        (k for k in point_map.covisible(points, 2) if k is not keyframe), point_map.keyframes[0]
    )
    point_map.remove_keyframe(keyframe, successor)
    remove_points(
        point_map, points[point_map.num_observations[points] < point_map.config.min_observations]
    )
