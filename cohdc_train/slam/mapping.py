"""What happens when a keyframe joins: new points, duplicates merged, local bundle adjustment, weak points out."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.bundle_adjustment import Problem, adjust, measurement_chi2
from cohdc_train.slam.map import Keyframe, Map, observations
from cohdc_train.slam.matching import match_projected
from cohdc_train.slam.optimization import Observations, Weighing

WINDOW = 12  # keyframes in local bundle adjustment
FIXED = 3  # of them hold still and carry the frame of reference
_FUSE_KEYFRAMES = 8
_TRIAL = 3  # keyframes after which a point must have proved itself
_MIN_SEEN_BY = 3
_MIN_FOUND = 0.25


def insert_keyframe(world: Map, keyframe: Keyframe, weighing: Weighing) -> None:
    """Take a tracked keyframe into the map and put its neighbourhood in order."""
    world.add_keyframe(keyframe)
    add_points(world, keyframe)
    if len(world.keyframes) == 1:
        return
    fuse(world, keyframe)
    adjust_window(world, keyframe, weighing)
    cull(world, keyframe.index)


def add_points(world: Map, keyframe: Keyframe) -> None:
    """A point for every corner with depth that belongs to none."""
    features = keyframe.features
    usable = (keyframe.point_ids < 0) & (features.depths <= world.camera.far)  # nan compares False
    world.add_points(keyframe, np.flatnonzero(usable))


def fuse(world: Map, keyframe: Keyframe) -> None:
    """Look for the keyframe's points in its neighbours: more measurements; duplicates become the older point."""
    neighbours = [k for k in world.covisible(keyframe.seen_points(), _FUSE_KEYFRAMES + 1) if k is not keyframe]
    for other in neighbours:
        fuse_into(world, keyframe.seen_points(), other, [keyframe, *neighbours])


def fuse_into(world: Map, ids: NDArray[np.int64], other: Keyframe, keyframes: list[Keyframe]) -> None:
    """Look for points in one keyframe that may not know them yet; `keyframes` are all that may hold duplicates."""
    ids = np.setdiff1d(ids, other.seen_points())
    matches = match_projected(world.project(ids, other.T_cw), other.features, radius=3.0, max_distance=60)
    current = other.point_ids[matches.corners]
    world.observe(other, matches.take(current < 0))
    known = matches.take(current >= 0)
    if len(known):
        _merge(world, known.points, other.point_ids[known.corners], keyframes)


def _merge(world: Map, first: NDArray[np.int64], second: NDArray[np.int64], keyframes: list[Keyframe]) -> None:
    near = np.linalg.norm(world.positions[first] - world.positions[second], axis=1) < 0.05
    old, new = np.maximum(first, second)[near], np.minimum(first, second)[near]
    chained = np.isin(new, old)  # a point that itself gives way this time waits for the next keyframe
    world.replace(old[~chained], new[~chained], keyframes)


def adjust_window(world: Map, keyframe: Keyframe, weighing: Weighing) -> None:
    """Bundle-adjust the newest keyframe with those that share most points; measurements that do not fit are dropped."""
    window = world.covisible(keyframe.seen_points(), WINDOW)
    window.sort(key=lambda k: k.index)
    fixed = max(1, min(FIXED, len(window) // 4))
    problem, ids, corners = _problem(world, window, fixed)
    poses, points = np.stack([k.T_cw for k in window]), world.positions[ids]
    poses, points = adjust(poses, points, problem, weighing, steps=5)
    good = measurement_chi2(poses, points, problem, weighing) <= problem.seen.limits
    poses, points = adjust(poses, points, problem.take(good), weighing, steps=3, robust=False)
    good = measurement_chi2(poses, points, problem, weighing) <= problem.seen.limits
    world.positions[ids] = points
    for slot, member in enumerate(window):
        member.T_cw = poses[slot]
        world.forget(member, corners[(problem.cameras == slot) & ~good])


def _problem(world: Map, window: list[Keyframe], fixed: int) -> tuple[Problem, NDArray[np.int64], NDArray[np.int64]]:
    """The window's measurements, the ids of its points, and the corner behind every measurement."""
    ids = world.points_of(window[fixed:])
    row = np.full(world.size + 1, -1)
    row[ids] = np.arange(len(ids))
    corners = [np.flatnonzero(row[k.point_ids] >= 0) for k in window]
    seen = [observations(k.features, c, world.trust(k.point_ids[c])) for k, c in zip(window, corners, strict=True)]
    problem = Problem(
        cameras=np.repeat(np.arange(len(window)), [len(c) for c in corners]),
        points=np.concatenate([row[k.point_ids[c]] for k, c in zip(window, corners, strict=True)]),
        seen=Observations(
            np.concatenate([s.pixels for s in seen]),
            np.concatenate([s.depths for s in seen]),
            np.concatenate([s.sigmas for s in seen]),
        ),
        free=np.arange(len(window)) >= fixed,
    )
    return problem, ids, np.concatenate(corners)


def cull(world: Map, newest: int) -> None:
    """Drop young points that few keyframes confirmed or that frames rarely found where they should be."""
    young = np.flatnonzero((world.born[: world.size] >= newest - _TRIAL) & (world.seen_by[: world.size] > 0))
    weak = (world.born[young] == newest - _TRIAL) & (world.seen_by[young] < _MIN_SEEN_BY)
    weak |= world.found[young] < _MIN_FOUND * world.visible[young]
    drop = np.zeros(world.size + 1, dtype=np.bool_)
    drop[young[weak]] = True
    for keyframe in world.keyframes[max(newest - 2 * WINDOW, 0) :]:
        world.forget(keyframe, np.flatnonzero(drop[keyframe.point_ids]))
