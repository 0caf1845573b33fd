"""The adjustment at the end, in which frames between keyframes count: what it is worth, and what it
may not do.
"""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, features_at, render, room, slam_config, track

from cohdc_train.slam.config import BundleAdjustmentConfig, MotionModelConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, to_local
from cohdc_train.slam.mapping import global_bundle_adjustment as final_adjustment
from cohdc_train.slam.mapping.global_bundle_adjustment import IntermediateFrames, adjust_everything
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.mapping.local_bundle_adjustment import FrameObservations
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.system import Slam

FRAMES = 30
MIN_POINTS = MotionModelConfig().prior_below_points
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
        FrameObservations(inverse(T_wc), ids, observations(measured(T_wc, points, rng), ids))
        for T_wc in PATH
        if frames_count
    ]
    adjust_everything(world, ReprojectionModel(CAMERA), BundleAdjustmentConfig(), sightings)
    return float(np.sqrt(((world.positions[ids] - points) ** 2).sum(axis=1).mean()))


def test_frames_between_keyframes_make_the_map_better() -> None:
    """Every point is measured 33 times instead of three: errors fall to a third."""
    for seed in range(3):
        assert off_after_adjustment(seed, True) < 0.5 * off_after_adjustment(seed, False)


def observed_frames(max_frames: int = 256) -> IntermediateFrames:
    """A store of so many frames."""
    return IntermediateFrames(BundleAdjustmentConfig(max_frames=max_frames), MIN_POINTS)


def run(**options: object) -> Slam:
    """A still room."""
    slam = Slam(CAMERA, slam_config(1000, **options))
    for index, T_wc in enumerate(PATH):
        assert track(slam, *render(room(), T_wc)[:2], index / 30).is_tracked
    return slam


@pytest.fixture(scope="module")
def slam() -> Slam:
    return run()


def remember(seen: IntermediateFrames, row: int, slam: Slam) -> None:
    """The slam's latest frame, as one in that row of the log."""
    last = slam.tracker.state.last
    assert last is not None
    seen.add(row, last.matches, True, lambda _: last.features, slam.map)


def test_memory_is_bounded_and_what_is_kept_lies_evenly(
    slam: Slam,
) -> None:
    seen = observed_frames(max_frames=20)
    for row in range(1000):
        remember(seen, row, slam)
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
    slam = run(bundle_adjustment__max_frames=10)
    assert slam.tracker.parts.intermediate_frames is not None
    kept = [frame.row for frame in slam.tracker.parts.intermediate_frames._kept]
    step, further = (
        np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]),
        np.array([0.0, 0.03, 0.01, 0.0, 0.02, 0.0]),
    )

    def moves(
        world: Map,
        reprojection: ReprojectionModel,
        config: BundleAdjustmentConfig,
        sightings: Sequence[FrameObservations] = (),
    ) -> NDArray[np.float64]:
        if not sightings:
            world.move(np.stack([k.T_cw for k in world.keyframes]) @ inverse(exp_se3(step)))
        poses = [exp_se3(further) @ sighting.T_cw for sighting in sightings]
        return np.stack(poses) if poses else np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", moves)
    before = slam.tracker.parts.history.poses(slam.map)
    keyframes = np.isin(
        slam.tracker.parts.history.timestamps,
        [keyframe.timestamp for keyframe in slam.map.keyframes],
    )
    slam.finish()
    wanted = before @ inverse(exp_se3(step))
    rows = [row for row in kept if not keyframes[row]]
    assert 0 < len(rows) < np.count_nonzero(~keyframes)
    wanted[rows] = exp_se3(further) @ wanted[rows]
    np.testing.assert_allclose(slam.tracker.parts.history.poses(slam.map), wanted, atol=1e-9)


@pytest.mark.parametrize("frames", [2, 1000])
def test_frames_give_all_their_points_between_them(slam: Slam, frames: int) -> None:
    """Each only half of them; of many, those that are left do so too."""
    assert slam.tracker.state.last is not None
    points, seen = slam.tracker.state.last.matches.point_ids, observed_frames(max_frames=20)
    for row in range(frames):
        remember(seen, row, slam)
    for kept in seen._kept:
        assert 0.4 * len(points) < len(kept.ids) < 0.6 * len(points)
    times = np.bincount(np.concatenate([kept.ids for kept in seen._kept]), minlength=slam.map.size)[
        points
    ]
    np.testing.assert_allclose(times, len(seen._kept) / 2, atol=1)


def test_a_frame_that_saw_little_is_not_kept(slam: Slam) -> None:
    last = slam.tracker.state.last
    assert last is not None
    for points, wanted in ((2 * MIN_POINTS - 1, False), (2 * MIN_POINTS, True)):
        seen = observed_frames()
        few = last.matches.take(np.arange(points))
        seen.add(0, few, True, lambda _: last.features, slam.map)
        assert bool(seen._kept) == wanted


def test_a_row_that_a_younger_point_has_taken_says_nothing(slam: Slam) -> None:
    seen = observed_frames()
    remember(seen, 0, slam)
    ids = seen._kept[0].ids
    taken = ids[:5]
    before = slam.map.first_keyframe[taken].copy()
    slam.map.first_keyframe[taken] += 1
    sighting = final_adjustment._frame_observations(seen._kept[0], np.eye(4), slam.map)
    slam.map.first_keyframe[taken] = before
    assert set(sighting.ids.tolist()) == set(ids[5:].tolist())
    assert len(sighting.seen) == len(sighting.ids)


def test_a_map_of_one_keyframe_is_left_alone() -> None:
    rgb, depth, _ = render(room(), PATH[0])
    slam = Slam(CAMERA, slam_config(800))
    for index in range(3):
        track(slam, rgb, depth, index / 30)
    before = slam.trajectory().poses
    slam.finish()
    np.testing.assert_array_equal(slam.trajectory().poses, before)


def test_without_frames_the_keyframes_are_adjusted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, asked = run(), []

    def counts(
        world: object,
        reprojection: object,
        config: object,
        sightings: Sequence[FrameObservations] = (),
    ) -> NDArray[np.float64]:
        asked.append(len(sightings))
        return np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", counts)
    slam._intermediate_frames = observed_frames()
    before = slam.trajectory().poses
    slam.finish()
    assert asked == [0]
    np.testing.assert_array_equal(slam.trajectory().poses, before)
