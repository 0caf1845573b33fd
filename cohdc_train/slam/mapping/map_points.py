"""What a keyframe that joins brings: new points, duplicates merged, local bundle adjustment, weak
points out.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.matching import match_projected
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map


def add_points(world: Map, keyframe: Keyframe, max_depth_m: float) -> None:
    """Create a point for every keypoint with usable depth that belongs to none."""
    features = keyframe.features
    usable = (keyframe.point_ids < 0) & (features.depths <= max_depth_m)  # nan compares False
    world.add_points(keyframe, np.flatnonzero(usable))


def fuse(world: Map, keyframe: Keyframe) -> None:
    """Look for the keyframe's points in its neighbours: more measurements; duplicates become the
    older point.
    """
    ids = keyframe.seen_points()
    neighbors = [
        k for k in world.covisible(ids, world.config.fuse_keyframes + 1) if k is not keyframe
    ]
    pairs = [_look_for(world, ids, other) for other in neighbors]
    if pairs:
        _merge(world, np.concatenate(pairs, axis=1), [keyframe, *neighbors])


def fuse_into(
    world: Map, ids: NDArray[np.int64], other: Keyframe, keyframes: list[Keyframe]
) -> None:
    """Look for points in one keyframe that may not know them yet; `keyframes` are all that may hold
    duplicates.
    """
    _merge(world, _look_for(world, ids, other), keyframes)


def _look_for(world: Map, ids: NDArray[np.int64], other: Keyframe) -> NDArray[np.int64]:
    """Look for points in one keyframe, where they become measurements of corners that belong to
    none.

    Returns [2, k] such points, and those that their corners belong to.
    """
    config = world.config
    projected = world.project(world.unseen(ids, other), other.T_cw)
    matches = match_projected(
        projected, other.features, config.fuse_radius_px, world.matching, config.fuse_max_hamming
    )
    current = other.point_ids[matches.keypoints]
    world.observe(other, matches.take(current < 0))
    return np.stack([matches.points, current])[:, current >= 0]


def _merge(world: Map, pairs: NDArray[np.int64], keyframes: list[Keyframe]) -> None:
    """Of pairs [2, k] of points that look alike, those that are near each other become one."""
    distance = np.linalg.norm(world.positions[pairs[0]] - world.positions[pairs[1]], axis=1)
    first, second = pairs[:, distance < world.config.fuse_distance_m]
    if len(first) == 0:
        return
    later = world.first_keyframe[first] - world.first_keyframe[second]
    older = np.where(
        later == 0, first < second, later < 0
    )  # one order of all points, so that no two swap places
    old, new = np.where(older, second, first), np.where(older, first, second)
    gives_way = np.zeros(world.size, dtype=np.bool_)
    gives_way[old] = True
    stays = ~gives_way[new]  # a point that itself gives way this time waits for the next keyframe
    world.replace(old[stays], new[stays], keyframes)


def cull(world: Map, newest: int) -> None:
    """Drop young points that few keyframes confirmed or that frames rarely found where they should
    be.
    """
    config = world.config
    oldest = newest - config.probation_keyframes
    is_young = world.first_keyframe[: world.size] >= oldest
    young = np.flatnonzero(is_young & (world.num_observations[: world.size] > 0))

    weak = world.first_keyframe[young] == oldest
    weak &= world.num_observations[young] < config.min_observations
    weak |= world.found[young] < config.min_found_ratio * world.visible[young]
    drop_points(world, young[weak])


def drop_points(world: Map, ids: NDArray[np.int64]) -> None:
    """No keyframe sees these points any more."""
    drop = np.zeros(world.size + 1, dtype=np.bool_)
    drop[ids] = True
    for keyframe in world.observers_of(ids):
        world.forget(keyframe, np.flatnonzero(drop[keyframe.point_ids]))
