"""Movers as whole surfaces that go on moving: known answers on coarse images, and who comes up to
the camera.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from plane_world import CAMERA, Rectangle, camera_path, render, room, texture
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cohdc_train.slam.dynamics.moving_surfaces import (
    JUMP,
    Bits,
    MovingSurfaceTracker,
    label_surfaces,
)
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

SHAPE = (30, 40)
NOWHERE = np.zeros(SHAPE, dtype=np.bool_)
EVERYWHERE = ~NOWHERE


def block(rows: slice, columns: slice) -> Bits:
    bits = NOWHERE.copy()
    bits[rows, columns] = True
    return bits


PERSON = block(slice(10, 25), slice(10, 20))
HALF, THIRD = block(slice(10, 18), slice(10, 20)), block(slice(10, 15), slice(10, 20))


def scene(person: Bits = PERSON, depth: float = 1.0) -> NDArray[np.float32]:
    """Somebody before a wall 3 m away."""
    return np.where(person, depth, 3.0).astype(np.float32)


def test_of_a_surface_that_is_found_by_half_all_moves_and_nothing_else() -> None:
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(0.0, HALF, NOWHERE, NOWHERE, scene(), NOWHERE), PERSON
    )


def test_of_one_that_is_found_by_less_or_was_just_seen_there_only_that_moves() -> None:
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(0.0, THIRD, NOWHERE, NOWHERE, scene(), NOWHERE), THIRD
    )
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(0.0, HALF, HALF, NOWHERE, scene(), NOWHERE), HALF
    )


def test_what_moved_goes_on_though_nothing_finds_it_until_it_was_seen_at_rest() -> None:
    movers = MovingSurfaceTracker()
    movers.update(0.0, HALF, NOWHERE, NOWHERE, scene(), NOWHERE)
    for step in range(1, 6):
        image = scene(np.roll(PERSON, step, axis=1), 1.0 - 0.1 * step)
        moved = movers.update(0.0, NOWHERE, EVERYWHERE & (image > 2), NOWHERE, image, NOWHERE)
        np.testing.assert_array_equal(moved, image < 2)
    there = image < 2
    np.testing.assert_array_equal(
        movers.update(0.0, NOWHERE, EVERYWHERE, NOWHERE, image, NOWHERE), there
    )
    assert not movers.update(0.0, NOWHERE, EVERYWHERE, EVERYWHERE, image, NOWHERE).any()


def test_what_nothing_finds_nor_masks_goes_on_for_half_a_second() -> None:
    movers, trace = MovingSurfaceTracker(), block(slice(10, 12), slice(10, 14))
    movers.update(0.0, HALF, NOWHERE, NOWHERE, scene(), NOWHERE)
    for t in (0.4, 0.8, 1.2):
        np.testing.assert_array_equal(
            movers.update(t, trace, EVERYWHERE, NOWHERE, scene(), NOWHERE), PERSON
        )
    np.testing.assert_array_equal(
        movers.update(1.6, NOWHERE, EVERYWHERE, NOWHERE, scene(), NOWHERE), PERSON
    )
    assert not movers.update(2.0, NOWHERE, EVERYWHERE, NOWHERE, scene(), NOWHERE).any()


def test_a_frame_without_depth_says_nothing() -> None:
    movers = MovingSurfaceTracker()
    movers.update(0.0, HALF, NOWHERE, NOWHERE, scene(), NOWHERE)
    assert not movers.update(0.1, NOWHERE, NOWHERE, NOWHERE, scene() * 0, NOWHERE).any()
    np.testing.assert_array_equal(
        movers.update(0.2, NOWHERE, EVERYWHERE, NOWHERE, scene(), NOWHERE), PERSON
    )


def test_a_mask_of_one_frame_is_not_remembered() -> None:
    movers, wall = MovingSurfaceTracker(), block(slice(0, 30), slice(5, 35))
    movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(NOWHERE), NOWHERE)
    movers.update(0.1, NOWHERE, NOWHERE, NOWHERE, scene(NOWHERE), wall)
    assert not movers.update(0.2, NOWHERE, NOWHERE, NOWHERE, scene(NOWHERE), NOWHERE).any()


def test_who_comes_after_in_the_same_place_does_not_move_for_it() -> None:
    movers = MovingSurfaceTracker()
    movers.update(0.0, PERSON, NOWHERE, NOWHERE, scene(), NOWHERE)
    assert not movers.update(
        0.0, NOWHERE, NOWHERE, NOWHERE, scene(depth=1.0 + 2 * JUMP), NOWHERE
    ).any()


def test_whom_a_mask_covered_goes_on_where_the_next_one_misses_him() -> None:
    movers, wide = MovingSurfaceTracker(), block(slice(7, 28), slice(7, 23))
    assert not movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(), wide).any(), (
        "he is in the mask already"
    )
    np.testing.assert_array_equal(
        movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(), THIRD), PERSON & ~THIRD
    )
    np.testing.assert_array_equal(
        movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(), NOWHERE), PERSON
    )


def test_a_wall_that_comes_out_from_under_the_edge_of_a_mask_stands_still() -> None:
    """Between the picture's edge and somebody who walks away from it; masks reach 3 px beyond him."""
    movers = MovingSurfaceTracker()
    for step in range(12):
        person, wide = (
            block(slice(0, 30), slice(max(step - more, 0), step + 10 + more)) for more in (0, 3)
        )
        assert not movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(person), wide).any()


