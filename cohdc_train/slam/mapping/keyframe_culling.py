"""Culling of redundant keyframes, so that the map grows with the space and not with time."""

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
    """Remove redundant keyframes around the newest one, and points with too few observers left.

    A keyframe is redundant when enough other keyframes observe nearly all of its points at the
    same, a finer, or the next coarser scale. Younger keyframes are removed first. The keyframe that
    shares the most points with a removed one becomes its successor.

    Args:
        point_map: the map.
        newest: keyframe whose covisible keyframes are examined.
        keep: indices of keyframes that stay, in addition to the first and the newest one.
        config: criteria.
        num_protected: number of keyframes most covisible with the newest that stay as well.

    Returns:
        The removed keyframes.
    """
    neighbors = point_map.covisible(newest.observed_point_ids(), config.neighborhood)
    ids = point_map.points_of(neighbors)
    levels = _levels(ids, neighbors, point_map.size)
    keep = keep | {point_map.keyframes[0].index, newest.index}
    rows = [row for row in range(num_protected, len(neighbors)) if neighbors[row].index not in keep]
    removed = []
    for row in sorted(rows, key=lambda row: -neighbors[row].index):
        observed = np.flatnonzero(levels[row] < _UNSEEN)
        is_as_fine = levels[:, observed] <= levels[row, observed] + config.max_coarser_levels
        num_others = np.count_nonzero(is_as_fine, axis=0) - 1
        num_redundant = np.count_nonzero(num_others >= config.min_other_observers)
        if num_redundant >= config.redundancy_ratio * len(observed):
            levels[row] = _UNSEEN
            _remove(point_map, neighbors[row])
            removed.append(neighbors[row])
    return removed


def _levels(ids: NDArray[np.int64], keyframes: list[Keyframe], size: int) -> NDArray[np.int8]:
    """Return the pyramid level [keyframes, ids] of each observation, _UNSEEN where none exists."""
    column = np.full(size + 1, -1)
    column[ids] = np.arange(len(ids))
    levels = np.full((len(keyframes), len(ids)), _UNSEEN, dtype=np.int8)
    for row, keyframe in zip(levels, keyframes, strict=True):
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        row[column[keyframe.point_ids[keypoints]]] = keyframe.features.octaves[keypoints]
    return levels


def _remove(point_map: Map, keyframe: Keyframe) -> None:
    """Remove a keyframe, and its points that too few others observe."""
    points = keyframe.observed_point_ids()
    successor = next(
        (k for k in point_map.covisible(points, 2) if k is not keyframe), point_map.keyframes[0]
    )
    point_map.remove_keyframe(keyframe, successor)
    remove_points(
        point_map, points[point_map.num_observations[points] < point_map.config.min_observations]
    )
