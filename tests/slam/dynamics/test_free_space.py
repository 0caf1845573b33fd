"""What moves without a mask: by depth, by groups of points, and what the tracker makes of both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, passer_by, render, room

from cohdc_train.slam.config import Method
from cohdc_train.slam.dynamics.dynamic_mask import DynamicMaskEstimator
from cohdc_train.slam.dynamics.free_space import FreeSpaceChecker, ReferenceDepth
from cohdc_train.slam.dynamics.motion_segmentation import estimate_static_pose, find_moving_cluster
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameRecord, View
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, exp_se3
from cohdc_train.slam.io.live import LiveCamera
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel
from cohdc_train.slam.runner import play
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

REPROJECTION = ReprojectionModel(CAMERA)
LENS = replace(CAMERA, k1=0.2624, k2=-0.9531, p1=-0.0054, p2=0.0026, k3=1.1633)
STILL = np.eye(4)
Depth = NDArray[np.float32]


def wall(depth: float = 3.0) -> Depth:
    return np.full((240, 320), depth, dtype=np.float32)


def with_box(image: Depth, left: int, depth: float) -> Depth:
    """A box of 80 x 80 px before it."""
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
def test_what_stands_where_keyframes_looked_through_moves(camera: Camera) -> None:
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
    ids=["stands still", "went away", "within noise", "one vote", "nothing known"],
)
def test_what_says_nothing_of_movement_is_left_alone(now: Depth, before: list[Depth]) -> None:
    assert not found(CAMERA, now, before).any()


def boxes(*lefts: int) -> NDArray[np.bool_]:
    """Masks of boxes, a little wider than they are."""
    mask = np.zeros((240, 320), dtype=np.bool_)
    for left in lefts:
        mask[72:168, left - 8 : left + 88] = True
    return mask


def test_a_masked_thing_that_has_stood_still_is_told_from_one_that_came() -> None:
    before, geometry = with_box(wall(), 30, 1.5), FreeSpaceChecker(CAMERA)
    now = with_box(before, 200, 1.5)
    references = [ReferenceDepth(STILL, geometry.min_depth_grid(before))] * 3
    rests = geometry.static_components(boxes(30, 200), geometry.compare(now, STILL, references))
    np.testing.assert_array_equal(rests, boxes(30))
    blind = geometry.compare(np.zeros_like(now), STILL, references)
    assert not geometry.static_components(boxes(30, 200), blind).any(), "no depth, no verdict"


def test_a_mask_is_released_only_after_a_rest_and_movers_join_it() -> None:
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
    nothing = OrbExtractor(CAMERA, 10)(np.zeros((240, 320, 3), np.uint8), wall())
    return Keyframe(
        index,
        t,
        STILL,
        nothing,
        np.zeros(0, dtype=np.int64),
        np.zeros((30, 40), np.float32),
        nearest,
    )


def test_who_is_at_rest_is_of_use_to_tracking_but_stays_masked_to_watchers(tmp_path: Path) -> None:
    """A board that stands still under its mask for 3 s."""
    views = [render([*room(), passer_by(20)], T_wc) for T_wc in camera_path(16)]
    frames = [(rgb, depth, index / 5) for index, (rgb, depth, _) in enumerate(views)]
    tracker, seen = Tracker(CAMERA, features=500), []

    def observer(
        view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        assert mask is not None
        assert tracker.mask is not None
        board = views[round(5 * view.t)][2]
        seen.append((mask[board].mean(), tracker.mask[board].mean()))

    play(
        tracker,
        LiveCamera(CAMERA, frames),
        lambda view: views[round(5 * view.t)][2],
        tmp_path / "pictures",
        [observer],
    )
    assert seen[0] == (1, 1)
    assert seen[-1] == (1, 0)


def test_the_camera_may_move() -> None:
    """Two views of the still room 20 cm apart: nothing moves; with a wrong pose something would
    seem to.
    """
    path = camera_path(40)
    first, second = (render(room(), path[k])[1] for k in (0, 15))
    geometry = FreeSpaceChecker(CAMERA)
    references = [ReferenceDepth(np.linalg.inv(path[0]), geometry.min_depth_grid(first))] * 2
    assert not geometry.find_moving(
        geometry.compare(second, np.linalg.inv(path[15]), references)
    ).any()


@given(st.floats(0, 319), st.floats(0, 239))
def test_the_lens_bends_back(x: float, y: float) -> None:
    pixel = np.array([[x, y]])
    np.testing.assert_allclose(LENS.distort(LENS.undistort(pixel)), pixel, atol=1e-3)


def scene(seed: int, shift: float) -> tuple[Array, Observations, NDArray[np.bool_]]:
    """300 points of shelves 3 to 4 m away and 40 of a cart at 1 m that has rolled by `shift` m
    since it was mapped.
    """
    rng = np.random.default_rng(seed)
    far = rng.uniform([-1.8, -1.3, 3.0], [1.8, 1.3, 4.0], (300, 3))
    near = rng.uniform([-0.4, 0.0, 0.9], [0.0, 0.35, 1.1], (40, 3))
    points, cart = np.concatenate([far, near]), np.arange(340) >= 300
    local = points + cart[:, None] * np.array([shift, 0, 0])
    pixels = CAMERA.project(local) + rng.normal(0, 0.5, (340, 2))
    depths = local[:, 2] + rng.normal(0, 0.003, 340) * local[:, 2] ** 2
    return points, Observations(pixels, depths, np.ones(340), np.ones(340)), cart


def test_three_centimetres_tell_it_in_nearly_every_world() -> None:
    """At the edge of what noise allows: 1494 of 1500 worlds; from 3.5 cm on there is none that
    misses it.
    """
    found = 0
    for seed in range(200):
        points, seen, cart = scene(seed, 0.03)
        moving = estimate_static_pose(STILL, points, seen, REPROJECTION, np.full(340, 9))[2]
        assert moving[~cart].mean() < 0.02
        found += moving[cart].mean() > 0.9
    assert found >= 198


@given(st.integers(0, 10_000), st.floats(0.035, 0.06))
def test_a_near_thing_that_rolls_a_little_is_told_from_the_world(seed: int, shift: float) -> None:
    points, seen, cart = scene(seed, shift)
    dragged, inlier = optimize_pose(STILL, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > shift, (
        "the cart takes the pose along, and further than it went"
    )
    assert inlier[~cart].mean() > 0.8, "and no residual shows it"
    pose, inlier, moving = estimate_static_pose(STILL, points, seen, REPROJECTION, np.full(340, 9))
    assert moving[cart].mean() > 0.9
    assert moving[~cart].mean() < 0.02
    assert not (inlier & moving).any()
    assert np.linalg.norm(pose[:3, 3]) < 0.015


@given(st.integers(0, 10_000), st.floats(0.04, 0.09))
def test_nine_near_points_do_not_take_the_pose_along(seed: int, shift: float) -> None:
    """What a mask has missed of a passer-by, before 300 far points that agree with a pose wrong by
    centimetres.
    """
    points, seen, cart = scene(seed, shift)
    points, seen, cart = points[:309], seen.take(np.arange(309)), cart[:309]
    dragged, _ = optimize_pose(STILL, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > 0.5 * shift
    pose, _, moving = estimate_static_pose(STILL, points, seen, REPROJECTION, np.full(309, 9))
    assert moving[cart].mean() > 0.8
    assert np.linalg.norm(pose[:3, 3]) < 0.015


@given(st.integers(0, 10_000))
def test_a_world_that_stands_still_has_no_group_that_moves(seed: int) -> None:
    points, seen, _ = scene(seed, 0.0)
    pose, _ = optimize_pose(STILL, points, seen, REPROJECTION)
    assert not find_moving_cluster(pose, points, seen, REPROJECTION, np.full(340, 9)).any()


@given(st.integers(0, 10_000), st.floats(0.06, 0.09))
def test_of_two_groups_the_one_that_is_long_known_is_the_world(seed: int, shift: float) -> None:
    """A person close by holds three quarters of the points, but few frames have found them."""
    rng = np.random.default_rng(seed)
    wall = rng.uniform([-1.8, -1.3, 3.0], [1.8, 1.3, 4.0], (100, 3))
    person = rng.uniform([-0.4, -0.6, 0.9], [0.3, 0.6, 1.2], (300, 3))
    points, walks = np.concatenate([wall, person]), np.arange(400) >= 100
    local = points + walks[:, None] * np.array([shift, 0, 0])
    pixels = CAMERA.project(local) + rng.normal(0, 0.5, (400, 2))
    seen = Observations(
        pixels,
        local[:, 2] + rng.normal(0, 0.003, 400) * local[:, 2] ** 2,
        np.ones(400),
        np.ones(400),
    )
    dragged, _ = optimize_pose(STILL, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > 0.5 * shift, "most points are the person's"
    pose, _, moving = estimate_static_pose(
        STILL, points, seen, REPROJECTION, np.where(walks, 5, 100)
    )
    assert np.linalg.norm(pose[:3, 3]) < 0.5 * shift
    assert moving[walks].mean() > 0.9
    followed, _, _ = estimate_static_pose(STILL, points, seen, REPROJECTION, np.full(400, 5))
    assert np.linalg.norm(followed[:3, 3]) > 0.5 * shift, (
        "of points that are as long known the most are the world"
    )


def test_few_points_are_not_judged() -> None:
    points, seen, _ = scene(0, 0.02)
    assert not find_moving_cluster(
        STILL, points[-20:], seen.take(np.arange(320, 340)), REPROJECTION, np.full(20, 9)
    ).any()


def test_a_point_that_moves_with_its_group_loses_weight_and_may_earn_it_again() -> None:
    world, ids = Map(CAMERA), np.array([0, 1])
    np.testing.assert_array_equal(world.trust(ids), 1)
    weights = []
    for _ in range(5):
        world.update_static_odds(still=ids[1:], moving=ids[:1])
        weights.append(world.trust(ids)[0])
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] < 0.02
    assert world.trust(ids)[1] == 1
    for _ in range(100):
        world.update_static_odds(still=ids, moving=ids[:0])
    np.testing.assert_array_equal(world.trust(ids), 1)


def test_what_is_known_of_a_duplicate_stays_known_when_it_is_joined() -> None:
    """Two corners of a mover, seen as two points, of which one has been caught moving."""
    tracker = Tracker(CAMERA, features=200)
    tracker.track(*render(room(), STILL)[:2], 0.0)
    world = tracker.map
    for moving in ([7, 12], [12]):
        world.update_static_odds(still=np.zeros(0, dtype=np.int64), moving=np.array(moving))
    caught = world.trust(np.array([7, 12]))
    assert caught[1] < caught[0] < 1
    world.replace(np.array([7, 9, 11]), np.array([3, 12, 3]), world.keyframes)
    np.testing.assert_array_equal(world.trust(np.array([3, 12, 4])), [*caught, 1])


def test_depth_that_comes_late_is_carried_back() -> None:
    """The camera nears the wall by 3 cm before depth is taken, and turns."""
    lag = np.linalg.inv(exp_se3(np.array([0.01, 0.0, 0.03, 0.0, 0.02, 0.0])))
    rgb, depth, _ = render(room()[:1], STILL)
    late = render(room()[:1], np.linalg.inv(lag))[1]
    extract = OrbExtractor(CAMERA, 300)
    truth, told, untold = (
        extract(rgb, *rest).depths for rest in ((depth,), (late, None, lag), (late,))
    )
    assert np.nanmax(np.abs(told - truth)) < 0.002
    assert np.nanmedian(np.abs(untold - truth)) > 0.02


def test_a_passer_by_spoils_less_without_any_mask() -> None:
    frames, stamps = 30, np.arange(30) / 30
    path = camera_path(frames)
    views = [render([*room(), passer_by(k)], path[k])[:2] for k in range(frames)]
    errors = []
    for method in (Method(geometry=False, static_weights=False), Method()):
        tracker = Tracker(CAMERA, features=500, method=method)
        for t, (rgb, depth) in zip(stamps, views, strict=True):
            tracker.track(rgb, depth, float(t))
        errors.append(
            score(Trajectory(stamps, path), Trajectory(*tracker.trajectory()))["ate_m"]["rmse"]
        )
    assert errors[1] < 0.2 * errors[0]
