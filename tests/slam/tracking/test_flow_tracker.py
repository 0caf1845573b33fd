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
    """Render the static room along a path."""
    return [render(room(), T_wc) for T_wc in camera_path(FRAMES)]


class RecordedRun:
    """Real-time SLAM that records in which frames keypoints are extracted."""

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
        self.time_used = 0.0
        self.slam = Slam(
            CAMERA,
            config,
            executor=SynchronousExecutor(),
            frame_time_used=lambda: self.time_used,
        )
        self.searched: list[int] = []
        self.poses: list[FrameResult] = []
        find = self.slam.tracker.parts.extractor.find

        def record(*arguments: Any) -> Keypoints:
            self.searched.append(len(self.poses))
            return find(*arguments)

        monkeypatch.setattr(self.slam.tracker.parts.extractor, "find", record)

    def track(self, view: View, mask: NDArray[np.bool_] | None = None) -> FrameResult:
        self.poses.append(track(self.slam, view[0], view[1], len(self.poses) / 30, mask))
        return self.poses[-1]

    def ate(self) -> float:
        """Return the RMSE of the trajectory, m."""
        truth = Trajectory(np.arange(FRAMES) / 30, camera_path(FRAMES))
        return score(truth, self.slam.trajectory())["ate_m"]["rmse"]


