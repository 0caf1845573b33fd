"""Global bundle adjustment with frames between keyframes: accuracy, memory, and side effects."""

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
from cohdc_train.slam.mapping.keyframe import Keyframe, observations_at
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
    """Measure points [n, 3] m with a noise of one pixel and 2 % of the depth."""
    local = to_local(inverse(T_wc), points)
    pixels = CAMERA.project(local) + rng.standard_normal((len(points), 2))
    depths = local[:, 2] * (1 + 0.02 * rng.standard_normal(len(points)))
    return features_at(pixels, depths)


def point_error_after_adjustment(seed: int, frames_count: bool) -> float:
    """Return the RMSE, m, of map points that three keyframes and up to 30 frames observe."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1.0, -0.7, 1.5), (1.0, 0.7, 3.0), (200, 3))
    world, image, ids = Map(CAMERA), np.zeros((2, 2), dtype=np.float32), np.arange(200)
    for index in range(3):
        T_wc = PATH[10 * index]
        free = np.full(200, -1) if index == 0 else ids
        keyframe = Keyframe(
            index,
            index / 3,
            inverse(T_wc),
            measured(T_wc, points, rng),
            free.copy(),
            image,
            image,
        )
        world.add_keyframe(keyframe)
        if index == 0:
            world.add_points(keyframe, ids)
    observed = [
        FrameObservations(inverse(T_wc), ids, observations_at(measured(T_wc, points, rng), ids))
        for T_wc in PATH
        if frames_count
    ]
    adjust_everything(world, ReprojectionModel(CAMERA), BundleAdjustmentConfig(), observed)
    return float(np.sqrt(((world.positions[ids] - points) ** 2).sum(axis=1).mean()))


def test_frames_between_keyframes_improve_the_map() -> None:
    """Every point is measured 33 times instead of three: errors fall to a third."""
    for seed in range(3):
        assert point_error_after_adjustment(seed, True) < 0.5 * point_error_after_adjustment(
            seed, False
        )


def observed_frames(max_frames: int = 256) -> IntermediateFrames:
    """Return an empty store with a limit on the number of frames."""
    return IntermediateFrames(BundleAdjustmentConfig(max_frames=max_frames), MIN_POINTS)


def run(**options: object) -> Slam:
    """Track the frames of a static room."""
    slam = Slam(CAMERA, slam_config(1000, **options))
    for index, T_wc in enumerate(PATH):
        assert track(slam, *render(room(), T_wc)[:2], index / 30).is_tracked
    return slam


@pytest.fixture(scope="module")
def slam() -> Slam:
    return run()


def add_latest_frame(frames_between: IntermediateFrames, row: int, slam: Slam) -> None:
    """Add the latest frame of a SLAM system, as the given row of the history."""
    last = slam.tracker.state.last
    assert last is not None
    frames_between.add(row, last.matches, True, lambda _: last.features, slam.map)


def test_number_of_kept_frames_is_bounded_and_evenly_spaced(
    slam: Slam,
) -> None:
    frames_between = observed_frames(max_frames=20)
    for row in range(1000):
        add_latest_frame(frames_between, row, slam)
        assert len(frames_between._kept) <= 20
    rows = np.array([kept.row for kept in frames_between._kept])
    assert len(rows) >= 10
    np.testing.assert_array_equal(np.diff(rows), rows[1] - rows[0])
    assert rows[0] == 0
    assert rows[-1] > 900, "the latest frames are among them"


def test_kept_frames_are_adjusted_and_others_move_with_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stub moves keyframes by one motion and other frames by another."""
    slam = run(bundle_adjustment__max_frames=10)
    assert slam.tracker.parts.intermediate_frames is not None
    kept = [frame.row for frame in slam.tracker.parts.intermediate_frames._kept]
    step, further = (
        np.array([0.02, 0.01, 0.0, 0.01, 0.0, 0.02]),
        np.array([0.0, 0.03, 0.01, 0.0, 0.02, 0.0]),
    )

    def move_all(
        world: Map,
        reprojection: ReprojectionModel,
        config: BundleAdjustmentConfig,
        observed: Sequence[FrameObservations] = (),
    ) -> NDArray[np.float64]:
        if not observed:
            world.move(np.stack([k.T_cw for k in world.keyframes]) @ inverse(exp_se3(step)))
        poses = [exp_se3(further) @ frame.T_cw for frame in observed]
        return np.stack(poses) if poses else np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", move_all)
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
def test_kept_frames_cover_all_points_in_turn(slam: Slam, frames: int) -> None:
    """Each frame keeps half of its points, also after older frames were dropped."""
    assert slam.tracker.state.last is not None
    points, frames_between = (
        slam.tracker.state.last.matches.point_ids,
        observed_frames(max_frames=20),
    )
    for row in range(frames):
        add_latest_frame(frames_between, row, slam)
    for kept in frames_between._kept:
        assert 0.4 * len(points) < len(kept.ids) < 0.6 * len(points)
    times = np.bincount(
        np.concatenate([kept.ids for kept in frames_between._kept]), minlength=slam.map.size
    )[points]
    np.testing.assert_allclose(times, len(frames_between._kept) / 2, atol=1)


def test_frame_with_few_matches_is_not_kept(slam: Slam) -> None:
    last = slam.tracker.state.last
    assert last is not None
    for points, wanted in ((2 * MIN_POINTS - 1, False), (2 * MIN_POINTS, True)):
        frames_between = observed_frames()
        few = last.matches.take(np.arange(points))
        frames_between.add(0, few, True, lambda _: last.features, slam.map)
        assert bool(frames_between._kept) == wanted


def test_observations_of_reused_rows_are_dropped(slam: Slam) -> None:
    frames_between = observed_frames()
    add_latest_frame(frames_between, 0, slam)
    ids = frames_between._kept[0].ids
    reused = ids[:5]
    before = slam.map.first_keyframe[reused].copy()
    slam.map.first_keyframe[reused] += 1
    observed = final_adjustment._frame_observations(frames_between._kept[0], np.eye(4), slam.map)
    slam.map.first_keyframe[reused] = before
    assert set(observed.ids.tolist()) == set(ids[5:].tolist())
    assert len(observed.observations) == len(observed.ids)


def test_map_of_one_keyframe_is_not_adjusted() -> None:
    rgb, depth, _ = render(room(), PATH[0])
    slam = Slam(CAMERA, slam_config(800))
    for index in range(3):
        track(slam, rgb, depth, index / 30)
    before = slam.trajectory().poses
    slam.finish()
    np.testing.assert_array_equal(slam.trajectory().poses, before)


def test_keyframes_are_adjusted_once_without_other_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, numbers_of_frames = run(), []

    def count_calls(
        world: object,
        reprojection: object,
        config: object,
        observed: Sequence[FrameObservations] = (),
    ) -> NDArray[np.float64]:
        numbers_of_frames.append(len(observed))
        return np.zeros((0, 4, 4))

    monkeypatch.setattr(final_adjustment, "adjust_everything", count_calls)
    slam._intermediate_frames = observed_frames()
    before = slam.trajectory().poses
    slam.finish()
    assert numbers_of_frames == [0]
    np.testing.assert_array_equal(slam.trajectory().poses, before)
