"""Frames that optical flow tracks between two that are matched against the map."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, passer_by, render, room, slam_config, track

from cohdc_train.slam.config import FlowConfig
from cohdc_train.slam.features.keypoints import Keypoints
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.frame import FrameResult
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.optimization.reprojection import Prior, ReprojectionModel
from cohdc_train.slam.runtime.executors import SynchronousExecutor
from cohdc_train.slam.system import Slam
from cohdc_train.slam.tracking.flow_tracker import FlowState, FlowTracker, FlowTracks
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.pose_estimate import FrameFeatures
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 31
STILL = Prediction(Prior(np.eye(4), np.zeros((6, 6))), False, 150)
View = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """A still room along a path."""
    return [render(room(), T_wc) for T_wc in camera_path(FRAMES)]


class Watched:
    """A slam in real time that says which frames were searched for corners."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, flow: bool = True, **options: object
    ) -> None:
        config = slam_config(
            500,
            flow__enabled=flow,
            bundle_adjustment__global_enabled=False,
            smoothing__enabled=False,
            **options,
        )
        self.spent = 0.0
        self.slam = Slam(
            CAMERA,
            config,
            executor=SynchronousExecutor(),
            frame_time_used=lambda: self.spent,
        )
        self.searched: list[int] = []
        self.poses: list[FrameResult] = []
        find = self.slam.tracker.parts.extractor.find

        def noted(*arguments: Any) -> Keypoints:
            self.searched.append(len(self.poses))
            return find(*arguments)

        monkeypatch.setattr(self.slam.tracker.parts.extractor, "find", noted)

    def track(self, view: View, mask: NDArray[np.bool_] | None = None) -> FrameResult:
        self.poses.append(track(self.slam, view[0], view[1], len(self.poses) / 30, mask))
        return self.poses[-1]

    def ate(self) -> float:
        """RMSE, m."""
        truth = Trajectory(np.arange(FRAMES) / 30, camera_path(FRAMES))
        return score(truth, self.slam.trajectory())["ate_m"]["rmse"]


