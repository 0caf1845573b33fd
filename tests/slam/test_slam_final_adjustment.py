"""The adjustment at the end, in which frames between keyframes count: what it is worth, and what it may not do."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, render, room

from cohdc_train.slam import final_adjustment
from cohdc_train.slam.final_adjustment import SeenFrames, _nearest
from cohdc_train.slam.method import Method
from cohdc_train.slam.optimization import Prior, exp_se3, inverse
from cohdc_train.slam.tracking import Tracker
from cohdc_train.trajectory import Trajectory, score

FRAMES = 30
PATH = camera_path(FRAMES)


def run(every_frame: bool, noise: float = 0.0, seed: int = 0) -> Tracker:
    """A still room; noise: m, of depth."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(CAMERA, features=800, method=Method(every_frame=every_frame, smoothing=False))
    for index, T_wc in enumerate(PATH):
        rgb, depth, _ = render(room(), T_wc)
        noisy = np.where(depth > 0, depth + rng.normal(0, noise, depth.shape), 0).astype(np.float32)
        assert tracker.track(rgb, noisy, index / 30).tracked
    return tracker


def ate(tracker: Tracker) -> float:
    """RMSE, m."""
    return score(Trajectory(np.arange(FRAMES) / 30, PATH), Trajectory(*tracker.trajectory()))["ate_m"]["rmse"]


def test_frames_between_keyframes_make_the_map_better() -> None:
    """Depth that errs by 2 cm: a point is seen by some ten times more frames than keyframes."""
    errors: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(3):
        for every_frame, of_it in errors.items():
            tracker = run(every_frame, 0.02, seed)
            tracker.finish()
            of_it.append(ate(tracker))
    assert np.mean(errors[True]) < 0.9 * np.mean(errors[False])


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return run(True)


def remember(seen: SeenFrames, t: float, tracker: Tracker) -> None:
    """The tracker's latest frame, as one at t."""
    fit = tracker._last
    assert fit is not None
    assert fit.reference is not None
    assert tracker.features is not None
    seen.append(t, fit, fit.reference, tracker.features, tracker.map)


def test_memory_is_bounded_and_what_is_kept_lies_evenly(tracker: Tracker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(final_adjustment, "_MOST", 20)
    seen = SeenFrames()
    for number in range(1000):
        remember(seen, number / 30, tracker)
        assert len(seen._kept) <= 20
    stamps = np.array([kept.t for kept in seen._kept])
    assert len(stamps) >= 10
    np.testing.assert_allclose(np.diff(stamps), stamps[1] - stamps[0], atol=1e-9)
    assert stamps[0] == 0
    assert stamps[-1] > 30, "the latest frames are among them"


def test_frames_that_are_not_adjusted_go_with_the_nearest_that_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adjustment is a stand-in that moves everything by one motion: so must every frame move."""
    tracker, step = run(True), exp_se3(np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]))

    def moves(
        world: object, weighing: object, sightings: Sequence[final_adjustment.Sighting] = ()
    ) -> NDArray[np.float64]:
        if not sightings:
            return np.zeros((0, 4, 4))
        tracker.map.move(np.stack([k.T_cw for k in tracker.map.keyframes]) @ inverse(step))
        return np.stack([sighting.T_cw for sighting in sightings]) @ inverse(step)

    monkeypatch.setattr(final_adjustment, "adjust_everything", moves)
    before = tracker.trajectory()[1]
    tracker.finish()
    np.testing.assert_allclose(tracker.trajectory()[1], step @ before, atol=1e-9)


@pytest.mark.parametrize("frames", [2, 1000])
def test_frames_give_all_their_points_between_them(
    tracker: Tracker, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each only half of them; of many, those that are left do so too."""
    monkeypatch.setattr(final_adjustment, "_MOST", 20)
    assert tracker._last is not None
    points, seen = tracker._last.matches.points, SeenFrames()
    for number in range(frames):
        remember(seen, number / 30, tracker)
    for kept in seen._kept:
        assert 0.4 * len(points) < len(kept.ids) < 0.6 * len(points)
    times = np.bincount(np.concatenate([kept.ids for kept in seen._kept]), minlength=tracker.map.size)[points]
    np.testing.assert_allclose(times, len(seen._kept) / 2, atol=1)


def test_a_frame_that_was_placed_by_what_was_expected_is_not_kept(tracker: Tracker) -> None:
    assert tracker._last is not None
    assert tracker._last.reference is not None
    assert tracker.features is not None
    seen, fit = SeenFrames(), replace(tracker._last, prior=Prior(np.eye(4), np.eye(6)))
    seen.append(0.0, fit, tracker._last.reference, tracker.features, tracker.map)
    assert seen._kept == []


def test_a_row_that_a_younger_point_has_taken_says_nothing(tracker: Tracker) -> None:
    seen = SeenFrames()
    remember(seen, 0.0, tracker)
    ids = seen._kept[0].ids
    taken = ids[:5]
    before = tracker.map.born[taken].copy()
    tracker.map.born[taken] += 1
    sighting = final_adjustment._sighting(seen._kept[0], tracker.map)
    tracker.map.born[taken] = before
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


def test_nearest_by_hand() -> None:
    others = np.array([5.0, 1.0, 3.0])
    np.testing.assert_array_equal(_nearest(np.array([0.0, 1.9, 2.1, 3.9, 4.1, 9.0]), others), [1, 1, 2, 2, 0, 0])
