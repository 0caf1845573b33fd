"""Clusters of points that move against the static world."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA

from cohdc_train.slam.dynamics.motion_segmentation import estimate_static_pose, find_moving_cluster
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.reprojection import Observations, ReprojectionModel

REPROJECTION = ReprojectionModel(CAMERA)
IDENTITY = np.eye(4)


def scene(seed: int, shift: float) -> tuple[Array, Observations, NDArray[np.bool_]]:
    """Return 300 points of a wall at 3 to 4 m and 40 of a cart at 1 m that has moved by `shift` m.

    Returns points [340, 3], their measurements, and [340] bool, True = cart.
    """
    rng = np.random.default_rng(seed)
    far = rng.uniform([-1.8, -1.3, 3.0], [1.8, 1.3, 4.0], (300, 3))
    near = rng.uniform([-0.4, 0.0, 0.9], [0.0, 0.35, 1.1], (40, 3))
    points, cart = np.concatenate([far, near]), np.arange(340) >= 300
    local = points + cart[:, None] * np.array([shift, 0, 0])
    pixels = CAMERA.project(local) + rng.normal(0, 0.5, (340, 2))
    depths = local[:, 2] + rng.normal(0, 0.003, 340) * local[:, 2] ** 2
    return points, Observations(pixels, depths, np.ones(340), np.ones(340)), cart


def test_motion_of_3_cm_is_found_in_nearly_every_scene() -> None:
    """At this limit of the noise it was found in 1494 of 1500 scenes, from 3.5 cm on in all."""
    found = 0
    for seed in range(200):
        points, seen, cart = scene(seed, 0.03)
        moving = estimate_static_pose(IDENTITY, points, seen, REPROJECTION, np.full(340, 9))[2]
        assert moving[~cart].mean() < 0.02
        found += moving[cart].mean() > 0.9
    assert found >= 198


@given(st.integers(0, 10_000), st.floats(0.035, 0.06))
def test_slowly_moving_near_object_is_segmented(seed: int, shift: float) -> None:
    points, seen, cart = scene(seed, shift)
    dragged, inlier = optimize_pose(IDENTITY, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > shift, (
        "the cart drags the pose along, farther than it moved"
    )
    assert inlier[~cart].mean() > 0.8, "no residual shows it"
    tracks = np.full(340, 9)
    pose, inlier, moving = estimate_static_pose(IDENTITY, points, seen, REPROJECTION, tracks)
    assert moving[cart].mean() > 0.9
    assert moving[~cart].mean() < 0.02
    assert not (inlier & moving).any()
    assert np.linalg.norm(pose[:3, 3]) < 0.015


@given(st.integers(0, 10_000), st.floats(0.04, 0.09))
def test_nine_near_points_do_not_drag_the_pose(seed: int, shift: float) -> None:
    """Nine points of a person that the mask missed; 300 far points fit a pose wrong by cm."""
    points, seen, cart = scene(seed, shift)
    points, seen, cart = points[:309], seen.take(np.arange(309)), cart[:309]
    dragged, _ = optimize_pose(IDENTITY, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > 0.5 * shift
    pose, _, moving = estimate_static_pose(IDENTITY, points, seen, REPROJECTION, np.full(309, 9))
    assert moving[cart].mean() > 0.8
    assert np.linalg.norm(pose[:3, 3]) < 0.015


@given(st.integers(0, 10_000))
def test_static_scene_has_no_moving_cluster(seed: int) -> None:
    points, seen, _ = scene(seed, 0.0)
    pose, _ = optimize_pose(IDENTITY, points, seen, REPROJECTION)
    assert not find_moving_cluster(pose, points, seen, REPROJECTION, np.full(340, 9)).any()


@given(st.integers(0, 10_000), st.floats(0.06, 0.09))
def test_cluster_with_longer_tracks_is_the_static_world(seed: int, shift: float) -> None:
    """A near person holds three quarters of the points, but with short tracks."""
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
    dragged, _ = optimize_pose(IDENTITY, points, seen, REPROJECTION)
    assert np.linalg.norm(dragged[:3, 3]) > 0.5 * shift, "most points are the person's"
    pose, _, moving = estimate_static_pose(
        IDENTITY, points, seen, REPROJECTION, np.where(walks, 5, 100)
    )
    assert np.linalg.norm(pose[:3, 3]) < 0.5 * shift
    assert moving[walks].mean() > 0.9
    followed, _, _ = estimate_static_pose(IDENTITY, points, seen, REPROJECTION, np.full(400, 5))
    assert np.linalg.norm(followed[:3, 3]) > 0.5 * shift, (
        "with equal tracks the larger cluster is the world"
    )


def test_few_points_have_no_moving_cluster() -> None:
    points, seen, _ = scene(0, 0.02)
    assert not find_moving_cluster(
        IDENTITY, points[-20:], seen.take(np.arange(320, 340)), REPROJECTION, np.full(20, 9)
    ).any()
