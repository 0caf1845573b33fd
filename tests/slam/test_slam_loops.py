"""A camera that walks round a hall and comes back, with loops and without."""

import numpy as np
import pytest
from loop_world import View, poor_view, way_round
from plane_world import CAMERA

from cohdc_train.slam.method import Method
from cohdc_train.slam.optimization import inverse
from cohdc_train.slam.tracking import Pose, Tracker
from cohdc_train.trajectory import Trajectory, score

FRAMES = 180


@pytest.fixture(scope="module")
def views() -> list[View]:
    rng = np.random.default_rng(0)
    return [poor_view(pose, rng) for pose in way_round(FRAMES)]


def run(views: list[View], loops: bool) -> tuple[Tracker, list[Pose]]:
    tracker = Tracker(CAMERA, features=250, method=Method(loops=loops))
    return tracker, [tracker.track(rgb, depth, index / 30) for index, (rgb, depth) in enumerate(views)]


@pytest.fixture(scope="module")
def closed(views: list[View]) -> tuple[Tracker, list[Pose]]:
    return run(views, loops=True)


def ate(tracker: Tracker) -> float:
    """RMSE, m."""
    truth = Trajectory(np.arange(FRAMES) / 30, way_round(FRAMES))
    return score(truth, Trajectory(*tracker.trajectory()))["ate_m"]["rmse"]


def test_closing_the_loop_takes_out_the_drift(views: list[View], closed: tuple[Tracker, list[Pose]]) -> None:
    tracker, poses = closed
    drifting, _ = run(views, loops=False)
    assert all(pose.tracked for pose in poses)
    assert (tracker.loops, drifting.loops) == (1, 0)
    assert ate(drifting) > 0.03
    assert ate(tracker) < 0.5 * ate(drifting)


def test_the_camera_lands_on_the_closed_map_at_once(closed: tuple[Tracker, list[Pose]]) -> None:
    _, poses = closed
    truth = way_round(FRAMES)
    last = poses[-1].T_wc
    assert last is not None
    off = last @ inverse(inverse(truth[0]) @ truth[-1])
    assert np.linalg.norm(off[:3, 3]) < 0.03
    assert min(pose.inliers for pose in poses[-8:]) > 60


def test_both_ends_of_a_loop_share_points(closed: tuple[Tracker, list[Pose]]) -> None:
    world = closed[0].map
    shared = world.shared(world.keyframes[-1].seen_points())
    assert shared[:6].max() > 30
    for keyframe in world.keyframes:
        seen = keyframe.seen_points()
        assert len(seen) == len(np.unique(seen)), "a keyframe sees a point once"
    counts = np.bincount(np.concatenate([k.seen_points() for k in world.keyframes]), minlength=world.size)
    np.testing.assert_array_equal(world.seen_by[: world.size], counts)


def test_same_views_same_bits(views: list[View], closed: tuple[Tracker, list[Pose]]) -> None:
    again, _ = run(views, loops=True)
    assert again.trajectory()[1].tobytes() == closed[0].trajectory()[1].tobytes()
