"""Loop closing of a camera that walks around a hall and comes back."""

import copy

import numpy as np
import pytest
from loop_world import View, poor_view, way_round
from plane_world import CAMERA

from cohdc_train.slam.config import BundleAdjustmentConfig, SlamConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.depth_image import DepthImage, make_depth_image
from cohdc_train.slam.geometry.se3 import exp_se3, inverse
from cohdc_train.slam.loop_closing.verification import (
    LoopConstraint,
    LoopVerifier,
    LoopVerifierConfig,
)
from cohdc_train.slam.mapping.global_bundle_adjustment import adjust_everything
from cohdc_train.slam.mapping.keyframe import Keyframe, observations_at
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel, chi_square
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 180
TRUTH = way_round(FRAMES)
REPROJECTION = ReprojectionModel(CAMERA)
Run = tuple[Slam, list[FrameResult]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Render the hall with a poor sensor."""
    rng = np.random.default_rng(1)
    return [poor_view(pose, rng) for pose in TRUTH]


def run(views: list[View], loops: bool) -> Run:
    """Track without patch refinement, so that the pose drifts.

    The predicted motion must always start from the pose of the latest frame, also after a loop.
    """
    options = {
        "features.max_keypoints": 200,
        "refinement.enabled": False,
        "loops.enabled": loops,
    }
    slam, results = Slam(CAMERA, SlamConfig().override(options)), []
    for index, (rgb, depth) in enumerate(views):
        results.append(slam.track(RGBDFrame(index / 30, rgb, depth)))
        last = slam.tracker.state.last
        prediction = slam.tracker.parts.motion.predict(index / 30)
        assert last is not None
        assert prediction is not None
        from_last = prediction.prior.T_cw @ inverse(last.T_cw)
        assert np.linalg.norm(from_last[:3, 3]) < 0.01, index
    return slam, results


@pytest.fixture(scope="module")
def closed(views: list[View]) -> Run:
    """Track with loop closing."""
    return run(views, loops=True)


@pytest.fixture(scope="module")
def drifting(views: list[View]) -> Run:
    """Track without loop closing."""
    return run(views, loops=False)


def ate(slam: Slam) -> float:
    """Return the RMSE of the absolute trajectory error, m."""
    truth = Trajectory(np.arange(FRAMES) / 30, TRUTH)
    rmse: float = score(truth, slam.trajectory())["ate_m"]["rmse"]
    return rmse


def test_closing_the_loop_removes_the_drift(drifting: Run, closed: Run) -> None:
    assert all(result.is_tracked for result in closed[1])
    assert (closed[0].num_loops, drifting[0].num_loops) == (1, 0)
    assert ate(drifting[0]) > 0.03
    assert ate(closed[0]) < 0.5 * ate(drifting[0])


def test_tracking_continues_on_the_corrected_map(drifting: Run, closed: Run) -> None:
    true_end = inverse(TRUTH[0]) @ TRUTH[-1]
    errors = []
    for _, results in (drifting, closed):
        error = results[-1].T_wc @ inverse(true_end)
        errors.append(float(np.linalg.norm(error[:3, 3])))
    assert errors[1] < 0.3 * errors[0]
    assert min(result.num_matches for result in closed[1][-8:]) > 60


def test_both_sides_of_a_loop_share_points(closed: Run) -> None:
    point_map = closed[0].map
    newest = point_map.keyframes[-1]
    assert point_map.shared(newest.observed_point_ids(), point_map.keyframes[:6]).max() > 30
    observed = [keyframe.observed_point_ids() for keyframe in point_map.keyframes]
    assert all(len(ids) == len(np.unique(ids)) for ids in observed), "each point once per keyframe"
    counts = np.bincount(np.concatenate(observed), minlength=point_map.size)
    np.testing.assert_array_equal(point_map.num_observations[: point_map.size], counts)


def mean_error(point_map: Map) -> float:
    """Return the mean squared residual of all measurements, in sigmas, each clipped at 10."""
    squares = []
    for keyframe in point_map.keyframes:
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        observed = observations_at(keyframe.features, keypoints)
        points = point_map.positions[keyframe.point_ids[keypoints]]
        squares.append(chi_square(keyframe.T_cw, points, observed, REPROJECTION))
    return float(np.minimum(np.concatenate(squares), 10.0).mean())


def poses(point_map: Map) -> np.ndarray:
    """Return the poses of all keyframes [k, 4, 4]."""
    return np.stack([keyframe.T_cw for keyframe in point_map.keyframes])


def test_global_bundle_adjustment_corrects_displaced_keyframes(closed: Run) -> None:
    """The displacement shrinks by half, and the error comes back to within a twentieth."""
    point_map, config = copy.deepcopy(closed[0].map), BundleAdjustmentConfig()
    adjust_everything(point_map, REPROJECTION, config)
    settled, best = poses(point_map), mean_error(point_map)

    rng = np.random.default_rng(0)
    for keyframe in point_map.keyframes[1:]:
        keyframe.T_cw = exp_se3(0.002 * rng.standard_normal(6)) @ keyframe.T_cw
    displaced, worst = poses(point_map), mean_error(point_map)

    adjust_everything(point_map, REPROJECTION, config)
    adjusted, error = poses(point_map), mean_error(point_map)
    np.testing.assert_array_equal(adjusted[0], settled[0])
    assert np.abs(adjusted - settled).mean() < 0.5 * np.abs(displaced - settled).mean()
    assert error - best < 0.05 * (worst - best), (best, worst, error)


@pytest.mark.parametrize("is_enabled", [True, False])
def test_finish_adjusts_all_keyframes_unless_disabled(views: list[View], is_enabled: bool) -> None:
    options = {"features.max_keypoints": 250, "bundle_adjustment.global_enabled": is_enabled}
    slam = Slam(CAMERA, SlamConfig().override(options))
    for index, (rgb, depth) in enumerate(views[:60]):
        slam.track(RGBDFrame(index / 30, rgb, depth))
    before = slam.trajectory().poses
    change = float(np.abs(slam.finish().poses - before).max())
    assert (0.0 < change < 0.05) if is_enabled else change == 0.0


@pytest.mark.slow
def test_same_frames_give_the_same_bits(views: list[View], closed: Run) -> None:
    again, _ = run(views, loops=True)
    assert again.trajectory().poses.tobytes() == closed[0].trajectory().poses.tobytes()


class TestVerification:
    """Verification of the newest keyframe of the drifting run, which has come back to the start."""

    @pytest.fixture
    def images(self, views: list[View], drifting: Run) -> dict[int, DepthImage]:
        """Make the images of all keyframes."""
        return {
            keyframe.index: make_depth_image(*views[frame_number(keyframe)], None, CAMERA)
            for keyframe in drifting[0].map.keyframes
        }

    def verify(self, slam: Slam, images: dict[int, DepthImage]) -> LoopConstraint | None:
        """Verify a loop of the newest keyframe with the nearest of the first ones."""
        newest = slam.map.keyframes[-1]
        offset = TRUTH[:, :3, 3] - TRUTH[frame_number(newest), :3, 3]
        distance = np.linalg.norm(offset, axis=1)
        old = min(slam.map.keyframes[:20], key=lambda k: float(distance[frame_number(k)]))
        rng = np.random.default_rng(0)
        verifier = LoopVerifier(slam.map, REPROJECTION, LoopVerifierConfig(), rng)
        return verifier.verify(newest, old, images)

    def test_loop_has_the_true_motion_rather_than_the_drifted_one(
        self, drifting: Run, images: dict[int, DepthImage]
    ) -> None:
        slam = drifting[0]
        loop = self.verify(slam, images)
        assert loop is not None
        assert loop.new[0] == slam.map.keyframes[-1].index
        assert len(loop.new) >= 3
        for index, T in zip(loop.new, loop.T, strict=True):
            old, new = slam.map.anchor(loop.old)[0], slam.map.anchor(index)[0]
            truth = inverse(TRUTH[frame_number(new)]) @ TRUTH[frame_number(old)]
            drifted = new.T_cw @ inverse(old.T_cw)
            error = np.linalg.norm((T @ inverse(truth))[:3, 3])
            assert error < 0.02
            assert error < 0.3 * np.linalg.norm((drifted @ inverse(truth))[:3, 3])

    def test_contradicting_neighbors_reject_a_loop(
        self, drifting: Run, images: dict[int, DepthImage]
    ) -> None:
        keyframes = drifting[0].map.keyframes[-6:-1]
        before = [keyframe.T_cw for keyframe in keyframes]
        for keyframe in keyframes:
            keyframe.T_cw = exp_se3(np.array([0.1, 0, 0, 0, 0, 0])) @ keyframe.T_cw
        try:
            assert self.verify(drifting[0], images) is None
        finally:
            for keyframe, T_cw in zip(keyframes, before, strict=True):
                keyframe.T_cw = T_cw

    def test_contradicting_images_reject_a_loop(
        self, drifting: Run, images: dict[int, DepthImage]
    ) -> None:
        keyframes = drifting[0].map.keyframes
        other = keyframes[len(keyframes) // 2]
        wrong = images | {keyframes[-1].index: images[other.index]}
        assert self.verify(drifting[0], wrong) is None


def frame_number(keyframe: Keyframe) -> int:
    """Return the number of the frame that a keyframe was made of."""
    return round(30 * keyframe.timestamp)
