"""The slam on worlds whose every pose is known."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, render, room, slam_config, track

from cohdc_train.errors import DataError
from cohdc_train.slam.config import MatchingConfig, SlamConfig
from cohdc_train.slam.features.keypoints import Features, Keypoints
from cohdc_train.slam.features.matching import Matches, Projected, match_projected, one_to_one
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameResult
from cohdc_train.slam.geometry.se3 import exp_se3, inverse
from cohdc_train.slam.optimization.reprojection import ReprojectionModel, chi_square
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

BLACK = np.zeros((240, 320, 3), dtype=np.uint8)
NOTHING = np.zeros((240, 320), dtype=np.float32)


def ate(slam: Slam, truth: NDArray[np.float64]) -> float:
    """RMSE, m."""
    stamps = np.arange(len(truth)) / 30
    return score(Trajectory(stamps, truth), slam.trajectory())["ate_m"]["rmse"]


View = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """The still room along the path."""
    return [render(room(), T_wc) for T_wc in camera_path(40)]


def run(views: list[View], seed: int = 0) -> tuple[Slam, list[FrameResult]]:
    slam = Slam(CAMERA, slam_config(500, seed=seed))
    return slam, [
        track(slam, rgb, depth, index / 30) for index, (rgb, depth, _) in enumerate(views)
    ]


def test_every_frame_of_a_still_room_is_tracked_to_millimetres(views: list[View]) -> None:
    slam, poses = run(views)
    assert all(pose.is_tracked for pose in poses)
    assert 2 <= len(slam.map.keyframes) < 25
    assert ate(slam, camera_path(40)) < 0.004
    np.testing.assert_array_equal(poses[0].T_wc, np.eye(4))


def test_inliers_are_counted_beside_matches(views: list[View]) -> None:
    """Matches keep outliers of the chi-square test; inliers are those that agree with the pose."""
    slam, poses = run(views)
    others = [pose for pose in poses if not pose.is_keyframe]
    assert all(0 < pose.num_inliers <= pose.num_matches for pose in others)
    assert any(pose.num_inliers < pose.num_matches for pose in others)
    last, extracted = slam.tracker.state.last, others[-1]
    assert last is not None
    points, seen = slam.map.measured(last.matches, last.features)
    chi2 = chi_square(last.T_cw, points, seen, ReprojectionModel(CAMERA))
    assert extracted.num_inliers == np.count_nonzero(chi2 <= seen.chi2_thresholds)


def test_same_seed_same_bits(views: list[View]) -> None:
    first, second = (run(views[:15], seed=3)[0].trajectory().poses for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_the_place_is_found_again_after_a_black_out(views: list[View]) -> None:
    slam, path = Slam(CAMERA, slam_config(500)), camera_path(40)
    states = []
    for index in range(40):
        rgb, depth = (BLACK, NOTHING) if 15 <= index < 22 else views[index][:2]
        states.append(track(slam, rgb, depth, index / 30).is_tracked)
    assert all(states[:15])
    assert not any(states[15:22])
    assert all(states[22:]), (
        "the camera moved on by seven frames in the dark and must still be found"
    )
    assert len(slam.trajectory()) == 33, "lost frames have no pose"
    assert ate(slam, path) < 0.005


def test_a_calm_camera_asks_the_map_at_once_and_a_jolted_one_first_guesses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The jolt: the picture moves by 45 px from one frame to the next."""
    slam, guessed = Slam(CAMERA, slam_config(500)), []
    solve = slam.tracker.parts.localizer._solve
    monkeypatch.setattr(
        slam.tracker.parts.localizer,
        "_solve",
        lambda *a, **k: guessed.append(len(poses)) or solve(*a, **k),
    )
    path = exp_se3(np.outer(np.arange(24), [0.006, 0.0, 0.0, 0.0, 0.003, 0.0]))
    path[23] = path[23] @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.16, 0.0]))
    poses: list[FrameResult] = []
    for index, T_wc in enumerate(path):
        poses.append(track(slam, *render(room(), T_wc)[:2], index / 30))
    assert set(guessed) == {23}
    T_wc = poses[-1].T_wc
    assert T_wc is not None
    np.testing.assert_allclose(T_wc, path[23], atol=0.01)


