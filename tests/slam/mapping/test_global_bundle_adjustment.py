"""The adjustment at the end, in which frames between keyframes count: what it is worth, and what it
may not do.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, features_at, render, room

from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, to_local
from cohdc_train.slam.mapping import global_bundle_adjustment as final_adjustment
from cohdc_train.slam.mapping.global_bundle_adjustment import ObservedFrames, adjust_everything
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.mapping.local_bundle_adjustment import Sighting
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.tracking.motion_model import FEW
from cohdc_train.slam.tracking.tracker import Tracker

FRAMES = 30
PATH = camera_path(FRAMES)


def measured(
    T_wc: NDArray[np.float64], points: NDArray[np.float64], rng: np.random.Generator
) -> Features:
    """What a camera sees of points [n, 3] m, to a pixel and 2 % of the depth."""
    local = to_local(inverse(T_wc), points)
    pixels = CAMERA.project(local) + rng.standard_normal((len(points), 2))
    depths = local[:, 2] * (1 + 0.02 * rng.standard_normal(len(points)))
    return features_at(pixels, depths)


def off_after_adjustment(seed: int, frames_count: bool) -> float:
    """RMSE of a map's points, m: three keyframes of thirty frames see all of them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1.0, -0.7, 1.5), (1.0, 0.7, 3.0), (200, 3))
    world, picture, ids = Map(CAMERA), np.zeros((2, 2), dtype=np.float32), np.arange(200)
    for index in range(3):
        T_wc = PATH[10 * index]
        free = np.full(200, -1) if index == 0 else ids
        keyframe = Keyframe(
            index,
            index / 3,
            inverse(T_wc),
            measured(T_wc, points, rng),
            free.copy(),
            picture,
            picture,
        )
        world.add_keyframe(keyframe)
        if index == 0:
            world.add_points(keyframe, ids)
    sightings = [
        Sighting(inverse(T_wc), ids, observations(measured(T_wc, points, rng), ids))
        for T_wc in PATH
        if frames_count
    ]
    adjust_everything(world, ReprojectionModel(CAMERA), sightings)
    return float(np.sqrt(((world.positions[ids] - points) ** 2).sum(axis=1).mean()))


def test_frames_between_keyframes_make_the_map_better() -> None:
    """Every point is measured 33 times instead of three: errors fall to a third."""
    for seed in range(3):
        assert off_after_adjustment(seed, True) < 0.5 * off_after_adjustment(seed, False)


def run() -> Tracker:
    """A still room."""
    tracker = Tracker(CAMERA, features=1000)
    for index, T_wc in enumerate(PATH):
        assert tracker.track(*render(room(), T_wc)[:2], index / 30).tracked
    return tracker


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return run()


def remember(seen: ObservedFrames, row: int, tracker: Tracker) -> None:
    """The tracker's latest frame, as one in that row of the log."""
    assert tracker._last is not None
    assert tracker.features is not None
    chosen = seen.chosen(tracker._last.matches, matched=True)
    if chosen is not None:
        seen.append(row, chosen, tracker.features, tracker.map)


def test_memory_is_bounded_and_what_is_kept_lies_evenly(
    tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(final_adjustment, "_MOST", 20)
    seen = ObservedFrames()
    for row in range(1000):
        remember(seen, row, tracker)
        assert len(seen._kept) <= 20
    rows = np.array([kept.row for kept in seen._kept])
    assert len(rows) >= 10
    np.testing.assert_array_equal(np.diff(rows), rows[1] - rows[0])
    assert rows[0] == 0
    assert rows[-1] > 900, "the latest frames are among them"


def test_frames_move_when_they_are_kept_and_stay_with_their_keyframes_when_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The adjustment is a stand-in that moves keyframes by one motion and frames by another."""
    monkeypatch.setattr(final_adjustment, "_MOST", 10)
    tracker = run()
    kept = [frame.row for frame in tracker._seen._kept]
    step, further = (
        np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]),
        np.array([0.0, 0.03, 0.01, 0.0, 0.02, 0.0]),
    )

    def moves(
        world: Map, reprojection: ReprojectionModel, sightings: Sequence[Sighting] = ()
    ) -> NDArray[np.float64]:
        if not sightings:
            world.move(np.stack([k.T_cw for k in world.keyframes]) @ inverse(exp_se3(step)))
        poses = [exp_se3(further) @ sighting.T_cw for sighting in sightings]
        return np.stack(poses) if poses else np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", moves)
    before = tracker._log.poses(tracker.map)
    keyframes = np.isin(tracker._log.stamps, [keyframe.t for keyframe in tracker.map.keyframes])
    tracker.finish()
    wanted = before @ inverse(exp_se3(step))
    rows = [row for row in kept if not keyframes[row]]
    assert 0 < len(rows) < np.count_nonzero(~keyframes)
    wanted[rows] = exp_se3(further) @ wanted[rows]
    np.testing.assert_allclose(tracker._log.poses(tracker.map), wanted, atol=1e-9)


@pytest.mark.parametrize("frames", [2, 1000])
def test_frames_give_all_their_points_between_them(
    tracker: Tracker, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each only half of them; of many, those that are left do so too."""
    monkeypatch.setattr(final_adjustment, "_MOST", 20)
    assert tracker._last is not None
    points, seen = tracker._last.matches.points, ObservedFrames()
    for row in range(frames):
        remember(seen, row, tracker)
    for kept in seen._kept:
        assert 0.4 * len(points) < len(kept.ids) < 0.6 * len(points)
    times = np.bincount(
        np.concatenate([kept.ids for kept in seen._kept]), minlength=tracker.map.size
    )[points]
    np.testing.assert_allclose(times, len(seen._kept) / 2, atol=1)


def test_a_frame_that_saw_little_is_not_kept(tracker: Tracker) -> None:
    fit, seen = tracker._last, ObservedFrames()
    assert fit is not None
    for points, wanted in ((2 * FEW - 1, False), (2 * FEW, True)):
        few = fit.matches.take(np.arange(points))
        assert (seen.chosen(few, matched=True) is not None) == wanted


def test_a_row_that_a_younger_point_has_taken_says_nothing(tracker: Tracker) -> None:
    seen = ObservedFrames()
    remember(seen, 0, tracker)
    ids = seen._kept[0].ids
    taken = ids[:5]
    before = tracker.map.first_keyframe[taken].copy()
    tracker.map.first_keyframe[taken] += 1
    sighting = final_adjustment._sighting(seen._kept[0], np.eye(4), tracker.map)
    tracker.map.first_keyframe[taken] = before
    assert set(sighting.ids.tolist()) == set(ids[5:].tolist())
    assert len(sighting.seen) == len(sighting.ids)


def test_a_map_of_one_keyframe_is_left_alone() -> None:
    rgb, depth, _ = render(room(), PATH[0])
    tracker = Tracker(CAMERA, features=800)
    for index in range(3):
        tracker.track(rgb, depth, index / 30)
    before = tracker.trajectory()[1]
    tracker.finish()
    np.testing.assert_array_equal(tracker.trajectory()[1], before)


def test_without_frames_the_keyframes_are_adjusted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, asked = run(), []

    def counts(
        world: object, reprojection: object, sightings: Sequence[Sighting] = ()
    ) -> NDArray[np.float64]:
        asked.append(len(sightings))
        return np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", counts)
    tracker._seen = ObservedFrames()
    before = tracker.trajectory()[1]
    tracker.finish()
    assert asked == [0]
    np.testing.assert_array_equal(tracker.trajectory()[1], before)