def test_flow_skips_keypoints_in_two_of_three_frames_without_loss_of_accuracy(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, matched = RecordedRun(monkeypatch), RecordedRun(monkeypatch, flow=False)
    for view in views:
        flow.track(view)
        matched.track(view)
        features = flow.poses[-1].features
        assert features is not None
        assert len(flow.poses) < 3 or features.is_subpixel.mean() > 0.3, (
            "refined keypoints stay refined"
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


def test_flow_pose_is_reported_before_matching(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RecordedRun(monkeypatch)
    slam, reported = run.slam, list[FrameResult]()
    for index, view in enumerate(views[:13]):
        searched = len(run.searched)

        def report(pose: FrameResult, index: int = index, searched: int = searched) -> None:
            reported.append(pose)
            assert index == 0 or len(run.searched) == searched, (
                "no keypoints have been extracted yet"
            )

        final = track(slam, view[0], view[1], index / 30, on_pose=report)
        assert len(reported) == index + 1
        assert reported[-1].T_wc is not None
        assert final.T_wc is not None
        np.testing.assert_allclose(reported[-1].T_wc, final.T_wc, atol=0.003)
        assert reported[-1].timing.tracking_ms == final.timing.tracking_ms
    assert len(run.searched) == 5


def test_matching_and_mapping_are_postponed_for_limited_number_of_frames(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RecordedRun(monkeypatch, keyframes__max_interval_frames=1)
    run_next_task, frames_with_task = run.slam.tracker.parts.mapper.run_next_task, list[int]()

    def record() -> None:
        frames_with_task.append(len(run.poses))
        run_next_task()

    monkeypatch.setattr(run.slam.tracker.parts.mapper, "run_next_task", record)
    run.track(views[0])
    run.time_used = 0.8
    for view in views[1:14]:
        assert run.track(view).is_tracked
    assert run.searched == [0, 6, 12]
    assert frames_with_task == [6, 12], (
        "tasks run in place of a keyframe, which waits for those of the one before"
    )
    assert [pose.is_keyframe for pose in run.poses] == [True] + [False] * 13
    run.time_used = 0.0
    for view in views[14:20]:
        run.track(view)
    assert run.searched == [0, 6, 12, 15, 18]
    assert frames_with_task == [6, 12, 14, 16, 17, 19]
    assert [index for index, pose in enumerate(run.poses) if pose.is_keyframe] == [0, 15, 18]
    run.time_used = 0.6
    for view in views[20:22]:
        run.track(view)
    assert frames_with_task[-2:] == [20, 21], "there is time for one task"
    assert run.searched[-1] == 18, "but not for matching"


def test_mapping_tasks_run_one_per_frame_while_flow_tracks(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RecordedRun(monkeypatch)
    num_tasks, keyframes = [], []
    for view in views:
        keyframes.append(run.track(view).is_keyframe)
        num_tasks.append(len(run.slam.tracker.parts.mapper._tasks))
    newest = [index for index in np.flatnonzero(keyframes).tolist() if index < len(views) - 2]
    assert len(newest) >= 2
    for index in newest:
        assert num_tasks[index : index + 3] == [2, 1, 0]
    run.slam.finish()
    assert not run.slam.tracker.parts.mapper._tasks


def test_flow_tracks_merged_points_as_their_successor(
    views: list[View],
) -> None:
    flow, slam, state = started_flow(views[0])
    first, state = flow.track_points(views[0][0], None, state, np.eye(4))
    is_subpixel = first.point_ids[first.keypoints.is_subpixel]
    old, new = is_subpixel[:1], is_subpixel[1:2]
    slam.map.merged_into[old] = new
    again, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    assert old not in again.point_ids
    assert np.count_nonzero(again.point_ids == new) == 1, "no point is tracked twice"
    slam.map.merged_into[old] = -1


def test_subsampled_flow_alternates_between_halves_of_points(
    views: list[View],
) -> None:
    flow, slam, state = started_flow(views[0])
    all_tracks, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    subsampled = FlowTracker(
        slam.map,
        ReprojectionModel(CAMERA),
        slam.tracker.parts.measurer,
        FlowConfig(subsample_above=len(state.point_ids)),
    )
    first_half, state = subsampled.track_points(views[0][0], None, state, np.eye(4))
    second_half, _ = subsampled.track_points(views[0][0], None, state, np.eye(4))
    ids = np.r_[first_half.point_ids, second_half.point_ids]
    np.testing.assert_array_equal(np.sort(ids), all_tracks.point_ids)
    assert 0.8 < len(first_half.point_ids) / len(second_half.point_ids) < 1.25


def test_flow_is_deterministic(views: list[View], monkeypatch: pytest.MonkeyPatch) -> None:
    trajectories = []
    for _ in range(2):
        run = RecordedRun(monkeypatch)
        for view in views[:12]:
            run.track(view)
        trajectories.append(run.slam.trajectory().poses.tobytes())
    assert trajectories[0] == trajectories[1]


def test_flow_is_enabled_only_in_real_time() -> None:
    recorded = Slam(CAMERA, slam_config(500))
    live = Slam(CAMERA, slam_config(500), executor=SynchronousExecutor())
    assert recorded.tracker.parts.flow is None
    assert live.tracker.parts.flow is not None


def test_frame_is_matched_where_flow_fails(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A jump of ten frames is too far for flow, but not for matching with the map."""
    run = RecordedRun(monkeypatch)
    for view in views[:4]:
        run.track(view)
    motion = run.slam.tracker.parts.motion
    assert motion._state is not None
    motion._state.velocity[:] = 0
    assert run.track(views[20]).is_tracked
    assert 4 in run.searched
    T_wc = run.poses[-1].T_wc
    assert T_wc is not None
    relative = np.linalg.inv(camera_path(FRAMES)[0]) @ camera_path(FRAMES)[20]
    np.testing.assert_allclose(T_wc[:3, 3], relative[:3, 3], atol=0.01)


def test_flow_does_not_start_after_loss(views: list[View], monkeypatch: pytest.MonkeyPatch) -> None:
    run = RecordedRun(monkeypatch)
    nothing = np.zeros_like(views[0][0]), np.zeros_like(views[0][1]), views[0][2]
    states = [
        run.track(nothing if index in (4, 5) else view).is_tracked
        for index, view in enumerate(views[:9])
    ]
    assert states == [True] * 4 + [False] * 2 + [True] * 3
    assert run.searched[:5] == [0, 3, 4, 5, 6]


def test_flow_ignores_masked_points_and_unmasked_person(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The person is masked in matched frames, but occludes points that flow tracks."""
    run, path = RecordedRun(monkeypatch), camera_path(FRAMES)
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


def test_flow_starts_from_predicted_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall moves by 20 px per frame, and by 40 px until the next matched frame."""
    path = exp_se3(np.outer(np.arange(10) - 5, [0.18, 0.0, 0.01, 0.0, 0.01, 0.0]))
    run = RecordedRun(monkeypatch)
    assert all(run.track(render(room(), T_wc)).is_tracked for T_wc in path)
    assert run.searched == [0, 1, 4, 7], "the first motion cannot be predicted"


def started_flow(view: View) -> tuple[FlowTracker, Slam, FlowState]:
    """Start flow from the first frame of a map."""
    slam = Slam(CAMERA, slam_config(500), executor=SynchronousExecutor())
    track(slam, view[0], view[1], 0.0)
    assert slam.tracker.parts.flow is not None
    assert slam.tracker.state.flow is not None
    return slam.tracker.parts.flow, slam, slam.tracker.state.flow


def test_flow_pose_needs_enough_inliers(views: list[View]) -> None:
    flow, slam, state = started_flow(views[0])
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
    ("ratio", "has_pose", "needs_match"),
    [(0.7, True, False), (0.5, True, True), (0.3, False, True)],
)
def test_frame_in_which_flow_loses_points_is_matched(
    views: list[View], ratio: float, has_pose: bool, needs_match: bool
) -> None:
    flow, slam, state = started_flow(views[0])
    tracks, state = flow.track_points(views[0][0], None, state, np.eye(4))
    kept = np.arange(round(ratio * len(tracks.point_ids)))
    remaining = FlowTracks(tracks.point_ids[kept], tracks.keypoints.take(kept))
    features = slam.tracker.parts.extractor.measure(remaining.keypoints, views[0][1])
    estimate, state = flow.estimate_pose(remaining, FrameFeatures(features, None), state, STILL)
    assert (estimate is not None) == has_pose
    if estimate is not None:
        np.testing.assert_allclose(estimate.T_cw, np.eye(4), atol=1e-4)
        assert flow.needs_match(state, in_hurry=False, mapper_is_busy=False) == needs_match
        assert not flow.needs_match(state, in_hurry=True, mapper_is_busy=False)
        assert flow.needs_match(state, in_hurry=False, mapper_is_busy=True) == needs_match
        assert state.tracked_ratio == pytest.approx(ratio, abs=0.02)


def test_flow_does_not_start_from_frame_with_few_matches(views: list[View]) -> None:
    flow, slam, _ = started_flow(views[0])
    last = slam.tracker.state.last
    assert last is not None
    few = replace(last, matches=last.matches.take(np.arange(49)))
    assert flow.start(views[1][0], few, None) is None
    assert flow.start(views[1][0], last, None) is not None


def test_static_object_is_tracked_under_its_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask covers most of a static room, which counts as static after two seconds."""
    run, mask = RecordedRun(monkeypatch), np.zeros((240, 320), dtype=np.bool_)
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


def test_motion_prior_counts_with_few_points(views: list[View]) -> None:
    flow, slam, state = started_flow(views[0])
    tracks, _ = flow.track_points(views[0][0], None, state, np.eye(4))
    measure = slam.tracker.parts.extractor.measure
    features = FrameFeatures(measure(tracks.keypoints, views[0][1]), None)
    assert slam.tracker.state.last is not None
    rows = np.arange(100)
    matches = Matches(tracks.point_ids[rows], rows)
    few = replace(slam.tracker.state.last, matches=matches, frame_features=features)
    started = flow.start(views[0][0], few, None)
    assert started is not None
    again, started = flow.track_points(views[0][0], None, started, np.eye(4))
    steady = Prediction(Prior(np.eye(4), 1e12 * np.eye(6)), True, 150)
    measured = measure(again.keypoints, views[0][1])
    moved = FrameFeatures(replace(measured, undistorted=measured.undistorted + 0.5), None)
    with_prior, _ = flow.estimate_pose(again, moved, started, steady)
    without_prior, _ = flow.estimate_pose(again, moved, started, STILL)
    assert with_prior is not None
    assert without_prior is not None
    assert (with_prior.prior_gradient.any(), without_prior.prior_gradient.any()) == (True, False)
    np.testing.assert_allclose(with_prior.T_cw, np.eye(4), atol=1e-5)
    assert np.abs(without_prior.T_cw - np.eye(4)).max() > 1e-3


def test_motion_model_moves_with_map_and_resets_on_loss(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, shift = RecordedRun(monkeypatch), exp_se3(np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0]))
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
