"""Frames that optical flow tracks between two that are matched against the map."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, passer_by, render, room

from cohdc_train.slam.config import Method
from cohdc_train.slam.features.keypoints import Keypoints
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.frame import Pose
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.optimization.reprojection import Prior
from cohdc_train.slam.runtime.executors import SynchronousExecutor
from cohdc_train.slam.tracking.flow_tracker import FlowTracker, Followed
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 31
STILL = Prediction(Prior(np.eye(4), np.zeros((6, 6))), calm=False)
View = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """A still room along a path."""
    return [render(room(), T_wc) for T_wc in camera_path(FRAMES)]


class Watched:
    """A tracker in real time that says which frames were searched for corners."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, flow: bool = True) -> None:
        method = Method(flow=flow, global_adjustment=False, smoothing=False)
        self.spent = 0.0
        self.tracker = Tracker(
            CAMERA, 500, method=method, executor=SynchronousExecutor(), spent=lambda: self.spent
        )
        self.searched: list[int] = []
        self.poses: list[Pose] = []
        find = self.tracker._extract.find

        def noted(*arguments: Any) -> Keypoints:
            self.searched.append(len(self.poses))
            return find(*arguments)

        monkeypatch.setattr(self.tracker._extract, "find", noted)

    def track(self, view: View, mask: NDArray[np.bool_] | None = None) -> Pose:
        self.poses.append(self.tracker.track(view[0], view[1], len(self.poses) / 30, mask))
        return self.poses[-1]

    def ate(self) -> float:
        """RMSE, m."""
        truth = Trajectory(np.arange(FRAMES) / 30, camera_path(FRAMES))
        return score(truth, Trajectory(*self.tracker.trajectory()))["ate_m"]["rmse"]