def test_two_of_three_frames_need_no_corners_and_are_as_exact(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, matched = Watched(monkeypatch), Watched(monkeypatch, flow=False)
    for view in views:
        flow.track(view)
        matched.track(view)
        features = flow.poses[-1].features
        assert features is not None
        assert len(flow.poses) < 3 or features.is_subpixel.mean() > 0.3, (
            "what a patch told is carried along"
        )
    assert matched.searched == list(range(FRAMES))
    assert flow.searched == list(range(0, FRAMES, 3))
    assert all(pose.is_tracked for pose in flow.poses)
    assert not any(pose.is_keyframe for index, pose in enumerate(flow.poses) if index % 3)
    assert sum(pose.is_keyframe for pose in flow.poses) <= sum(
        pose.is_keyframe for pose in matched.poses
    )
    assert flow.ate() < 0.004
    assert flow.ate() < 1.25 * matched.ate()


def test_the_answer_by_flow_comes_before_the_frame_is_matched(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(monkeypatch)
    slam, told = run.slam, list[FrameResult]()
    for index, view in enumerate(views[:13]):
        searched = len(run.searched)

        def tell(pose: FrameResult, index: int = index, searched: int = searched) -> None:
            told.append(pose)
            assert index == 0 or len(run.searched) == searched, "nothing has been searched yet"

        final = track(slam, view[0], view[1], index / 30, on_pose=tell)
        assert len(told) == index + 1
        assert told[-1].T_wc is not None
        assert final.T_wc is not None
        np.testing.assert_allclose(told[-1].T_wc, final.T_wc, atol=0.003)
        assert told[-1].timing.tracking_ms == final.timing.tracking_ms
    assert len(run.searched) == 5


def test_in_a_hurry_matching_and_mapping_wait_but_not_for_ever(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(monkeypatch, keyframes__max_interval_frames=1)
    work, worked = run.slam.tracker.parts.mapper.run_next_task, list[int]()

    def noted() -> None:
        worked.append(len(run.poses))
        work()

    monkeypatch.setattr(run.slam.tracker.parts.mapper, "run_next_task", noted)
    run.track(views[0])
    run.spent = 0.8
    for view in views[1:14]:
        assert run.track(view).is_tracked
    assert run.searched == [0, 6, 12]
    assert worked == [6, 12], (
        "in place of a keyframe, which waits until all is done for the one before"
    )
    assert [pose.is_keyframe for pose in run.poses] == [True] + [False] * 13
    run.spent = 0.0
    for view in views[14:20]:
        run.track(view)
    assert run.searched == [0, 6, 12, 15, 18]
    assert worked == [6, 12, 14, 16, 17, 19]
    assert [index for index, pose in enumerate(run.poses) if pose.is_keyframe] == [0, 15, 18]
    run.spent = 0.6
    for view in views[20:22]:
        run.track(view)
    assert worked[-2:] == [20, 21], "there is time for a part yet"
    assert run.searched[-1] == 18, "but for no search"


def test_a_keyframes_upkeep_is_done_in_parts_while_flow_tracks(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(monkeypatch)
    left, keyframes = [], []
    for view in views:
        keyframes.append(run.track(view).is_keyframe)
        left.append(len(run.slam.tracker.parts.mapper._tasks))
    newest = [index for index in np.flatnonzero(keyframes).tolist() if index < len(views) - 2]
    assert len(newest) >= 2
    for index in newest:
        assert left[index : index + 3] == [2, 1, 0]
    run.slam.finish()
    assert not run.slam.tracker.parts.mapper._tasks


def test_what_flow_follows_are_the_points_that_those_it_set_out_with_have_become(
    views: list[View],
) -> None:
    flow, slam, state = begun(views[0])
    first, state = flow.track_points(views[0][0], None, state, np.eye(4))
    is_subpixel = first.point_ids[first.keypoints.is_subpixel]
    old, new = is_subpixel[:1], is_subpixel[1:2]
    slam.map.merged_into[old] = new
    again, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    assert old not in again.point_ids
    assert np.count_nonzero(again.point_ids == new) == 1, "no point is tracked twice"
    slam.map.merged_into[old] = -1


def test_of_many_points_a_frame_follows_every_second_and_the_next_the_others(
    views: list[View],
) -> None:
    flow, slam, state = begun(views[0])
    every, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    turns = FlowTracker(
        slam.map,
        ReprojectionModel(CAMERA),
        slam.tracker.parts.measurer,
        FlowConfig(subsample_above=len(state.point_ids)),
    )
    some, state = turns.track_points(views[0][0], None, state, np.eye(4))
    others, _ = turns.track_points(views[0][0], None, state, np.eye(4))
    ids = np.r_[some.point_ids, others.point_ids]
    np.testing.assert_array_equal(np.sort(ids), every.point_ids)
    assert 0.8 < len(some.point_ids) / len(others.point_ids) < 1.25


def test_the_same_frames_give_the_same_bits(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    ways = []
    for _ in range(2):
        run = Watched(monkeypatch)
        for view in views[:12]:
            run.track(view)
        ways.append(run.slam.trajectory().poses.tobytes())
    assert ways[0] == ways[1]


def test_flow_belongs_to_real_time() -> None:
    recorded = Slam(CAMERA, slam_config(500))
    live = Slam(CAMERA, slam_config(500), executor=SynchronousExecutor())
    assert recorded.tracker.parts.flow is None
    assert live.tracker.parts.flow is not None


def test_where_flow_finds_too_little_the_frame_is_matched(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leap of ten frames lies beyond what flow can reach, but not beyond the map's."""
    run = Watched(monkeypatch)
    for view in views[:4]:
        run.track(view)
    motion = run.slam.tracker.parts.motion
    assert motion._state is not None
    motion._state.velocity[:] = 0
    assert run.track(views[20]).is_tracked
    assert 4 in run.searched
    found = run.poses[-1].T_wc
    assert found is not None
    relative = np.linalg.inv(camera_path(FRAMES)[0]) @ camera_path(FRAMES)[20]
    np.testing.assert_allclose(found[:3, 3], relative[:3, 3], atol=0.01)


def test_a_lost_place_is_followed_by_no_flow(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(monkeypatch)
    nothing = np.zeros_like(views[0][0]), np.zeros_like(views[0][1]), views[0][2]
    states = [
        run.track(nothing if index in (4, 5) else view).is_tracked
        for index, view in enumerate(views[:9])
    ]
    assert states == [True] * 4 + [False] * 2 + [True] * 3
    assert run.searched[:5] == [0, 3, 4, 5, 6]


def test_nothing_is_followed_under_a_mask_and_a_passer_by_does_not_drag_the_pose(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """He is masked when frames are matched, but walks over points that flow follows."""
    run, path = Watched(monkeypatch), camera_path(FRAMES)
    under_mask = 0
    for index in range(FRAMES):
        view = render([*room(), passer_by(index)], path[index])
        masked = index % 3 != 1
        run.track(view, view[2] if masked else None)
        features = run.poses[-1].features
        assert features is not None
        x, y = np.rint(features.pixels).astype(int).T
        under_mask += np.count_nonzero(view[2][y, x]) if masked else 0
    assert run.searched == list(range(0, FRAMES, 3))
    assert under_mask == 0
    assert run.ate() < 0.005


def test_flow_sets_out_from_where_the_motion_leads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall moves by 20 px from frame to frame, and by 40 until the next matched one."""
    path = exp_se3(np.outer(np.arange(10) - 5, [0.18, 0.0, 0.01, 0.0, 0.01, 0.0]))
    run = Watched(monkeypatch)
    assert all(run.track(render(room(), T_wc)).is_tracked for T_wc in path)
    assert run.searched == [0, 1, 4, 7], "the first motion is known to nobody"


def begun(view: View) -> tuple[FlowTracker, Slam, FlowState]:
    """A flow that starts from the first frame of a map."""
    slam = Slam(CAMERA, slam_config(500), executor=SynchronousExecutor())
    track(slam, view[0], view[1], 0.0)
    assert slam.tracker.parts.flow is not None
    assert slam.tracker.state.flow is not None
    return slam.tracker.parts.flow, slam, slam.tracker.state.flow


def test_most_of_the_points_that_set_out_must_agree(views: list[View]) -> None:
    flow, slam, state = begun(views[0])
    tracks, state = flow.track_points(views[0][0], None, state, np.eye(4))
    features = slam.tracker.parts.extractor.measure(tracks.keypoints, views[0][1])
    estimate, _ = flow.estimate_pose(tracks, FrameFeatures(features, None), state, STILL)
    assert estimate is not None
    np.testing.assert_allclose(estimate.T_cw, np.eye(4), atol=1e-4)
    shifted = features.undistorted.copy()
    shifted[: len(shifted) // 2, 0] += 30
    moved = FrameFeatures(replace(features, undistorted=shifted), None)
    assert flow.estimate_pose(tracks, moved, state, STILL)[0] is None


@pytest.mark.parametrize(
    ("found", "answers", "over"), [(0.7, True, False), (0.5, True, True), (0.3, False, True)]
)
def test_a_frame_in_which_flow_loses_many_points_is_matched_after_the_answer(
    views: list[View], found: float, answers: bool, over: bool
) -> None:
    flow, slam, state = begun(views[0])
    tracks, state = flow.track_points(views[0][0], None, state, np.eye(4))
    some = np.arange(round(found * len(tracks.point_ids)))
    left = FlowTracks(tracks.point_ids[some], tracks.keypoints.take(some))
    features = slam.tracker.parts.extractor.measure(left.keypoints, views[0][1])
    estimate, state = flow.estimate_pose(left, FrameFeatures(features, None), state, STILL)
    assert (estimate is not None) == answers
    if estimate is not None:
        np.testing.assert_allclose(estimate.T_cw, np.eye(4), atol=1e-4)
        assert flow.needs_match(state, in_hurry=False, mapper_is_busy=False) == over
        assert not flow.needs_match(state, in_hurry=True, mapper_is_busy=False)
        assert flow.needs_match(state, in_hurry=False, mapper_is_busy=True) == over
        assert state.tracked_ratio == pytest.approx(found, abs=0.02)


def test_no_flow_starts_from_a_frame_with_few_matches(views: list[View]) -> None:
    flow, slam, _ = begun(views[0])
    last = slam.tracker.state.last
    assert last is not None
    few = replace(last, matches=last.matches.take(np.arange(49)))
    assert flow.start(views[1][0], few, None) is None
    assert flow.start(views[1][0], last, None) is not None


def test_what_is_at_rest_under_its_mask_is_followed_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of a still room is called a person, who after two seconds is taken to be seated: frames
    70 and later.
    """
    run, mask = Watched(monkeypatch), np.zeros((240, 320), dtype=np.bool_)
    mask[:, :230] = True
    view = render(room(), np.eye(4))
    for _ in range(96):
        assert run.track(view, mask).is_tracked
    assert run.poses[-1].dynamic_mask is not None
    late = [index for index in run.searched if index >= 72]
    assert np.diff(late).tolist() == [3] * (len(late) - 1)
    run.track(view, mask)
    features = run.poses[-1].features
    assert features is not None
    assert np.count_nonzero(features.pixels[:, 0] < 225) > 100


def test_few_points_are_weighed_against_what_was_expected(views: list[View]) -> None:
    flow, slam, state = begun(views[0])
    tracks, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    measure = slam.tracker.parts.extractor.measure
    features = FrameFeatures(measure(tracks.keypoints, views[0][1]), None)
    assert slam.tracker.state.last is not None
    some = np.arange(100)
    matches = Matches(tracks.point_ids[some], some)
    few = replace(slam.tracker.state.last, matches=matches, frame_features=features)
    started = flow.start(views[0][0], few, None)
    assert started is not None
    again, started = flow.track_points(views[0][0], None, started, np.eye(4))
    steady = Prediction(Prior(np.eye(4), 1e12 * np.eye(6)), True, 150)
    seen = measure(again.keypoints, views[0][1])
    moved = FrameFeatures(replace(seen, undistorted=seen.undistorted + 0.5), None)
    weighed, _ = flow.estimate_pose(again, moved, started, steady)
    alone, _ = flow.estimate_pose(again, moved, started, STILL)
    assert weighed is not None
    assert alone is not None
    assert (weighed.prior_gradient.any(), alone.prior_gradient.any()) == (True, False)
    np.testing.assert_allclose(weighed.T_cw, np.eye(4), atol=1e-5)
    assert np.abs(alone.T_cw - np.eye(4)).max() > 1e-3


def test_the_motion_moves_along_with_the_map_and_ends_with_a_loss(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, shift = Watched(monkeypatch), exp_se3(np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0]))
    for view in views[:6]:
        run.track(view)
    tracker, point_map = run.slam.tracker, run.slam.map
    assert tracker.state.last is not None
    before = tracker.state.last.T_cw
    tracker._apply_map_updates(
        lambda: point_map.move(np.stack([k.T_cw @ shift for k in point_map.keyframes]))
    )
    np.testing.assert_allclose(tracker.state.last.T_cw, before @ shift)
    prediction = tracker.parts.motion.predict(5 / 30)
    assert prediction is not None
    np.testing.assert_allclose(prediction.prior.T_cw, before @ shift, atol=0.01)
    black = np.zeros_like(views[0][0]), np.zeros_like(views[0][1]), views[0][2]
    run.track(black)
    run.track(black)
    assert not run.poses[-1].is_tracked
    assert tracker.parts.motion.twist is None
