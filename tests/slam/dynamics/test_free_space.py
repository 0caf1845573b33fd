"""Moving objects found by depth, and masks of objects at rest."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, passer_by, render, room, slam_config, track

from cohdc_train.slam.config import FeatureConfig, FreeSpaceConfig, SurfaceConfig
from cohdc_train.slam.dynamics.dynamic_mask import DynamicMaskEstimator
from cohdc_train.slam.dynamics.free_space import FreeSpaceChecker, ReferenceDepth
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, exp_se3
from cohdc_train.slam.io.live import LiveCamera
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.runner import track_sequence
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

REPROJECTION = ReprojectionModel(CAMERA)
LENS = replace(CAMERA, k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633)
STILL = np.eye(4)
Depth = NDArray[np.float32]


def wall(depth: float = 3.0) -> Depth:
    return np.full((240, 320), depth, dtype=np.float32)


def with_box(image: Depth, left: int, depth: float) -> Depth:
    """Return the depth with a box of 80 x 80 px in it."""
    image = image.copy()
    image[80:160, left : left + 80] = depth
    return image


def found(
    camera: Camera, now: Depth, before: list[Depth], T_cw: Array = STILL
) -> NDArray[np.bool_]:
    geometry = FreeSpaceChecker(camera)
    comparison = geometry.compare(
        now, T_cw, [ReferenceDepth(STILL, geometry.min_depth_grid(image)) for image in before]
    )
    return geometry.upsample(geometry.find_moving(comparison))


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
def test_object_in_space_seen_free_is_moving(camera: Camera) -> None:
    now = with_box(wall(), 120, 1.5)
    mask = found(camera, now, [wall(), wall(), wall()])
    box = now < 2
    assert (mask & box).sum() > 0.95 * box.sum()
    assert (mask & ~box).sum() < 0.15 * box.sum()


@pytest.mark.parametrize(
    ("now", "before"),
    [
        (with_box(wall(), 120, 1.5), [with_box(wall(), 120, 1.5)] * 3),
        (wall(), [with_box(wall(), 120, 1.5)] * 3),
        (with_box(wall(), 120, 2.9), [wall()] * 3),
        (with_box(wall(), 120, 1.5), [wall(), *[with_box(wall(), 120, 1.5)] * 2]),
        (with_box(wall(), 120, 1.5), [wall(0.0)] * 3),
    ],
    ids=["static", "went away", "within noise", "one vote", "nothing known"],
)
def test_depth_without_free_space_violation_is_not_moving(now: Depth, before: list[Depth]) -> None:
    assert not found(CAMERA, now, before).any()


def boxes(*lefts: int) -> NDArray[np.bool_]:
    """Return the mask of boxes, a little wider than they are."""
    mask = np.zeros((240, 320), dtype=np.bool_)
    for left in lefts:
        mask[72:168, left - 8 : left + 88] = True
    return mask


def test_masked_static_object_is_told_from_a_new_one() -> None:
    before, geometry = with_box(wall(), 30, 1.5), FreeSpaceChecker(CAMERA)
    now = with_box(before, 200, 1.5)
    references = [ReferenceDepth(STILL, geometry.min_depth_grid(before))] * 3
    rests = geometry.static_components(boxes(30, 200), geometry.compare(now, STILL, references))
    np.testing.assert_array_equal(rests, boxes(30))
    blind = geometry.compare(np.zeros_like(now), STILL, references)
    assert not geometry.static_components(boxes(30, 200), blind).any(), "no depth, no verdict"


def test_mask_is_released_after_a_rest_and_moving_objects_are_added() -> None:
    geometry, box = FreeSpaceChecker(CAMERA), with_box(wall(), 30, 1.5)
    masks = DynamicMaskEstimator(geometry)
    seen = [
        keyframe(0, 10.0, geometry.min_depth_grid(box)),
        keyframe(1, 10.5, geometry.min_depth_grid(box)),
    ]

    def mask_at(t: float, depth: Depth) -> NDArray[np.bool_] | None:
        return masks.estimate(boxes(30), depth, STILL, seen, t)

    np.testing.assert_array_equal(mask_at(11.0, box), boxes(30))
    assert not np.any(mask_at(13.0, box))
    came = mask_at(13.0, with_box(box, 200, 1.5))
    assert came is not None
    assert came[90:150, 210:270].all()
    assert not came[:, :100].any()
    assert masks.estimate(None, wall(1.0), STILL, seen, 13.0) is None, (
        "all of it moves: the pose is wrong"
    )
    assert masks.estimate(None, box, STILL, seen, 13.0) is None


def keyframe(index: int, t: float, nearest: Depth) -> Keyframe:
    nothing = OrbExtractor(CAMERA, FeatureConfig(max_keypoints=10))(
        np.zeros((240, 320, 3), np.uint8), wall()
    )
    return Keyframe(
        index,
        t,
        STILL,
        nothing,
        np.zeros(0, dtype=np.int64),
        np.zeros((30, 40), np.float32),
        nearest,
    )


def test_person_at_rest_is_used_for_tracking_but_masked_for_observers(tmp_path: Path) -> None:
    """A board stays static under its mask for 3 s."""
    views = [render([*room(), passer_by(20)], T_wc) for T_wc in camera_path(16)]
    frames = [(rgb, depth, index / 5) for index, (rgb, depth, _) in enumerate(views)]
    slam, seen = Slam(CAMERA, slam_config(500)), []

    def observer(frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        mask = result.union_mask
        assert mask is not None
        assert result.dynamic_mask is not None
        board = views[round(5 * frame.timestamp)][2]
        seen.append((mask[board].mean(), result.dynamic_mask[board].mean()))

    track_sequence(
        slam,
        LiveCamera(CAMERA, frames),
        lambda frame: views[round(5 * frame.timestamp)][2],
        tmp_path / "pictures",
        [observer],
    )
    assert seen[0] == (1, 1)
    assert seen[-1] == (1, 0)


def test_static_scene_seen_by_a_moving_camera_is_not_moving() -> None:
    """Two views of the static room 20 cm apart; with a wrong pose parts would seem to move."""
    path = camera_path(40)
    first, second = (render(room(), path[k])[1] for k in (0, 15))
    geometry = FreeSpaceChecker(CAMERA)
    references = [ReferenceDepth(np.linalg.inv(path[0]), geometry.min_depth_grid(first))] * 2
    assert not geometry.find_moving(
        geometry.compare(second, np.linalg.inv(path[15]), references)
    ).any()


@given(st.floats(0, 319), st.floats(0, 239))
def test_distortion_inverts_undistortion(x: float, y: float) -> None:
    pixel = np.array([[x, y]])
    np.testing.assert_allclose(LENS.distort(LENS.undistort(pixel)), pixel, atol=1e-3)


def test_moving_point_loses_weight_and_regains_it_at_rest() -> None:
    world, ids = Map(CAMERA), np.array([0, 1])
    np.testing.assert_array_equal(world.static_odds.weight(ids), 1)
    weights = []
    for _ in range(5):
        world.static_odds.update(static=ids[1:], moving=ids[:1])
        weights.append(world.static_odds.weight(ids)[0])
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] < 0.02
    assert world.static_odds.weight(ids)[1] == 1
    for _ in range(100):
        world.static_odds.update(static=ids, moving=ids[:0])
    np.testing.assert_array_equal(world.static_odds.weight(ids), 1)


def test_merged_duplicate_keeps_its_motion_odds() -> None:
    """Two keypoints of a moving object became two points, of which one was found moving."""
    slam = Slam(CAMERA, slam_config(200))
    track(slam, *render(room(), STILL)[:2], 0.0)
    world = slam.map
    for moving in ([7, 12], [12]):
        world.static_odds.update(static=np.zeros(0, dtype=np.int64), moving=np.array(moving))
    caught = world.static_odds.weight(np.array([7, 12]))
    assert caught[1] < caught[0] < 1
    world.replace(np.array([7, 9, 11]), np.array([3, 12, 3]), world.keyframes)
    np.testing.assert_array_equal(world.static_odds.weight(np.array([3, 12, 4])), [*caught, 1])


def test_delayed_depth_is_moved_to_the_time_of_the_color_image() -> None:
    """The camera approaches the wall by 3 cm and turns before depth is taken."""
    lag = np.linalg.inv(exp_se3(np.array([0.01, 0.0, 0.03, 0.0, 0.02, 0.0])))
    rgb, depth, _ = render(room()[:1], STILL)
    late = render(room()[:1], np.linalg.inv(lag))[1]
    extract = OrbExtractor(CAMERA, FeatureConfig(max_keypoints=300))
    truth, told, untold = (
        extract(rgb, *rest).depths for rest in ((depth,), (late, None, lag), (late,))
    )
    assert np.nanmax(np.abs(told - truth)) < 0.002
    assert np.nanmedian(np.abs(untold - truth)) > 0.02


def test_motion_segmentation_reduces_the_error_by_a_passer_by() -> None:
    frames, stamps = 30, np.arange(30) / 30
    path = camera_path(frames)
    views = [render([*room(), passer_by(k)], path[k])[:2] for k in range(frames)]
    errors = []
    without = {"free_space__enabled": False, "motion_segmentation__enabled": False}
    for options in (without, {}):
        slam = Slam(CAMERA, slam_config(500, **options))
        for t, (rgb, depth) in zip(stamps, views, strict=True):
            track(slam, rgb, depth, float(t))
        errors.append(score(Trajectory(stamps, path), slam.trajectory())["ate_m"]["rmse"])
    assert errors[1] < 0.2 * errors[0]


def test_options_of_free_space_set_grid_and_tolerance() -> None:
    now = with_box(wall(), 120, 1.5)
    for config, is_found in (
        (FreeSpaceConfig(cell_px=16), True),
        (FreeSpaceConfig(cell_px=16, min_violation_m=2.0), False),
    ):
        checker = FreeSpaceChecker(CAMERA, config)
        references = [ReferenceDepth(STILL, checker.min_depth_grid(wall()))] * 3
        comparison = checker.compare(now, STILL, references)
        assert comparison.depth.shape == (15, 20)
        assert checker.find_moving(comparison).any() == is_found


def test_options_of_surfaces_reach_the_dynamic_mask() -> None:
    """A surface that must have more cells than the box covers never moves."""
    now = with_box(wall(), 120, 1.5)
    masks = []
    for surfaces in (SurfaceConfig(), SurfaceConfig(min_area=1000)):
        checker = FreeSpaceChecker(CAMERA, surfaces=surfaces)
        seen = [keyframe(k, float(k), checker.min_depth_grid(wall())) for k in range(3)]
        masks.append(DynamicMaskEstimator(checker).estimate(None, now, STILL, seen, 10.0))
    assert masks[0] is not None
    assert masks[1] is None
