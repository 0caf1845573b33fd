"""Tracking in rendered worlds with known poses."""

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
    """Return the RMSE of the trajectory, m."""
    stamps = np.arange(len(truth)) / 30
    return score(Trajectory(stamps, truth), slam.trajectory())["ate_m"]["rmse"]


View = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Render the static room along the path."""
    return [render(room(), T_wc) for T_wc in camera_path(40)]


def run(views: list[View], seed: int = 0) -> tuple[Slam, list[FrameResult]]:
    slam = Slam(CAMERA, slam_config(500, seed=seed))
    return slam, [
        track(slam, rgb, depth, index / 30) for index, (rgb, depth, _) in enumerate(views)
    ]


def test_static_room_is_tracked_with_millimeter_accuracy(views: list[View]) -> None:
    slam, poses = run(views)
    assert all(pose.is_tracked for pose in poses)
    assert 2 <= len(slam.map.keyframes) < 25
    assert ate(slam, camera_path(40)) < 0.004
    np.testing.assert_array_equal(poses[0].T_wc, np.eye(4))


def test_result_counts_matches_and_inliers(views: list[View]) -> None:
    """Matches include outliers of the chi-square test; inliers agree with the pose."""
    slam, poses = run(views)
    others = [pose for pose in poses if not pose.is_keyframe]
    assert all(0 < pose.num_inliers <= pose.num_matches for pose in others)
    assert any(pose.num_inliers < pose.num_matches for pose in others)
    last, extracted = slam.tracker.state.last, others[-1]
    assert last is not None
    points, observations = slam.map.measured(last.matches, last.features)
    chi2 = chi_square(last.T_cw, points, observations, ReprojectionModel(CAMERA))
    assert extracted.num_inliers == np.count_nonzero(chi2 <= observations.chi2_thresholds)


def test_same_seed_gives_identical_trajectory(views: list[View]) -> None:
    first, second = (run(views[:15], seed=3)[0].trajectory().poses for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_camera_is_relocalized_after_blackout(views: list[View]) -> None:
    slam, path = Slam(CAMERA, slam_config(500)), camera_path(40)
    states = []
    for index in range(40):
        rgb, depth = (BLACK, NOTHING) if 15 <= index < 22 else views[index][:2]
        states.append(track(slam, rgb, depth, index / 30).is_tracked)
    assert all(states[:15])
    assert not any(states[15:22])
    assert all(states[22:]), "the camera moved by seven frames in the dark and must be relocalized"
    assert len(slam.trajectory()) == 33, "lost frames have no pose"
    assert ate(slam, path) < 0.005


def test_rough_pose_is_estimated_only_after_sudden_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The image moves suddenly by 45 px from one frame to the next."""
    slam, frames_with_ransac = Slam(CAMERA, slam_config(500)), []
    solve = slam.tracker.parts.localizer._solve
    monkeypatch.setattr(
        slam.tracker.parts.localizer,
        "_solve",
        lambda *a, **k: frames_with_ransac.append(len(poses)) or solve(*a, **k),
    )
    path = exp_se3(np.outer(np.arange(24), [0.006, 0.0, 0.0, 0.0, 0.003, 0.0]))
    path[23] = path[23] @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.16, 0.0]))
    poses: list[FrameResult] = []
    for index, T_wc in enumerate(path):
        poses.append(track(slam, *render(room(), T_wc)[:2], index / 30))
    assert set(frames_with_ransac) == {23}
    T_wc = poses[-1].T_wc
    assert T_wc is not None
    np.testing.assert_allclose(T_wc, path[23], atol=0.01)


