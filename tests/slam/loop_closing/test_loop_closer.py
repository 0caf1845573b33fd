"""A camera that walks round a hall and comes back, with loops and without."""

import copy

import numpy as np
import pytest
from loop_world import View, poor_view, way_round
from plane_world import CAMERA, slam_config, track

from cohdc_train.slam.config import BundleAdjustmentConfig
from cohdc_train.slam.frame import FrameResult
from cohdc_train.slam.geometry.depth_image import DepthImage, make_depth_image
from cohdc_train.slam.geometry.se3 import exp_se3, inverse
from cohdc_train.slam.loop_closing.verification import LoopConstraint, LoopVerifier
from cohdc_train.slam.mapping.global_bundle_adjustment import adjust_everything
from cohdc_train.slam.mapping.keyframe import Keyframe, observations
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel, chi_square
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 180
TRUTH = way_round(FRAMES)
Run = tuple[Slam, list[FrameResult]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    rng = np.random.default_rng(1)
    return [poor_view(pose, rng) for pose in TRUTH]


def run(views: list[View], loops: bool) -> Run:
    """With corners on whole pixels, or it would not drift; the motion always starts from the latest
    frame's pose.
    """
    slam, poses = (
        Slam(CAMERA, slam_config(200, loops__enabled=loops, refinement__enabled=False)),
        [],
    )
    for index, (rgb, depth) in enumerate(views):
        poses.append(track(slam, rgb, depth, index / 30))
        assert slam.tracker.state.last is not None
        prediction = slam.tracker.parts.motion.predict(index / 30)
        assert prediction is not None
        from_last = prediction.prior.T_cw @ inverse(slam.tracker.state.last.T_cw)
        assert np.linalg.norm(from_last[:3, 3]) < 0.01, index
    return slam, poses


@pytest.fixture(scope="module")
def closed(views: list[View]) -> Run:
    return run(views, loops=True)


@pytest.fixture(scope="module")
def drifting(views: list[View]) -> Run:
    return run(views, loops=False)


def ate(slam: Slam) -> float:
    """RMSE, m."""
    return score(Trajectory(np.arange(FRAMES) / 30, TRUTH), slam.trajectory())["ate_m"]["rmse"]


def test_closing_the_loop_takes_out_the_drift(drifting: Run, closed: Run) -> None:
    assert all(pose.is_tracked for pose in closed[1])
    assert (closed[0].loops, drifting[0].loops) == (1, 0)
    assert ate(drifting[0]) > 0.03
    assert ate(closed[0]) < 0.5 * ate(drifting[0])


def test_the_camera_lands_on_the_closed_map_at_once(drifting: Run, closed: Run) -> None:
    ends = [
        poses[-1].T_wc @ inverse(inverse(TRUTH[0]) @ TRUTH[-1]) for _, poses in (drifting, closed)
    ]
    off = [float(np.linalg.norm(end[:3, 3])) for end in ends]
    assert off[1] < 0.3 * off[0]
    assert min(pose.num_matches for pose in closed[1][-8:]) > 60


def test_both_ends_of_a_loop_share_points(closed: Run) -> None:
    world = closed[0].map
    assert world.shared(world.keyframes[-1].seen_points(), world.keyframes[:6]).max() > 30
    seen = [keyframe.seen_points() for keyframe in world.keyframes]
    assert all(len(ids) == len(np.unique(ids)) for ids in seen), "a keyframe sees a point once"
    counts = np.bincount(np.concatenate(seen), minlength=world.size)
    np.testing.assert_array_equal(world.num_observations[: world.size], counts)


def left_over(world: Map) -> float:
    """Mean of all measurements' squared residuals, in sigmas, each held to be 10 at most."""
    squares = []
    for keyframe in world.keyframes:
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        seen = observations(keyframe.features, keypoints)
        squares.append(
            chi_square(
                keyframe.T_cw,
                world.positions[keyframe.point_ids[keypoints]],
                seen,
                ReprojectionModel(CAMERA),
            )
        )
    return float(np.minimum(np.concatenate(squares), 10.0).mean())


def test_adjusting_everything_brings_displaced_keyframes_back(closed: Run) -> None:
    """By more than half, and to where what is left over is no larger than before, within a
    twentieth.
    """
    world = copy.deepcopy(closed[0].map)
    adjust_everything(world, ReprojectionModel(CAMERA), BundleAdjustmentConfig())
    settled, best = np.stack([keyframe.T_cw for keyframe in world.keyframes]), left_over(world)
    rng = np.random.default_rng(0)
    for keyframe in world.keyframes[1:]:
        keyframe.T_cw = exp_se3(0.002 * rng.standard_normal(6)) @ keyframe.T_cw
    displaced, worst = np.stack([keyframe.T_cw for keyframe in world.keyframes]), left_over(world)
    adjust_everything(world, ReprojectionModel(CAMERA), BundleAdjustmentConfig())
    again = np.stack([keyframe.T_cw for keyframe in world.keyframes])
    np.testing.assert_array_equal(again[0], settled[0])
    assert np.abs(again - settled).mean() < 0.5 * np.abs(displaced - settled).mean()
    assert left_over(world) - best < 0.05 * (worst - best), (best, worst, left_over(world))


def test_the_end_of_a_run_adjusts_everything_unless_told_otherwise(views: list[View]) -> None:
    poses = {}
    for wanted in (True, False):
        slam = Slam(CAMERA, slam_config(250, bundle_adjustment__global_enabled=wanted))
        for index, (rgb, depth) in enumerate(views[:60]):
            track(slam, rgb, depth, index / 30)
        before = slam.trajectory().poses
        slam.finish()
        poses[wanted] = float(np.abs(slam.trajectory().poses - before).max())
    assert poses[False] == 0.0
    assert 0.0 < poses[True] < 0.05


@pytest.mark.slow
def test_same_views_same_bits(views: list[View], closed: Run) -> None:
    again, _ = run(views, loops=True)
    assert again.trajectory().poses.tobytes() == closed[0].trajectory().poses.tobytes()


class TestVerification:
    """The newest keyframe of the drifting run, which has come back to where the first ones were
    taken.
    """

    @pytest.fixture
    def pictures(self, views: list[View], drifting: Run) -> dict[int, DepthImage]:
        return {
            k.index: make_depth_image(*views[frame(k)], None, CAMERA)
            for k in drifting[0].map.keyframes
        }

    def verify(self, slam: Slam, pictures: dict[int, DepthImage]) -> LoopConstraint | None:
        newest = slam.map.keyframes[-1]
        there = np.linalg.norm(TRUTH[:, :3, 3] - TRUTH[frame(newest), :3, 3], axis=1)
        old = min(slam.map.keyframes[:20], key=lambda k: float(there[frame(k)]))
        return LoopVerifier(slam.map, ReprojectionModel(CAMERA), np.random.default_rng(0))(
            newest, old, pictures
        )

    def test_gives_the_true_motion_not_the_drifted_one(
        self, drifting: Run, pictures: dict[int, DepthImage]
    ) -> None:
        slam = drifting[0]
        loop = self.verify(slam, pictures)
        assert loop is not None
        assert loop.new[0] == slam.map.keyframes[-1].index
        assert len(loop.new) >= 3
        for index, T in zip(loop.new, loop.T, strict=True):
            old, new = slam.map.anchor(loop.old)[0], slam.map.anchor(index)[0]
            truth = inverse(TRUTH[frame(new)]) @ TRUTH[frame(old)]
            off = np.linalg.norm((T @ inverse(truth))[:3, 3])
            assert off < 0.02
            assert off < 0.3 * np.linalg.norm(
                (new.T_cw @ inverse(old.T_cw) @ inverse(truth))[:3, 3]
            )

    def test_neighbours_that_contradict_refuse_it(
        self, drifting: Run, pictures: dict[int, DepthImage]
    ) -> None:
        keyframes = drifting[0].map.keyframes[-6:-1]
        before = [keyframe.T_cw for keyframe in keyframes]
        for keyframe in keyframes:
            keyframe.T_cw = exp_se3(np.array([0.1, 0, 0, 0, 0, 0])) @ keyframe.T_cw
        try:
            assert self.verify(drifting[0], pictures) is None
        finally:
            for keyframe, T_cw in zip(keyframes, before, strict=True):
                keyframe.T_cw = T_cw

    def test_pictures_that_contradict_refuse_it(
        self, drifting: Run, pictures: dict[int, DepthImage]
    ) -> None:
        keyframes = drifting[0].map.keyframes
        wrong = pictures | {keyframes[-1].index: pictures[keyframes[len(keyframes) // 2].index]}
        assert self.verify(drifting[0], wrong) is None


def frame(keyframe: Keyframe) -> int:
    """The number of the view that a keyframe is."""
    return round(30 * keyframe.t)