def test_a_floor_is_no_part_of_who_is_masked_on_it() -> None:
    floor = block(slice(25, 28), slice(0, 40))
    found = PERSON | block(slice(25, 28), slice(0, 10))
    wanted = found & ~PERSON
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(0.0, found, NOWHERE, NOWHERE, scene(PERSON | floor), PERSON),
        wanted,
    )


def test_what_is_forgotten_moves_no_longer() -> None:
    movers = MovingSurfaceTracker()
    movers.update(0.0, PERSON, NOWHERE, NOWHERE, scene(), NOWHERE)
    movers.reset()
    assert not movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(), NOWHERE).any()


def test_the_floor_that_feet_stand_on_is_not_taken_along() -> None:
    """A floor joins the person; a keyframe of half a second ago has seen most of it, but not what
    comes into view.
    """
    movers, floor = MovingSurfaceTracker(), block(slice(25, 28), slice(0, 40))
    movers.update(0.0, PERSON, NOWHERE, NOWHERE, scene(), NOWHERE)
    image = scene(PERSON | floor)
    seen = floor.copy()
    seen[:, 35:] = False
    np.testing.assert_array_equal(
        movers.update(0.0, NOWHERE, seen, NOWHERE, image, NOWHERE), PERSON | (floor & ~seen)
    )


def test_where_everything_seems_to_move_the_pose_is_wrong_and_nothing_does() -> None:
    movers = MovingSurfaceTracker()
    assert not movers.update(0.0, EVERYWHERE, NOWHERE, NOWHERE, scene(), NOWHERE).any()
    assert not movers.update(0.0, NOWHERE, NOWHERE, NOWHERE, scene(), NOWHERE).any(), "nor later"


def test_where_nothing_is_known_nothing_moves() -> None:
    assert (
        not MovingSurfaceTracker()
        .update(0.0, NOWHERE, NOWHERE, NOWHERE, np.zeros(SHAPE, dtype=np.float32), NOWHERE)
        .any()
    )


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 8), st.integers(1, 8)),
        elements=st.sampled_from([0.0, 1.0, 1.1, 1.3]),
    )
)
def test_surfaces_are_what_is_joined_without_a_jump(image: NDArray[np.float32]) -> None:
    number = np.arange(image.size).reshape(image.shape)
    pairs = [(number[1:], number[:-1]), (number[:, 1:], number[:, :-1])]
    first, second = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    depth = image.ravel()
    joined = (
        (depth[first] > 0) & (depth[second] > 0) & (np.abs(depth[first] - depth[second]) < JUMP)
    )
    links = coo_matrix(
        (np.ones(joined.sum()), (first[joined], second[joined])), (image.size, image.size)
    )
    _, wanted = connected_components(links, directed=False)
    labels = label_surfaces(image).ravel()
    np.testing.assert_array_equal(labels > 0, depth > 0)
    known = depth > 0
    same = labels[known][:, None] == labels[known][None]
    np.testing.assert_array_equal(same, wanted[known][:, None] == wanted[known][None])


def comer(index: int) -> Rectangle:
    """A board that comes from the left, up to the camera, stands before it for a second, and leaves
    to the right.
    """
    near = np.clip((index - 20) / 40, 0, 1)
    left = -0.3 - 0.1 * max(20 - index, 0) + 0.05 * max(index - 90, 0)
    edges = np.array([0.6, 0, 0]), np.array([0, 1.2, 0])
    board = texture(np.random.default_rng(3), 300, 140, 400)
    return Rectangle(np.array([left, -0.5, 2.0 - 1.1 * near]), *edges, board, moving=True)


def test_who_comes_up_to_the_camera_does_not_take_it_along() -> None:
    """He fills up to two thirds of the picture, and his edge is all that moves while he stands
    there.
    """
    path, stamps = camera_path(110), np.arange(110) / 30
    tracker, covered = Tracker(CAMERA, features=500), []
    for index, (t, pose) in enumerate(zip(stamps, path, strict=True)):
        rgb, depth, board = render([*room(), comer(index)], pose)
        tracker.track(rgb, depth, float(t))
        if 20 <= index < 90:
            assert tracker.mask is not None
            covered.append(tracker.mask[board].mean())
    found = Trajectory(*tracker.trajectory())
    assert len(found) == len(path)
    assert score(Trajectory(stamps, path), found)["ate_m"]["rmse"] < 0.01
    assert np.mean(covered) > 0.98
    assert min(covered) > 0.8


@pytest.mark.parametrize("frames", [1, 4])
def test_a_false_mask_does_not_lose_a_robot_that_turns(frames: int) -> None:
    """In a round room, whose wall is one surface of which no keyframe is two seconds old, at 45
    degrees a second.
    """
    rng, keypoints = np.random.default_rng(0), np.linspace(0, 2 * np.pi, 17)
    places = 2 * np.stack([np.sin(keypoints), -np.ones(17), np.cos(keypoints)], axis=1)
    wall = [
        Rectangle(a, b - a, np.array([0, 4.0, 0]), texture(rng, 800, 200, 500))
        for a, b in pairwise(places)
    ]
    tracker, most = Tracker(CAMERA, features=500), np.zeros((240, 320), dtype=np.bool_)
    most[:, 40:280] = True
    for k in range(60):
        turned = exp_se3(np.array([0, 0, 0, 0, np.deg2rad(1.5) * k, 0]))
        rgb, depth, _ = render(wall, turned)
        pose = tracker.track(rgb, depth, k / 30, most if 20 <= k < 20 + frames else most & False)
        assert pose.tracked, k
    assert tracker.mask is not None
    assert not tracker.mask.any()