def test_two_of_three_frames_need_no_corners_and_are_as_exact(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, matched = Watched(monkeypatch), Watched(monkeypatch, flow=False)
    for view in views:
        flow.track(view)
        matched.track(view)
        features = flow.tracker.features
        assert features is not None
        assert len(flow.poses) < 3 or features.is_subpixel.mean() > 0.3, (
            "what a patch told is carried along"
        )
    assert matched.searched == list(range(FRAMES))
    assert flow.searched == list(range(0, FRAMES, 3))
    assert all(pose.tracked for pose in flow.poses)
    assert not any(pose.keyframe for index, pose in enumerate(flow.poses) if index % 3)
    assert sum(pose.keyframe for pose in flow.poses) <= sum(pose.keyframe for pose in matched.poses)
    assert flow.ate() < 0.004
    assert flow.ate() < 1.25 * matched.ate()


def test_the_answer_by_flow_comes_before_the_frame_is_matched(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Watched(monkeypatch)
    tracker, told = run.tracker, list[Pose]()
    for index, view in enumerate(views[:13]):
        searched = len(run.searched)

        def tell(pose: Pose, index: int = index, searched: int = searched) -> None:
            told.append(pose)
            assert index == 0 or len(run.searched) == searched, "nothing has been searched yet"

        final = tracker.track(view[0], view[1], index / 30, on_pose=tell)
        assert len(told) == index + 1
        assert told[-1].T_wc is not None
        assert final.T_wc is not None
        np.testing.assert_allclose(told[-1].T_wc, final.T_wc, atol=0.003)
        assert told[-1].track_ms == final.track_ms
    assert len(run.searched) == 5


def test_in_a_hurry_matching_and_mapping_wait_but_not_for_ever(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cohdc_train.slam.tracking.tracker._KEYFRAME_FRAMES", 1)
    run = Watched(monkeypatch)
    work, worked = run.tracker._mapping.work, list[int]()

    def noted() -> None:
        worked.append(len(run.poses))
        work()

    monkeypatch.setattr(run.tracker._mapping, "work", noted)
    run.track(views[0])
    run.spent = 0.8
    for view in views[1:14]:
        assert run.track(view).tracked
    assert run.searched == [0, 6, 12]
    assert worked == [6, 12], (
        "in place of a keyframe, which waits until all is done for the one before"
    )
    assert [pose.keyframe for pose in run.poses] == [True] + [False] * 13
    run.spent = 0.0
    for view in views[14:20]:
        run.track(view)
    assert run.searched == [0, 6, 12, 15, 18]
    assert worked == [6, 12, 14, 16, 17, 19]
    assert [index for index, pose in enumerate(run.poses) if pose.keyframe] == [0, 15, 18]
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
        keyframes.append(run.track(view).keyframe)
        left.append(len(run.tracker._mapping._parts))
    newest = [index for index in np.flatnonzero(keyframes).tolist() if index < len(views) - 2]
    assert len(newest) >= 2
    for index in newest:
        assert left[index : index + 3] == [2, 1, 0]
    run.tracker.finish()
    assert not run.tracker._mapping._parts


def test_what_flow_follows_are_the_points_that_those_it_set_out_with_have_become(
    views: list[View],
) -> None:
    flow, tracker = begun(views[0])
    first = flow.follow(views[0][0], None, np.eye(4))
    assert first is not None
    is_subpixel = first.ids[first.keypoints.is_subpixel]
    old, new = is_subpixel[:1], is_subpixel[1:2]
    tracker.map.merged_into[old] = new
    again = flow.follow(views[0][0], None, np.eye(4))
    assert again is not None
    assert old not in again.ids
    assert np.count_nonzero(again.ids == new) == 1, "no point is followed twice"
    tracker.map.merged_into[old] = -1


def test_of_many_points_a_frame_follows_every_second_and_the_next_the_others(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, tracker = begun(views[0])
    assert tracker._last is not None
    every = flow.follow(views[0][0], None, np.eye(4))
    monkeypatch.setattr("cohdc_train.slam.tracking.flow_tracker._MANY", len(tracker._last.matches))
    some, others = (flow.follow(views[0][0], None, np.eye(4)) for _ in range(2))
    assert every is not None
    assert some is not None
    assert others is not None
    np.testing.assert_array_equal(np.sort(np.r_[some.ids, others.ids]), every.ids)
    assert 0.8 < len(some.ids) / len(others.ids) < 1.25


def test_the_same_frames_give_the_same_bits(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    ways = []
    for _ in range(2):
        run = Watched(monkeypatch)
        for view in views[:12]:
            run.track(view)
        ways.append(run.tracker.trajectory()[1].tobytes())
    assert ways[0] == ways[1]


def test_flow_belongs_to_real_time() -> None:
    assert Tracker(CAMERA, 500)._flow is None
    assert Tracker(CAMERA, 500, executor=SynchronousExecutor())._flow is not None


def test_where_flow_finds_too_little_the_frame_is_matched(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A leap of ten frames lies beyond what flow can reach, but not beyond the map's."""
    run = Watched(monkeypatch)
    for view in views[:4]:
        run.track(view)
    run.tracker._motion._velocity[:] = 0
    assert run.track(views[20]).tracked
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
        run.track(nothing if index in (4, 5) else view).tracked
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
        assert run.tracker.features is not None
        x, y = np.rint(run.tracker.features.pixels).astype(int).T
        under_mask += np.count_nonzero(view[2][y, x]) if masked else 0
    assert run.searched == list(range(0, FRAMES, 3))
    assert under_mask == 0
    assert run.ate() < 0.005


def test_flow_sets_out_from_where_the_motion_leads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall moves by 20 px from frame to frame, and by 40 until the next matched one."""
    path = exp_se3(np.outer(np.arange(10) - 5, [0.18, 0.0, 0.01, 0.0, 0.01, 0.0]))
    run = Watched(monkeypatch)
    assert all(run.track(render(room(), T_wc)).tracked for T_wc in path)
    assert run.searched == [0, 1, 4, 7], "the first motion is known to nobody"


def begun(view: View) -> tuple[FlowTracker, Tracker]:
    """A flow that sets out from the first frame of a map."""
    tracker = Tracker(CAMERA, 500, executor=SynchronousExecutor())
    tracker.track(view[0], view[1], 0.0)
    assert tracker._flow is not None
    return tracker._flow, tracker


def test_most_of_the_points_that_set_out_must_agree(views: list[View]) -> None:
    flow, tracker = begun(views[0])
    followed = flow.follow(views[0][0], None, np.eye(4))
    assert followed is not None
    features = tracker._extract.measure(followed.keypoints, views[0][1])
    fit = flow.locate(followed, features, STILL)
    assert fit is not None
    np.testing.assert_allclose(fit.T_cw, np.eye(4), atol=1e-4)
    shifted = features.points.copy()
    shifted[: len(shifted) // 2, 0] += 30
    assert flow.locate(followed, replace(features, points=shifted), STILL) is None


@pytest.mark.parametrize(
    ("found", "answers", "over"), [(0.7, True, False), (0.5, True, True), (0.3, False, True)]
)
def test_a_frame_in_which_flow_loses_many_points_is_matched_after_the_answer(
    views: list[View], found: float, answers: bool, over: bool
) -> None:
    flow, tracker = begun(views[0])
    followed = flow.follow(views[0][0], None, np.eye(4))
    assert followed is not None
    some = np.arange(round(found * len(followed.ids)))
    left = Followed(followed.ids[some], followed.keypoints.take(some))
    fit = flow.locate(left, tracker._extract.measure(left.keypoints, views[0][1]), STILL)
    assert (fit is not None) == answers
    if fit is not None:
        np.testing.assert_allclose(fit.T_cw, np.eye(4), atol=1e-4)
        assert (flow.over(hurry=False), flow.over(hurry=True)) == (over, False)
        assert flow.over(hurry=False, busy=True) == over
        assert flow.left == pytest.approx(found, abs=0.02)


def test_no_flow_sets_out_from_a_frame_without_a_pose(views: list[View]) -> None:
    flow, tracker = begun(views[0])
    assert tracker.features is not None
    flow.begin(views[1][0], tracker.features, None, None)
    assert flow.follow(views[1][0], None, np.eye(4)) is None


def test_what_is_at_rest_under_its_mask_is_followed_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of a still room is called a person, who after two seconds is taken to be seated: frames
    70 and later.
    """
    run, mask = Watched(monkeypatch), np.zeros((240, 320), dtype=np.bool_)
    mask[:, :230] = True
    view = render(room(), np.eye(4))
    for _ in range(96):
        assert run.track(view, mask).tracked
    assert run.tracker.mask is not None
    late = [index for index in run.searched if index >= 72]
    assert np.diff(late).tolist() == [3] * (len(late) - 1)
    run.track(view, mask)
    assert run.tracker.features is not None
    assert np.count_nonzero(run.tracker.features.pixels[:, 0] < 225) > 100


def test_few_points_are_weighed_against_what_was_expected(views: list[View]) -> None:
    flow, tracker = begun(views[0])
    followed = flow.follow(views[0][0], None, np.eye(4))
    assert followed is not None
    features = tracker._extract.measure(followed.keypoints, views[0][1])
    assert tracker._last is not None
    some = np.arange(100)
    few = replace(tracker._last, matches=Matches(followed.ids[some], some))
    flow.begin(views[0][0], features, few, None)
    again = flow.follow(views[0][0], None, np.eye(4))
    assert again is not None
    steady = Prediction(Prior(np.eye(4), 1e12 * np.eye(6)), calm=True)
    seen = tracker._extract.measure(again.keypoints, views[0][1])
    moved = replace(seen, points=seen.points + 0.5)
    weighed, alone = flow.locate(again, moved, steady), flow.locate(again, moved, STILL)
    assert weighed is not None
    assert alone is not None
    assert (weighed.pull.any(), alone.pull.any()) == (True, False)
    np.testing.assert_allclose(weighed.T_cw, np.eye(4), atol=1e-5)
    assert np.abs(alone.T_cw - np.eye(4)).max() > 1e-3


def test_the_motion_moves_along_with_the_map_and_ends_with_a_loss(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, shift = Watched(monkeypatch), exp_se3(np.array([0.1, 0.0, 0.2, 0.0, 0.3, 0.0]))
    for view in views[:6]:
        run.track(view)
    tracker = run.tracker
    assert tracker._last is not None
    before = tracker._last.T_cw
    tracker._let(
        lambda: tracker.map.move(np.stack([k.T_cw @ shift for k in tracker.map.keyframes]))
    )
    np.testing.assert_allclose(tracker._last.T_cw, before @ shift)
    np.testing.assert_allclose(
        tracker._motion.expected(5 / 30).prior.T_cw, before @ shift, atol=0.01
    )
    run.track((np.zeros_like(views[0][0]), np.zeros_like(views[0][1]), views[0][2]))
    run.track((np.zeros_like(views[0][0]), np.zeros_like(views[0][1]), views[0][2]))
    assert not run.poses[-1].tracked
    assert tracker._motion.twist is None
