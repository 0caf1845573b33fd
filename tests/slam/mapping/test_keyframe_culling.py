"""A map that grows with the room, not with time; and what may never be lost when keyframes and
points go.
"""

from copy import deepcopy

import numpy as np
import pytest
from plane_world import CAMERA, camera_path, render, room

from cohdc_train.slam.config import Method
from cohdc_train.slam.geometry.se3 import Array, exp_se3
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.keyframe_culling import cull_keyframes
from cohdc_train.slam.mapping.local_bundle_adjustment import (
    WINDOW,
    Solution,
    close_window,
    open_window,
)
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.patch_refiner import affine
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

ROUND = 20  # frames until the hand is back
ROUNDS = 4
PATH = camera_path(60)[::3]


def sway(rounds: int, **parts: bool) -> Tracker:
    """A hand that sways before the room, every second frame a keyframe; the end of each round is
    its beginning.
    """
    tracker = Tracker(CAMERA, features=250, method=Method(**parts))
    views = [render(room(), T_wc)[:2] for T_wc in PATH]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cohdc_train.slam.tracking.tracker._KEYFRAME_SHARE", 0.75)
        patch.setattr("cohdc_train.slam.tracking.tracker._KEYFRAME_FRAMES", 2)
        patch.setattr("cohdc_train.slam.tracking.tracker._OLD", 1000)
        for number in range(rounds * ROUND):
            assert tracker.track(*views[number % ROUND], number / 30).tracked
    return tracker


@pytest.fixture(scope="module")
def culled() -> Tracker:
    return sway(ROUNDS)


@pytest.fixture(scope="module")
def never_culled() -> Tracker:
    return sway(ROUNDS, keyframe_culling=False)


@pytest.fixture
def whole(never_culled: Tracker, monkeypatch: pytest.MonkeyPatch) -> Tracker:
    """The same with a map to spoil."""
    monkeypatch.setattr(never_culled, "map", deepcopy(never_culled.map))
    return never_culled


def test_the_map_of_a_known_room_stops_growing(culled: Tracker, never_culled: Tracker) -> None:
    assert len(never_culled.map.keyframes) == never_culled.map.joined >= ROUNDS * ROUND / 2
    assert len(culled.map.keyframes) < 0.6 * len(never_culled.map.keyframes)
    assert len(culled.map.keyframes) <= len(sway(ROUNDS - 2).map.keyframes) + 2
    assert ate(culled) < max(1.2 * ate(never_culled), 0.004)


def test_patches_are_bounded_with_the_points() -> None:
    """Refinement keeps one per row of the map; a point whose first keyframe has gone is still
    refined.
    """
    tracker = sway(2, refinement=True)
    assert tracker._refiner is not None
    assert tracker.map.joined > len(tracker.map.keyframes)
    assert len(tracker._refiner._patches) == len(tracker.map.positions)
    assert len(tracker.trajectory()[0]) == 2 * ROUND


@pytest.mark.slow
def test_a_known_place_needs_no_keyframe() -> None:
    """Twelve keyframes at one place, a hand that then holds still: at 30 frames/s the clock alone
    would ask for six.
    """
    rgb, depth, _ = render(room(), PATH[0])
    tracker = Tracker(CAMERA, features=250)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cohdc_train.slam.tracking.tracker._KEYFRAME_SHARE", 0.75)
        patch.setattr("cohdc_train.slam.tracking.tracker._KEYFRAME_FRAMES", 1)
        for number in range(12):
            tracker.track(rgb, depth, number / 30)
    later = [tracker.track(rgb, depth, (12 + number) / 30) for number in range(120)]
    assert not any(pose.keyframe for pose in later)
    views = [
        render(room(), exp_se3(np.array([0.03 * k, 0.0, 0.0, 0.0, 0.0, 0.0])))[:2]
        for k in range(30)
    ]
    aside = [tracker.track(*view, 5 + k / 30) for k, view in enumerate(views)]
    assert all(pose.tracked for pose in aside)
    assert any(pose.keyframe for pose in aside), (
        "what comes into view beside it is taken into the map"
    )


