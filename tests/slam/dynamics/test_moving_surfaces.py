"""Moving surfaces: small depth grids with known results, and a board that approaches the camera."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from plane_world import CAMERA, Rectangle, camera_path, render, room, slam_config, texture, track
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cohdc_train.slam.config import SurfaceConfig
from cohdc_train.slam.dynamics.moving_surfaces import (
    BoolGrid,
    DepthGrid,
    MovingSurfaceTracker,
    SurfaceEvidence,
    label_surfaces,
)
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

SHAPE = (30, 40)
NOWHERE = np.zeros(SHAPE, dtype=np.bool_)
EVERYWHERE = ~NOWHERE
JUMP = SurfaceConfig().depth_jump_m


def block(rows: slice, columns: slice) -> BoolGrid:
    """Return a grid that is True in a rectangle."""
    cells = NOWHERE.copy()
    cells[rows, columns] = True
    return cells


PERSON = block(slice(10, 25), slice(10, 20))
HALF, THIRD = block(slice(10, 18), slice(10, 20)), block(slice(10, 15), slice(10, 20))


def scene(person: BoolGrid = PERSON, depth: float = 1.0) -> DepthGrid:
    """Return the depth of a person in front of a wall 3 m away."""
    return np.where(person, depth, 3.0).astype(np.float32)


def evidence(depth: DepthGrid | None = None, **cells: BoolGrid) -> SurfaceEvidence:
    """Make the evidence of a frame; what is not given is True nowhere."""
    names = ("moving", "static_recently", "static_long", "masked")
    given = {name: cells.get(name, NOWHERE) for name in names}
    return SurfaceEvidence(scene() if depth is None else depth, **given)


def test_surface_that_moves_by_half_moves_as_a_whole() -> None:
    np.testing.assert_array_equal(MovingSurfaceTracker().update(0.0, evidence(moving=HALF)), PERSON)


def test_surface_with_less_motion_or_recent_rest_is_not_extended() -> None:
    np.testing.assert_array_equal(MovingSurfaceTracker().update(0.0, evidence(moving=THIRD)), THIRD)
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(0.0, evidence(moving=HALF, static_recently=HALF)), HALF
    )


def test_moving_surface_continues_until_it_is_seen_at_rest() -> None:
    surfaces = MovingSurfaceTracker()
    surfaces.update(0.0, evidence(moving=HALF))
    for step in range(1, 6):
        image = scene(np.roll(PERSON, step, axis=1), 1.0 - 0.1 * step)
        moved = surfaces.update(0.0, evidence(depth=image, static_recently=image > 2))
        np.testing.assert_array_equal(moved, image < 2)
    there = image < 2
    np.testing.assert_array_equal(
        surfaces.update(0.0, evidence(depth=image, static_recently=EVERYWHERE)), there
    )
    at_rest = evidence(depth=image, static_recently=EVERYWHERE, static_long=EVERYWHERE)
    assert not surfaces.update(0.0, at_rest).any()


def test_moving_surface_without_evidence_continues_for_half_a_second() -> None:
    surfaces, trace = MovingSurfaceTracker(), block(slice(10, 12), slice(10, 14))
    surfaces.update(0.0, evidence(moving=HALF))
    for t in (0.4, 0.8, 1.2):
        np.testing.assert_array_equal(
            surfaces.update(t, evidence(moving=trace, static_recently=EVERYWHERE)), PERSON
        )
    np.testing.assert_array_equal(
        surfaces.update(1.6, evidence(static_recently=EVERYWHERE)), PERSON
    )
    assert not surfaces.update(2.0, evidence(static_recently=EVERYWHERE)).any()


def test_frame_without_depth_changes_nothing() -> None:
    surfaces = MovingSurfaceTracker()
    surfaces.update(0.0, evidence(moving=HALF))
    assert not surfaces.update(0.1, evidence(depth=scene() * 0)).any()
    np.testing.assert_array_equal(
        surfaces.update(0.2, evidence(static_recently=EVERYWHERE)), PERSON
    )


def test_mask_of_a_single_frame_is_not_remembered() -> None:
    surfaces, wall = MovingSurfaceTracker(), block(slice(0, 30), slice(5, 35))
    surfaces.update(0.0, evidence(depth=scene(NOWHERE)))
    surfaces.update(0.1, evidence(depth=scene(NOWHERE), masked=wall))
    assert not surfaces.update(0.2, evidence(depth=scene(NOWHERE))).any()


def test_motion_is_not_passed_on_to_another_depth() -> None:
    surfaces = MovingSurfaceTracker()
    surfaces.update(0.0, evidence(moving=PERSON))
    assert not surfaces.update(0.0, evidence(depth=scene(depth=1.0 + 2 * JUMP))).any()


def test_masked_person_continues_to_move_where_the_next_mask_misses_him() -> None:
    surfaces, wide = MovingSurfaceTracker(), block(slice(7, 28), slice(7, 23))
    assert not surfaces.update(0.0, evidence(masked=wide)).any(), (
        "the person is in the mask already"
    )
    np.testing.assert_array_equal(surfaces.update(0.0, evidence(masked=THIRD)), PERSON & ~THIRD)
    np.testing.assert_array_equal(surfaces.update(0.0, evidence()), PERSON)


def test_wall_uncovered_by_a_mask_is_static() -> None:
    """A person walks away from the image border; masks reach 3 px beyond the person."""
    surfaces = MovingSurfaceTracker()
    for step in range(12):
        person, wide = (
            block(slice(0, 30), slice(max(step - more, 0), step + 10 + more)) for more in (0, 3)
        )
        assert not surfaces.update(0.0, evidence(depth=scene(person), masked=wide)).any()


def test_floor_is_no_part_of_a_masked_person_on_it() -> None:
    floor = block(slice(25, 28), slice(0, 40))
    found = PERSON | block(slice(25, 28), slice(0, 10))
    wanted = found & ~PERSON
    np.testing.assert_array_equal(
        MovingSurfaceTracker().update(
            0.0, evidence(depth=scene(PERSON | floor), moving=found, masked=PERSON)
        ),
        wanted,
    )


def test_reset_forgets_moving_surfaces() -> None:
    surfaces = MovingSurfaceTracker()
    surfaces.update(0.0, evidence(moving=PERSON))
    surfaces.reset()
    assert not surfaces.update(0.0, evidence()).any()


def test_floor_that_joins_a_moving_person_stays_static() -> None:
    """A keyframe of half a second ago has seen most of the floor, but not what came into view."""
    surfaces, floor = MovingSurfaceTracker(), block(slice(25, 28), slice(0, 40))
    surfaces.update(0.0, evidence(moving=PERSON))
    image = scene(PERSON | floor)
    seen = floor.copy()
    seen[:, 35:] = False
    np.testing.assert_array_equal(
        surfaces.update(0.0, evidence(depth=image, static_recently=seen)), PERSON | (floor & ~seen)
    )


def test_motion_of_nearly_all_cells_is_rejected_as_a_wrong_pose() -> None:
    surfaces = MovingSurfaceTracker()
    assert not surfaces.update(0.0, evidence(moving=EVERYWHERE)).any()
    assert not surfaces.update(0.0, evidence()).any(), "nor later"


def test_frame_without_any_depth_has_no_motion() -> None:
    assert (
        not MovingSurfaceTracker()
        .update(0.0, evidence(depth=np.zeros(SHAPE, dtype=np.float32)))
        .any()
    )


@given(
    arrays(
        np.float32,
        st.tuples(st.integers(1, 8), st.integers(1, 8)),
        elements=st.sampled_from([0.0, 1.0, 1.1, 1.3]),
    )
)
def test_surfaces_are_connected_without_depth_jumps(image: NDArray[np.float32]) -> None:
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
    labels = label_surfaces(image, JUMP).ravel()
    np.testing.assert_array_equal(labels > 0, depth > 0)
    known = depth > 0
    same = labels[known][:, None] == labels[known][None]
    np.testing.assert_array_equal(same, wanted[known][:, None] == wanted[known][None])


def approaching_board(index: int) -> Rectangle:
    """Return a board that comes from the left, stands near the camera for 1 s, and leaves."""
    near = np.clip((index - 20) / 40, 0, 1)
    left = -0.3 - 0.1 * max(20 - index, 0) + 0.05 * max(index - 90, 0)
    edges = np.array([0.6, 0, 0]), np.array([0, 1.2, 0])
    board = texture(np.random.default_rng(3), 300, 140, 400)
    return Rectangle(np.array([left, -0.5, 2.0 - 1.1 * near]), *edges, board, moving=True)


def test_object_that_approaches_the_camera_does_not_drag_the_pose() -> None:
    """The board fills up to two thirds of the image; while it stands, only its edge moves."""
    path, timestamps = camera_path(110), np.arange(110) / 30
    slam, covered = Slam(CAMERA, slam_config(500)), []
    for index, (timestamp, pose) in enumerate(zip(timestamps, path, strict=True)):
        rgb, depth, board = render([*room(), approaching_board(index)], pose)
        result = track(slam, rgb, depth, float(timestamp))
        if 20 <= index < 90:
            assert result.dynamic_mask is not None
            covered.append(result.dynamic_mask[board].mean())
    estimate = slam.trajectory()
    assert len(estimate) == len(path)
    assert score(Trajectory(timestamps, path), estimate)["ate_m"]["rmse"] < 0.01
    assert np.mean(covered) > 0.98
    assert min(covered) > 0.8


@pytest.mark.parametrize("num_masked_frames", [1, 4])
def test_tracking_survives_a_false_mask_while_the_camera_turns(num_masked_frames: int) -> None:
    """The wall of a round room is one surface; the camera turns at 45 degrees per second."""
    rng, angles = np.random.default_rng(0), np.linspace(0, 2 * np.pi, 17)
    corners = 2 * np.stack([np.sin(angles), -np.ones(17), np.cos(angles)], axis=1)
    wall = [
        Rectangle(a, b - a, np.array([0, 4.0, 0]), texture(rng, 800, 200, 500))
        for a, b in pairwise(corners)
    ]
    slam, nothing = Slam(CAMERA, slam_config(500)), np.zeros((240, 320), dtype=np.bool_)
    false_mask = nothing.copy()
    false_mask[:, 40:280] = True
    for k in range(60):
        T_wc = exp_se3(np.array([0, 0, 0, 0, np.deg2rad(1.5) * k, 0]))
        rgb, depth, _ = render(wall, T_wc)
        mask = false_mask if 20 <= k < 20 + num_masked_frames else nothing
        result = track(slam, rgb, depth, k / 30, mask)
        assert result.is_tracked, k
    assert result.dynamic_mask is not None
    assert not result.dynamic_mask.any()
