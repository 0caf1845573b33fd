"""Bundle adjustment of the newest keyframe and of those around it.

There are three steps: `build_window` copies arrays from the map, `solve` adjusts them, and
`apply_solution` writes the result. The second step does not access the map, so that another process
may run it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import BundleAdjustmentConfig
from cohdc_train.slam.geometry.se3 import Array, inverse, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe, observations_at
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.bundle_adjustment import Problem, adjust, measurement_chi2
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel, concatenate


@dataclass(frozen=True)
class Window:
    """Input of a bundle adjustment.

    keyframes: [k] the newest last; poses: [c, 4, 4] T_cw, m, before adjustment, of the keyframes
    and then of c - k other frames; ids: [p] map points; points: [p, 3] world, m, before adjustment;
    problem: m measurements; keypoints: [m] row of each measurement in its frame's keypoints.
    """

    keyframes: list[Keyframe]
    poses: list[Array]
    ids: NDArray[np.int64]
    points: Array
    problem: Problem
    keypoints: NDArray[np.int64]


@dataclass(frozen=True)
class FrameObservations:
    """Observations of a frame that is not a keyframe.

    T_cw: [4, 4] world to camera, m; ids: [m] map points, each once; observations: the m
    measurements.
    """

    T_cw: Array
    ids: NDArray[np.int64]
    observations: Observations


@dataclass(frozen=True)
class Solution:
    """Result of a bundle adjustment.

    poses: [c, 4, 4] T_cw, m; points: [p, 3] world, m; good: [m] bool, True = inlier.
    """

    poses: Array
    points: Array
    good: NDArray[np.bool_]


def build_window(point_map: Map, keyframe: Keyframe, config: BundleAdjustmentConfig) -> Window:
    """Build the window of a keyframe from the keyframes that share the most points with it.

    At most a quarter of the keyframes is fixed.
    """
    keyframes = point_map.covisible(keyframe.observed_point_ids(), config.local_keyframes)
    keyframes.sort(key=lambda k: k.index)
    num_fixed = max(1, min(config.local_fixed, len(keyframes) // 4))
    return select_window(point_map, keyframes, num_fixed)


def select_window(
    point_map: Map,
    keyframes: list[Keyframe],
    fixed: int,
    observed: Sequence[FrameObservations] = (),
) -> Window:
    """Copy keyframes and the points they observe from the map.

    Args:
        point_map: the map.
        keyframes: keyframes of the window, the newest last.
        fixed: number of keyframes that stay fixed, from the first; their points are included only
            where another keyframe observes them.
        observed: observations of other frames.
    """
    ids = point_map.points_of(keyframes[fixed:])
    row = np.full(point_map.size + 1, -1)
    row[ids] = np.arange(len(ids))
    point_ids = [k.point_ids for k in keyframes] + [s.ids for s in observed]
    keypoints = [np.flatnonzero(row[points] >= 0) for points in point_ids]
    points = [row[frame_ids[c]] for frame_ids, c in zip(point_ids, keypoints, strict=True)]
    observations = [
        observations_at(k.features, c) for k, c in zip(keyframes, keypoints, strict=False)
    ]
    observations += [
        s.observations.take(c) for s, c in zip(observed, keypoints[len(keyframes) :], strict=True)
    ]
    rows = np.concatenate(points)
    problem = Problem(
        cameras=np.repeat(np.arange(len(keypoints)), [len(c) for c in keypoints]),
        points=rows,
        observations=concatenate(observations).weighted(point_map.static_odds.weight(ids)[rows]),
        free=np.arange(len(keypoints)) >= fixed,
    )
    poses = [k.T_cw for k in keyframes] + [s.T_cw for s in observed]
    return Window(
        keyframes, poses, ids, point_map.positions[ids], problem, np.concatenate(keypoints)
    )


def solve(
    poses: Array,
    points: Array,
    problem: Problem,
    reprojection: ReprojectionModel,
    config: BundleAdjustmentConfig,
) -> Solution:
    """Minimize the robust cost, and then the squared cost without outliers.

    The arrays are those of `Window`.
    """
    poses, points = adjust(poses, points, problem, reprojection, config.robust_steps)
    good = (
        measurement_chi2(poses, points, problem, reprojection)
        <= problem.observations.chi2_thresholds
    )
    inliers, steps = problem.take(good), config.final_steps
    poses, points = adjust(poses, points, inliers, reprojection, steps, robust=False)
    good = (
        measurement_chi2(poses, points, problem, reprojection)
        <= problem.observations.chi2_thresholds
    )
    return Solution(poses, points, good)


def apply_solution(point_map: Map, window: Window, solution: Solution) -> Array | None:
    """Write a solution into the map, and remove outlier measurements.

    The map may have changed since the window was built: younger keyframes and points move with the
    window's newest keyframe. No keyframe of the window may have been removed.

    Returns:
        The motion [4, 4] of the newest keyframe: a pose T_cw estimated since then becomes
        T_cw @ motion. None, and no change, where a loop closure has moved one of the keyframes.
    """
    if any(k.T_cw is not before for k, before in zip(window.keyframes, window.poses, strict=False)):
        return None
    last = len(window.keyframes) - 1
    motion: Array = inverse(window.poses[last]) @ solution.poses[last]
    newest = window.keyframes[last].index
    for keyframe in point_map.keyframes:
        if keyframe.index > newest:
            keyframe.T_cw = keyframe.T_cw @ motion
    added = np.flatnonzero(point_map.first_keyframe[: point_map.size] > newest)
    point_map.positions[added] = to_local(inverse(motion), point_map.positions[added])
    # The row of a removed point may hold a younger one.
    same = point_map.first_keyframe[window.ids] <= newest
    point_map.positions[window.ids[same]] = solution.points[same]
    for slot, member in enumerate(window.keyframes):
        member.T_cw = solution.poses[slot]
        rows = (window.problem.cameras == slot) & ~solution.good
        keypoints, ids = window.keypoints[rows], window.ids[window.problem.points[rows]]
        point_map.forget(member, keypoints[member.point_ids[keypoints] == ids])
    return motion


def adjust_window(
    point_map: Map,
    keyframe: Keyframe,
    reprojection: ReprojectionModel,
    config: BundleAdjustmentConfig,
) -> None:
    """Bundle-adjust the newest keyframe and its most covisible ones, and remove outliers."""
    window = build_window(point_map, keyframe, config)
    poses = np.stack(window.poses)
    solution = solve(poses, window.points, window.problem, reprojection, config)
    apply_solution(point_map, window, solution)
