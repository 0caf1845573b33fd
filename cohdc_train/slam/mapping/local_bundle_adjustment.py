"""Bundle adjustment of the keyframes around the newest one.

Three steps: `build_window` copies arrays from the map, `solve` adjusts them, and `apply_solution`
writes the result. The second step touches no map, so that another process may run it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import BundleAdjustmentConfig
from cohdc_train.slam.geometry.se3 import Array, inverse, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.bundle_adjustment import Problem, adjust, measurement_chi2
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel, concatenate


@dataclass(frozen=True)
class Window:
    """Input of a bundle adjustment.

    keyframes: [k] the newest last; poses: [c, 4, 4] T_cw, m, of the keyframes and then of c - k
    other frames, before adjustment; ids: [p] map points; points: [p, 3] world, m, before
    adjustment; problem: m measurements; keypoints: [m] row of each in its frame's keypoints.
    """

    keyframes: list[Keyframe]
    poses: list[Array]
    ids: NDArray[np.int64]
    points: Array
    problem: Problem
    keypoints: NDArray[np.int64]


@dataclass(frozen=True)
class FrameObservations:
    """Observations of a frame that is no keyframe.

    T_cw: [4, 4] world to camera, m; ids: [m] map points, each once; seen: the m measurements, with
    the weight of static points.
    """

    T_cw: Array
    ids: NDArray[np.int64]
    seen: Observations


@dataclass(frozen=True)
class Solution:
    """Result of a bundle adjustment.

    poses: [c, 4, 4] T_cw, m; points: [p, 3] world, m; good: [m] bool, True = inlier.
    """

    poses: Array
    points: Array
    good: NDArray[np.bool_]


def build_window(point_map: Map, keyframe: Keyframe, config: BundleAdjustmentConfig) -> Window:
    """Build the window of a keyframe: those that share most points with it, and what they observe.

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
    """Keyframes, the newest last, of which the first few are fixed, with all measurements of the
    others' points.
    """
    ids = point_map.points_of(keyframes[fixed:])
    row = np.full(point_map.size + 1, -1)
    row[ids] = np.arange(len(ids))
    named = [k.point_ids for k in keyframes] + [s.ids for s in observed]
    keypoints = [np.flatnonzero(row[points] >= 0) for points in named]
    points = [row[all_of_them[c]] for all_of_them, c in zip(named, keypoints, strict=True)]
    seen = [observations(k.features, c) for k, c in zip(keyframes, keypoints, strict=False)]
    seen += [s.seen.take(c) for s, c in zip(observed, keypoints[len(keyframes) :], strict=True)]
    rows = np.concatenate(points)
    problem = Problem(
        cameras=np.repeat(np.arange(len(keypoints)), [len(c) for c in keypoints]),
        points=rows,
        seen=concatenate(seen).weighted(point_map.static_weight(ids)[rows]),
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
    """Minimize the robust cost, then the squared one without outliers. Arrays as in `Window`."""
    poses, points = adjust(poses, points, problem, reprojection, config.robust_steps)
    good = measurement_chi2(poses, points, problem, reprojection) <= problem.seen.chi2_thresholds
    inliers, steps = problem.take(good), config.final_steps
    poses, points = adjust(poses, points, inliers, reprojection, steps, robust=False)
    good = measurement_chi2(poses, points, problem, reprojection) <= problem.seen.chi2_thresholds
    return Solution(poses, points, good)


def apply_solution(point_map: Map, window: Window, solution: Solution) -> Array | None:
    """Write a solution into the map, and remove outlier measurements.

    The map may have changed since the window was built: younger keyframes and points move with the
    window's newest keyframe. No keyframe of the window may have been removed.

    Returns that motion [4, 4]: a pose T_cw estimated since then becomes T_cw @ motion. Returns None
    without a change where a loop closure has moved one of the keyframes meanwhile.
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
    # A younger point may have taken the row of a removed one.
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
    """Bundle-adjust the newest keyframe with those that share most points, and drop outliers."""
    window = build_window(point_map, keyframe, config)
    poses = np.stack(window.poses)
    solution = solve(poses, window.points, window.problem, reprojection, config)
    apply_solution(point_map, window, solution)