def test_a_fast_camera_is_followed_over_dropped_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five are missing, in which the wall moves by 72 px: no place is looked up, for the motion
    says where to look.
    """
    path = exp_se3(np.outer(np.arange(13) - 5, [0.12, 0.0, 0.01, 0.0, 0.01, 0.0]))
    slam = Slam(CAMERA, slam_config(600))

    def lost(*_: object) -> None:
        raise AssertionError("the whole map is searched")

    monkeypatch.setattr(slam.tracker.parts.localizer, "relocalize", lost)
    for k in [*range(4), *range(9, 13)]:
        pose = track(slam, *render(room(), path[k])[:2], k / 30)
        assert pose.T_wc is not None
        assert np.linalg.norm((inverse(path[0]) @ path[k] @ inverse(pose.T_wc))[:3, 3]) < 0.015
        assert pose.num_matches > 200


def test_nothing_to_see_is_lost_not_guessed() -> None:
    slam = Slam(CAMERA, slam_config(1000))
    pose = track(slam, BLACK, NOTHING, 0.0)
    assert not pose.is_tracked
    assert pose.T_wc is None
    assert slam.trajectory().poses.shape == (0, 4, 4)


EVERYTHING = np.ones((240, 320), dtype=np.bool_)


def test_a_first_frame_wholly_under_its_mask_is_lost(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    rgb, depth, _ = views[0]
    assert not track(slam, rgb, depth, 0.0, EVERYTHING).is_tracked
    assert track(slam, rgb, depth, 0.1).is_tracked


def test_a_mask_over_everything_costs_no_frame_once_there_is_a_map(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    poses = [
        track(slam, rgb, depth, index / 30, EVERYTHING if 10 <= index < 25 else None)
        for index, (rgb, depth, _) in enumerate(views)
    ]
    assert all(pose.is_tracked for pose in poses)
    assert not any(pose.is_keyframe for pose in poses[10:25]), (
        "what a mask covers never enters the map"
    )
    assert ate(slam, camera_path(40)) < 0.005


def test_a_picture_matched_whole_takes_depth_at_its_own_time_too(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = Slam(CAMERA, slam_config(500))
    for index, (rgb, depth, _) in enumerate(views[:4]):
        track(slam, rgb, depth, index / 30)
    measure, lags = slam.tracker.parts.extractor.measure, []

    def watched(
        keypoints: Keypoints,
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None,
        lag: NDArray[np.float64] | None,
    ) -> Features:
        lags.append(lag)
        return measure(keypoints, depth, mask, lag)

    monkeypatch.setattr(slam.tracker.parts.extractor, "measure", watched)
    assert track(slam, *views[4][:2], 4 / 30, EVERYTHING, depth_timestamp=4 / 30 + 0.01).is_tracked
    assert len(lags) == 2, "first what is not masked, then all"
    assert lags[0] is not None
    np.testing.assert_array_equal(lags[1], lags[0])


def test_a_pose_that_is_rejected_judges_no_point(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = Slam(CAMERA, slam_config(500))
    for index, (rgb, depth, _) in enumerate(views[:2]):
        track(slam, rgb, depth, index / 30)

    def wrong(
        T_cw: NDArray[np.float64], points: NDArray[np.float64], *_: object
    ) -> tuple[object, object, object]:
        nothing = np.zeros(len(points), dtype=np.bool_)
        return T_cw, nothing, ~nothing

    monkeypatch.setattr("cohdc_train.slam.tracking.localizer.estimate_static_pose", wrong)
    assert not track(slam, *views[2][:2], 2 / 30).is_tracked
    np.testing.assert_array_equal(slam.map.moving_log_odds, 0)


def test_result_of_a_frame_does_not_change_when_the_map_does(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    first = track(slam, *views[0][:2], 0.0)
    assert first.is_keyframe
    assert first.features is not None
    before = first.features.is_subpixel.copy()
    keyframe = slam.map.keyframes[0]
    keypoints = np.flatnonzero(keyframe.point_ids >= 0)[:50]
    matches = Matches(keyframe.point_ids[keypoints], keypoints)
    slam.map.forget(keyframe, keypoints)
    slam.map.observe(keyframe, matches)
    assert not keyframe.features.is_subpixel[keypoints].any()
    np.testing.assert_array_equal(first.features.is_subpixel, before)


def test_without_refinement_a_pose_is_rejected_once(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = Slam(CAMERA, slam_config(500, refinement__enabled=False))
    track(slam, *views[0][:2], 0.0)
    attempts: list[object] = []
    monkeypatch.setattr(
        slam.tracker.parts.localizer, "refine_pose", lambda *given: attempts.append(given)
    )
    assert track(slam, *views[1][:2], 1 / 30).status == "lost"
    assert len(attempts) == 1


def test_status_tells_whether_there_is_a_map(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    frames = [(BLACK, NOTHING), views[0][:2], (BLACK, NOTHING), views[1][:2]]
    statuses = [track(slam, *frame, index / 30).status for index, frame in enumerate(frames)]
    assert statuses == ["initializing", "tracking", "lost", "tracking"]


def features_at(
    points: list[tuple[float, float]], words: list[int], octaves: list[int]
) -> Features:
    pixels = np.array(points, dtype=np.float64)
    descriptors = np.zeros((len(words), 4), dtype=np.uint64)
    descriptors[:, 0] = words
    return Features(
        pixels,
        pixels,
        np.array(octaves),
        descriptors,
        np.ones(len(words)),
        np.zeros(len(words), bool),
    )


@pytest.mark.parametrize(
    ("keypoint", "octave", "word", "found"),
    [((52.0, 40.0), 0, 0b0, True), ((59.0, 40.0), 0, 0b0, False), ((52.0, 40.0), 2, 0b0, False)],
    ids=["near", "too far", "other level"],
)
def test_matching_by_projection(
    keypoint: tuple[float, float], octave: int, word: int, found: bool
) -> None:
    features = features_at([keypoint], [word], [octave])
    projected = Projected(
        np.array([77]), np.array([[50.0, 40.0]]), np.array([0]), np.zeros((1, 4), dtype=np.uint64)
    )
    matches = match_projected(projected, features, 5.0, MatchingConfig())
    assert matches.point_ids.tolist() == ([77] if found else [])


def test_matches_are_one_to_one_and_clear() -> None:
    # point 0 likes corner 0 best; point 1 likes it too but less; point 2 cannot tell corners 1 and
    # 2 apart
    i, j, bits = (
        np.array([0, 0, 1, 2, 2]),
        np.array([0, 1, 0, 1, 2]),
        np.array([10, 60, 20, 30, 31]),
    )
    points, keypoints = one_to_one(i, j, bits, ratio=0.9)
    assert points.tolist() == [0]
    assert keypoints.tolist() == [0]
    assert len(Matches(points, keypoints)) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rgb": BLACK.astype(np.float32)}, r"rgb is float32 \(240, 320, 3\), not uint8"),
        ({"rgb": BLACK[:200]}, r"rgb is uint8 \(200, 320, 3\), not uint8 \(240, 320, 3\)"),
        (
            {"depth": (1000 * NOTHING).astype(np.uint16)},
            r"depth is uint16 .*, not float \(240, 320\) in m",
        ),
        ({"mask": np.zeros((240, 320), dtype=np.uint8)}, r"mask is uint8 .*, not bool"),
        ({"t": 1.0}, r"frame at 1\.000000 s: not after the frame before it, at 1\.000000 s"),
        ({"t": float("nan")}, r"frame at nan s: not after the frame before it"),
    ],
)
def test_frame_that_does_not_fit_is_refused(changes: dict[str, object], message: str) -> None:
    slam = Slam(CAMERA, slam_config(500))
    track(slam, BLACK, NOTHING, 1.0)
    frame = {"rgb": BLACK, "depth": NOTHING, "t": 2.0, "mask": None} | changes
    with pytest.raises(DataError, match=message):
        track(slam, frame["rgb"], frame["depth"], frame["t"], frame["mask"])
    assert not track(slam, BLACK, NOTHING, 3.0).is_tracked


def test_number_of_keypoints_has_one_default() -> None:
    default = SlamConfig().features.max_keypoints
    extractor = Slam(CAMERA).tracker.parts.extractor
    assert extractor.config.max_keypoints == OrbExtractor(CAMERA).config.max_keypoints == default
