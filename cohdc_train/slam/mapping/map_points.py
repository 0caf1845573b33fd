"""Creation, fusion, and culling of map points around a new keyframe."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.matching import match_projected
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.projection import project_points


def add_points(point_map: Map, keyframe: Keyframe, max_depth_m: float) -> None:
    """Create a point for every keypoint with usable depth that has none."""
    features = keyframe.features
    usable = (keyframe.point_ids < 0) & (features.depths <= max_depth_m)  # nan compares False
    point_map.add_points(keyframe, np.flatnonzero(usable))


def fuse(point_map: Map, keyframe: Keyframe) -> None:
    """Match a keyframe's points into covisible keyframes, and merge duplicates."""
    ids = keyframe.observed_point_ids()
    neighbors = [
        k
        for k in point_map.covisible(ids, point_map.config.fuse_keyframes + 1)
        if k is not keyframe
    ]
    pairs = [_match_into(point_map, ids, other) for other in neighbors]
    if pairs:
        _merge(point_map, np.concatenate(pairs, axis=1), [keyframe, *neighbors])


def fuse_into(
    point_map: Map, ids: NDArray[np.int64], other: Keyframe, keyframes: list[Keyframe]
) -> None:
    """Match points into another keyframe, and merge duplicates.

    keyframes: all keyframes that may observe duplicates.
    """
    _merge(point_map, _match_into(point_map, ids, other), keyframes)


def _match_into(point_map: Map, ids: NDArray[np.int64], other: Keyframe) -> NDArray[np.int64]:
    """Project points into a keyframe, and match them with its keypoints.

    Keypoints without a point get one. Returns [2, k] pairs of a point and of the point that its
    keypoint already has.
    """
    config = point_map.config
    projected = project_points(point_map, point_map.unseen(ids, other), other.T_cw)
    matches = match_projected(
        projected,
        other.features,
        config.fuse_radius_px,
        point_map.matching,
        config.fuse_max_hamming,
    )
    current = other.point_ids[matches.keypoints]
    point_map.observe(other, matches.take(current < 0))
    return np.stack([matches.point_ids, current])[:, current >= 0]


def _merge(point_map: Map, pairs: NDArray[np.int64], keyframes: list[Keyframe]) -> None:
    """Merge pairs [2, k] of points with similar descriptors where they are close to each other."""
    distance = np.linalg.norm(point_map.positions[pairs[0]] - point_map.positions[pairs[1]], axis=1)
    first, second = pairs[:, distance < point_map.config.fuse_distance_m]
    if len(first) == 0:
        return
    age = point_map.first_keyframe[first] - point_map.first_keyframe[second]
    # A total order of the points, so that no two replace each other.
    older = np.where(age == 0, first < second, age < 0)
    old, new = np.where(older, second, first), np.where(older, first, second)
    is_replaced = np.zeros(point_map.size, dtype=np.bool_)
    is_replaced[old] = True
    # A point that is itself replaced receives no other until the next keyframe.
    can_merge = ~is_replaced[new]
    point_map.replace(old[can_merge], new[can_merge], keyframes)


def cull_map_points(point_map: Map, newest: int) -> None:
    """Remove young points that few keyframes observe, or that frames rarely match."""
    config = point_map.config
    oldest = newest - config.probation_keyframes
    is_young = point_map.first_keyframe[: point_map.size] >= oldest
    young = np.flatnonzero(is_young & (point_map.num_observations[: point_map.size] > 0))

    weak = point_map.first_keyframe[young] == oldest
    weak &= point_map.num_observations[young] < config.min_observations
    weak |= point_map.found[young] < config.min_found_ratio * point_map.visible[young]
    remove_points(point_map, young[weak])


def remove_points(point_map: Map, ids: NDArray[np.int64]) -> None:
    """Remove points from all keyframes that observe them."""
    drop = np.zeros(point_map.size + 1, dtype=np.bool_)
    drop[ids] = True
    for keyframe in point_map.observers_of(ids):
        point_map.forget(keyframe, np.flatnonzero(drop[keyframe.point_ids]))