def test_fast_camera_is_tracked_over_dropped_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall moves by 72 px while five frames are missing; the prediction makes up for it."""
    path = exp_se3(np.outer(np.arange(13) - 5, [0.12, 0.0, 0.01, 0.0, 0.01, 0.0]))
    slam = Slam(CAMERA, slam_config(600))

    def fail(*_: object) -> None:
        raise AssertionError("the whole map is searched")

    monkeypatch.setattr(slam.tracker.parts.localizer, "relocalize", fail)
    for k in [*range(4), *range(9, 13)]:
        pose = track(slam, *render(room(), path[k])[:2], k / 30)
        assert pose.T_wc is not None
        assert np.linalg.norm((inverse(path[0]) @ path[k] @ inverse(pose.T_wc))[:3, 3]) < 0.015
        assert pose.num_matches > 200


def test_frame_without_features_has_no_pose() -> None:
    slam = Slam(CAMERA, slam_config(1000))
    pose = track(slam, BLACK, NOTHING, 0.0)
    assert not pose.is_tracked
    assert pose.T_wc is None
    assert slam.trajectory().poses.shape == (0, 4, 4)


EVERYTHING = np.ones((240, 320), dtype=np.bool_)


def test_fully_masked_first_frame_has_no_pose(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    rgb, depth, _ = views[0]
    assert not track(slam, rgb, depth, 0.0, EVERYTHING).is_tracked
    assert track(slam, rgb, depth, 0.1).is_tracked


def test_fully_masked_frames_are_tracked_against_map(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    poses = [
        track(slam, rgb, depth, index / 30, EVERYTHING if 10 <= index < 25 else None)
        for index, (rgb, depth, _) in enumerate(views)
    ]
    assert all(pose.is_tracked for pose in poses)
    assert not any(pose.is_keyframe for pose in poses[10:25]), (
        "masked surfaces are never added to the map"
    )
    assert ate(slam, camera_path(40)) < 0.005


def test_whole_image_match_uses_depth_timestamp(
    views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = Slam(CAMERA, slam_config(500))
    for index, (rgb, depth, _) in enumerate(views[:4]):
        track(slam, rgb, depth, index / 30)
    measure, transforms = slam.tracker.parts.extractor.measure, []

    def record_transform(
        keypoints: Keypoints,
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None,
        T_depth_color: NDArray[np.float64] | None,
    ) -> Features:
        transforms.append(T_depth_color)
        return measure(keypoints, depth, mask, T_depth_color)

    monkeypatch.setattr(slam.tracker.parts.extractor, "measure", record_transform)
    assert track(slam, *views[4][:2], 4 / 30, EVERYTHING, depth_timestamp=4 / 30 + 0.01).is_tracked
    assert len(transforms) == 2, "first the unmasked keypoints, then all"
    assert transforms[0] is not None
    np.testing.assert_array_equal(transforms[1], transforms[0])


def test_rejected_pose_does_not_update_static_odds(
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
    np.testing.assert_array_equal(slam.map.static_odds.moving_log_odds, 0)


def test_frame_result_is_independent_of_later_map_changes(views: list[View]) -> None:
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


def test_pose_is_rejected_once_without_refinement(
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


def test_status_distinguishes_initializing_from_lost(views: list[View]) -> None:
    slam = Slam(CAMERA, slam_config(500))
    frames = [(BLACK, NOTHING), views[0][:2], (BLACK, NOTHING), views[1][:2]]
    statuses = [track(slam, *frame, index / 30).status for index, frame in enumerate(frames)]
    assert statuses == ["initializing", "tracking", "lost", "tracking"]


def features_at(
    points: list[tuple[float, float]], values: list[int], octaves: list[int]
) -> Features:
    pixels = np.array(points, dtype=np.float64)
    descriptors = np.zeros((len(values), 4), dtype=np.uint64)
    descriptors[:, 0] = values
    return Features(
        pixels,
        pixels,
        np.array(octaves),
        descriptors,
        np.ones(len(values)),
        np.zeros(len(values), bool),
    )


@pytest.mark.parametrize(
    ("keypoint", "octave", "word", "found"),
    [((52.0, 40.0), 0, 0b0, True), ((59.0, 40.0), 0, 0b0, False), ((52.0, 40.0), 2, 0b0, False)],
    ids=["near", "too far", "other level"],
)
def test_projection_match_needs_near_keypoint_of_similar_level(
    keypoint: tuple[float, float], octave: int, word: int, found: bool
) -> None:
    features = features_at([keypoint], [word], [octave])
    projected = Projected(
        np.array([77]), np.array([[50.0, 40.0]]), np.array([0]), np.zeros((1, 4), dtype=np.uint64)
    )
    matches = match_projected(projected, features, 5.0, MatchingConfig())
    assert matches.point_ids.tolist() == ([77] if found else [])


def test_matches_are_one_to_one_and_unambiguous() -> None:
    # Points 0 and 1 match keypoint 0 best, point 0 better; point 2 is ambiguous.
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
def test_invalid_frame_is_refused(changes: dict[str, object], message: str) -> None:
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
