"""Keyframe culling: bounded map, and consistent map after removals."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from plane_world import CAMERA, camera_path, render, room, slam_config, track

from cohdc_train.slam.config import BundleAdjustmentConfig, KeyframeConfig, KeyframeCullingConfig
from cohdc_train.slam.geometry.se3 import Array, exp_se3
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.keyframe_culling import cull_keyframes
from cohdc_train.slam.mapping.local_bundle_adjustment import (
    Solution,
    apply_solution,
    build_window,
)
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.patch_refiner import affine
from cohdc_train.slam.system import Slam
from cohdc_train.slam.tracking.keyframe_policy import KeyframePolicy
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

ROUND = 20  # frames until the camera is back
ROUNDS = 4
PATH = camera_path(60)[::3]
CULLING = KeyframeCullingConfig()
ADJUSTMENT = BundleAdjustmentConfig()
WINDOW = ADJUSTMENT.local_keyframes


def sway(rounds: int, **options: object) -> Slam:
    """Track a camera that sways in front of a room, with every second frame a keyframe.

    Each round ends where it began.
    """
    config = slam_config(
        250,
        keyframes__min_tracked_ratio=0.75,
        keyframes__max_interval_frames=2,
        keyframes__known_point_age=1000,
        **options,
    )
    slam = Slam(CAMERA, config)
    views = [render(room(), T_wc)[:2] for T_wc in PATH]
    for number in range(rounds * ROUND):
        assert track(slam, *views[number % ROUND], number / 30).is_tracked
    return slam


@pytest.fixture(scope="module")
def culled() -> Slam:
    return sway(ROUNDS)


@pytest.fixture(scope="module")
def never_culled() -> Slam:
    return sway(ROUNDS, keyframe_culling__enabled=False)


@pytest.fixture
def whole(never_culled: Slam, monkeypatch: pytest.MonkeyPatch) -> Slam:
    """Return the run without culling, with a copy of its map that a test may change."""
    monkeypatch.setattr(never_culled, "map", deepcopy(never_culled.map))
    return never_culled


def test_map_of_known_room_stops_growing(culled: Slam, never_culled: Slam) -> None:
    assert len(never_culled.map.keyframes) == never_culled.map.num_inserted >= ROUNDS * ROUND / 2
    assert len(culled.map.keyframes) < 0.6 * len(never_culled.map.keyframes)
    assert len(culled.map.keyframes) <= len(sway(ROUNDS - 2).map.keyframes) + 2
    assert ate(culled) < max(1.2 * ate(never_culled), 0.004)


def test_number_of_patches_is_bounded_by_number_of_points() -> None:
    """Refinement stores a patch per row, and refines points whose first keyframe was removed."""
    slam = sway(2)
    assert slam.tracker.parts.refiner is not None
    assert slam.map.num_inserted > len(slam.map.keyframes)
    assert len(slam.tracker.parts.refiner._patches) == len(slam.map.positions)
    assert len(slam.trajectory()) == 2 * ROUND


@pytest.mark.slow
def test_static_camera_at_known_place_adds_no_keyframe() -> None:
    """After twelve keyframes at one place, the frame interval alone would ask for six more."""
    rgb, depth, _ = render(room(), PATH[0])
    slam = Slam(CAMERA, slam_config(250))
    parts = slam.tracker.parts
    often = KeyframeConfig(min_tracked_ratio=0.75, max_interval_frames=1)
    policy = KeyframePolicy(often, has_flow=False)
    slam.tracker.parts = replace(parts, keyframe_policy=policy)
    for number in range(12):
        track(slam, rgb, depth, number / 30)
    slam.tracker.parts = parts
    later = [track(slam, rgb, depth, (12 + number) / 30) for number in range(120)]
    assert not any(pose.is_keyframe for pose in later)
    views = [
        render(room(), exp_se3(np.array([0.03 * k, 0.0, 0.0, 0.0, 0.0, 0.0])))[:2]
        for k in range(30)
    ]
    sideways = [track(slam, *view, 5 + k / 30) for k, view in enumerate(views)]
    assert all(pose.is_tracked for pose in sideways)
    assert any(pose.is_keyframe for pose in sideways), (
        "new places next to the known one are added to the map"
    )


def ate(slam: Slam) -> float:
    """Return the RMSE, m; every frame must have a pose."""
    estimate = slam.trajectory()
    assert len(estimate) == ROUNDS * ROUND
    truth = Trajectory(np.arange(ROUNDS * ROUND) / 30, np.tile(PATH, (ROUNDS, 1, 1)))
    return score(truth, estimate)["ate_m"]["rmse"]


def test_observers_are_consistent_after_culling(culled: Slam) -> None:
    world = culled.map
    assert world.num_inserted > len(world.keyframes)
    observed = [keyframe.observed_point_ids() for keyframe in world.keyframes]
    counts = np.bincount(np.concatenate(observed), minlength=world.size)
    np.testing.assert_array_equal(world.num_observations[: world.size], counts)
    there = {keyframe.index for keyframe in world.keyframes}
    remembered = np.unique(world.observers[: world.size]) - 1
    assert set(remembered.tolist()) <= there | {-1}
    assert world.keyframes[0].index == 0
    assert [keyframe.index for keyframe in world.keyframes] == sorted(there)
    assert world.size < 2 * np.count_nonzero(counts), "new points reuse the rows of removed ones"


def test_frames_and_points_stay_in_place_when_keyframe_is_removed(whole: Slam) -> None:
    world, T_cw = whole.map, exp_se3(np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0]))
    stamps, before = whole.trajectory().timestamps, whole.trajectory().poses
    removed = cull_keyframes(world, world.keyframes[-1], set(), CULLING, WINDOW)
    assert removed
    first_keyframe = np.flatnonzero(
        np.isin(world.first_keyframe[: world.size], [k.index for k in removed])
        & (world.num_observations[: world.size] > 0)
    )
    assert len(first_keyframe)
    np.testing.assert_allclose(whole.trajectory().poses, before, atol=1e-9)
    np.testing.assert_array_equal(whole.trajectory().timestamps, stamps)
    maps, places = affine(world, first_keyframe, T_cw), world.positions[first_keyframe].copy()
    step = exp_se3(np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]))
    world.move(
        np.stack([k.T_cw for k in world.keyframes]) @ np.linalg.inv(step)
    )  # as loop closure does
    np.testing.assert_allclose(
        world.positions[first_keyframe], places @ step[:3, :3].T + step[:3, 3], atol=1e-9
    )
    np.testing.assert_allclose(whole.trajectory().poses, step @ before, atol=1e-9)
    np.testing.assert_allclose(
        affine(world, first_keyframe, T_cw @ np.linalg.inv(step)), maps, atol=1e-9
    )


def test_protected_keyframes_are_never_culled(whole: Slam) -> None:
    world = whole.map
    newest = world.keyframes[-1]
    window = {keyframe.index for keyframe in world.covisible(newest.observed_point_ids(), WINDOW)}
    redundant = [
        keyframe.index
        for keyframe in cull_keyframes(deepcopy(world), newest, set(), CULLING, WINDOW)
    ]
    kept = set(redundant[::2])
    removed = {keyframe.index for keyframe in cull_keyframes(world, newest, kept, CULLING, WINDOW)}
    assert kept
    assert removed
    assert not removed & (window | kept | {0, newest.index})


def test_running_adjustment_does_not_move_point_in_reused_row(whole: Slam) -> None:
    world = whole.map
    newest, features = world.keyframes[-1], world.keyframes[-1].features
    window = build_window(world, newest, ADJUSTMENT)
    gone = window.ids[:30]
    for keyframe in world.keyframes:
        world.forget(keyframe, np.flatnonzero(np.isin(keyframe.point_ids, gone)))
    later = keyframe_like(world, newest)
    world.add_keyframe(later)
    world.add_points(later, np.flatnonzero(features.depths > 0)[:20])
    assert set(later.observed_point_ids()) & set(gone.tolist())
    before: Array = world.positions[later.observed_point_ids()].copy()
    good = np.ones(len(window.keypoints), dtype=np.bool_)
    apply_solution(world, window, Solution(np.stack(window.poses), window.points + 0.5, good))
    np.testing.assert_allclose(world.positions[later.observed_point_ids()], before, atol=1e-9)


def keyframe_like(world: Map, keyframe: Keyframe) -> Keyframe:
    """Return a new keyframe at the same place that observes no point yet."""
    free = np.full(len(keyframe.features), -1)
    images = (keyframe.thumbnail, keyframe.min_depth_grid)
    return Keyframe(
        world.num_inserted,
        keyframe.timestamp + 1,
        keyframe.T_cw.copy(),
        keyframe.features,
        free,
        *images,
    )