def ate(tracker: Tracker) -> float:
    """RMSE, m; every frame must have a pose."""
    stamps, poses = tracker.trajectory()
    assert len(stamps) == ROUNDS * ROUND
    truth = Trajectory(np.arange(ROUNDS * ROUND) / 30, np.tile(PATH, (ROUNDS, 1, 1)))
    return score(truth, Trajectory(stamps, poses))["ate_m"]["rmse"]


def test_the_books_are_right_after_many_removals(culled: Tracker) -> None:
    world = culled.map
    assert world.joined > len(world.keyframes)
    seen = [keyframe.seen_points() for keyframe in world.keyframes]
    counts = np.bincount(np.concatenate(seen), minlength=world.size)
    np.testing.assert_array_equal(world.num_observations[: world.size], counts)
    there = {keyframe.index for keyframe in world.keyframes}
    remembered = np.unique(world.observers[: world.size]) - 1
    assert set(remembered.tolist()) <= there | {-1}
    assert world.keyframes[0].index == 0
    assert [keyframe.index for keyframe in world.keyframes] == sorted(there)
    assert world.size < 2 * np.count_nonzero(counts), "new points take the rows of former ones"


def test_what_hangs_on_a_keyframe_that_goes_stays_where_it_is(whole: Tracker) -> None:
    world, T_cw = whole.map, exp_se3(np.array([0.1, 0.0, 0.1, 0.0, 0.1, 0.0]))
    stamps, before = whole.trajectory()
    removed = cull_keyframes(world, world.keyframes[-1], set())
    assert removed
    first_keyframe = np.flatnonzero(
        np.isin(world.first_keyframe[: world.size], [k.index for k in removed])
        & (world.num_observations[: world.size] > 0)
    )
    assert len(first_keyframe)
    np.testing.assert_allclose(whole.trajectory()[1], before, atol=1e-9)
    np.testing.assert_array_equal(whole.trajectory()[0], stamps)
    maps, places = affine(world, first_keyframe, T_cw), world.positions[first_keyframe].copy()
    step = exp_se3(np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]))
    world.move(
        np.stack([k.T_cw for k in world.keyframes]) @ np.linalg.inv(step)
    )  # as a loop moves it
    np.testing.assert_allclose(
        world.positions[first_keyframe], places @ step[:3, :3].T + step[:3, 3], atol=1e-9
    )
    np.testing.assert_allclose(whole.trajectory()[1], step @ before, atol=1e-9)
    np.testing.assert_allclose(
        affine(world, first_keyframe, T_cw @ np.linalg.inv(step)), maps, atol=1e-9
    )


def test_some_keyframes_never_go(whole: Tracker) -> None:
    world = whole.map
    newest = world.keyframes[-1]
    window = {keyframe.index for keyframe in world.covisible(newest.seen_points(), WINDOW)}
    redundant = [keyframe.index for keyframe in cull_keyframes(deepcopy(world), newest, set())]
    kept = set(redundant[::2])
    removed = {keyframe.index for keyframe in cull_keyframes(world, newest, kept)}
    assert kept
    assert removed
    assert not removed & (window | kept | {0, newest.index})


def test_a_window_under_way_moves_no_point_that_took_a_row_meanwhile(whole: Tracker) -> None:
    world = whole.map
    newest, features = world.keyframes[-1], whole.features
    assert features is not None
    window = open_window(world, newest)
    gone = window.ids[:30]
    for keyframe in world.keyframes:
        world.forget(keyframe, np.flatnonzero(np.isin(keyframe.point_ids, gone)))
    later = keyframe_like(world, newest)
    world.add_keyframe(later)
    world.add_points(later, np.flatnonzero(features.depths > 0)[:20])
    assert set(later.seen_points()) & set(gone.tolist())
    before: Array = world.positions[later.seen_points()].copy()
    good = np.ones(len(window.keypoints), dtype=np.bool_)
    close_window(world, window, Solution(np.stack(window.poses), window.points + 0.5, good))
    np.testing.assert_allclose(world.positions[later.seen_points()], before, atol=1e-9)


def keyframe_like(world: Map, keyframe: Keyframe) -> Keyframe:
    """A new one at the same place that sees no point yet."""
    free, pictures = np.full(len(keyframe.features), -1), (keyframe.thumbnail, keyframe.nearest)
    return Keyframe(
        world.joined, keyframe.t + 1, keyframe.T_cw.copy(), keyframe.features, free, *pictures
    )
