"""Camera paths and walks: smooth, within their reach, and out of sight when they jump."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.synth.camera_motion import MOTIONS, camera_path, loop_heading
from cohdc_train.synth.walk_paths import (
    approach_camera,
    back_and_forth,
    cart_path,
    crowd,
    follow_camera,
    stop_and_go,
)

TIMES = np.arange(300) / 30


@pytest.mark.parametrize("motion", [motion for motion in MOTIONS if motion != "loop"])
def test_camera_moves_smoothly_about_the_eye(motion: str) -> None:
    eye = np.array([0.1, 0.9, 1.4])
    poses = camera_path(np.random.default_rng(1), TIMES, motion, eye)  # type: ignore[arg-type]
    rotations, offsets = poses[:, :3, :3], poses[:, :3, 3] - eye
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1], (300, 1)))
    speed = np.linalg.norm(np.diff(offsets, axis=0), axis=1) * 30
    turn = (
        np.arccos(np.clip((np.einsum("nij,nij->n", rotations[1:], rotations[:-1]) - 1) / 2, -1, 1))
        * 30
    )
    spread = offsets.max(axis=0) - offsets.min(axis=0)
    assert speed.max() < 0.9
    assert np.degrees(turn).max() < 60
    assert rotations[:, 1, 2].min() > 0.5, "looks along +y"
    assert rotations[:, 2, 1].max() < -0.5, "upright"
    lowest, highest = {
        "xyz": (0.4, 0.62),
        "halfsphere": (0.3, 1.1),
        "static": (0.001, 0.02),
        "rpy": (0.01, 0.06),
    }[motion]
    assert lowest < spread.max() < highest


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), people=st.integers(1, 4))
def test_crowd_walks_steadily_and_jumps_only_out_of_sight(seed: int, people: int) -> None:
    distances = 1.2 + 0.35 * np.arange(people)
    ways = crowd(np.random.default_rng(seed), TIMES, distances, 0.85)
    assert len(ways) == people
    for way, distance in zip(ways, distances, strict=True):
        assert way.position.shape == (300, 2)
        assert way.heading.shape == way.distance_walked.shape == way.pace.shape == (300,)
        step = np.linalg.norm(np.diff(way.position, axis=0), axis=1)
        jumps = np.flatnonzero(step > 1.3 / 30)
        assert len(jumps) <= 3
        for k in (*jumps, *(jumps + 1)):
            assert abs(way.position[k, 0]) > 0.62 * distance + 0.7, "out of sight of a still camera"
        assert np.all(np.diff(way.distance_walked) >= 0)
        assert np.diff(way.distance_walked).max() < 1.3 / 30
        assert np.abs(way.position[:, 1] - distance).max() < 0.1
        velocity = np.diff(way.position, axis=0)
        walking = (step > 0.005) & (step < 1.3 / 30)
        ahead = np.stack([np.cos(way.heading[1:]), np.sin(way.heading[1:])], 1)
        forward = np.einsum("ni,ni->n", ahead, velocity) > 0
        assert forward[walking].mean() > 0.98, "all but the first step after a turn out of sight"
    apart = [
        np.linalg.norm(a.position - b.position, axis=1).min()
        for i, a in enumerate(ways)
        for b in ways[:i]
    ]
    assert all(gap > 0.15 for gap in apart)


def angle(first: np.ndarray, second: np.ndarray) -> float:
    """Return the degrees between two rotations."""
    return float(np.degrees(np.arccos(np.clip((np.trace(first.T @ second) - 1) / 2, -1, 1))))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_loop_turns_all_round_and_ends_where_it_began(seed: int) -> None:
    times = np.arange(400) / 30
    eye = np.array([0.0, 3.5, 1.4])
    poses = camera_path(np.random.default_rng(seed), times, "loop", eye)
    rotations, places = poses[:, :3, :3], poses[:, :3, 3]
    assert np.linalg.norm(places[-1] - places[0]) < 0.12
    assert angle(rotations[0], rotations[-1]) < 8
    for heading in np.radians([0, 90, 180, 270]):
        ahead = np.array([np.sin(heading), np.cos(heading), 0])
        assert (rotations[:, :, 2] @ ahead).max() > 0.95, "every wall is looked at"
    assert np.linalg.norm(places[200] - places[0]) > 1, "it walks, too"
    assert (np.linalg.norm(np.diff(places, axis=0), axis=1) * 30).max() < 0.8
    assert (
        max(angle(a, b) for a, b in zip(rotations[:-1:9], rotations[1::9], strict=False)) * 30 < 80
    )
    back = np.linalg.norm(places - places[-1], axis=1) < 0.15
    assert back[-40:].all(), "time enough to notice"


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), people=st.integers(1, 4))
def test_crowd_following_camera_keeps_its_distance(seed: int, people: int) -> None:
    rng = np.random.default_rng(seed)
    eyes = camera_path(rng, TIMES, "loop", np.zeros(3))[:, :2, 3]
    ways = crowd(rng, TIMES, 1.2 + 0.35 * np.arange(people), 0.75)
    for before, after in zip(
        ways, follow_camera(ways, TIMES, eyes, loop_heading(TIMES)), strict=True
    ):
        np.testing.assert_allclose(
            np.linalg.norm(after.position - eyes, axis=1), before.position[:, 1]
        )
        assert (
            np.linalg.norm(after.position, axis=1).max() < 0.7 + 0.3 + before.position[:, 1].max()
        )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), people=st.integers(1, 4))
def test_people_stop_for_seconds_in_the_view_and_walk_on(seed: int, people: int) -> None:
    distances = 1.2 + 0.35 * np.arange(people)
    for way, distance in zip(
        stop_and_go(np.random.default_rng(seed), TIMES, distances), distances, strict=True
    ):
        velocity = np.diff(way.position, axis=0) * 30
        speed = np.linalg.norm(velocity, axis=1)
        stands = np.split(speed == 0, np.flatnonzero(np.diff(speed == 0)) + 1)
        longest = max(len(stretch) for stretch in stands if stretch[0])
        assert longest >= 1.1 * 30, "without any movement"
        assert speed.max() > 0.5
        assert speed.max() < 1
        assert np.all(way.pace[1:][speed == 0] == 0)
        assert np.all(np.abs(way.position[:, 0]) < 0.5 * distance), (
            "never out of sight of a still camera"
        )
        ahead = np.stack([np.cos(way.heading[1:]), np.sin(way.heading[1:])], 1)
        fast = speed > 0.4
        assert np.einsum("ni,ni->n", ahead, velocity)[fast].min() > 0.3, "they look where they walk"
        assert np.abs(np.diff(way.heading)).max() * 30 < np.radians(300), "and turn before"


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_cart_moves_back_and_forth_with_pusher_behind(seed: int) -> None:
    rng = np.random.default_rng(seed)
    line = back_and_forth(rng, TIMES, 1.2, (0.5, 1.0), 0.7)
    cart, pusher = cart_path(rng, TIMES, line, -1.0)
    assert np.all(line[:10] == line[0]), "at rest in the beginning"
    assert np.ptp(line) > 1.2
    assert line.max() <= 1.2
    assert line.min() >= -1.2
    ahead = np.array([np.cos(cart.heading[0]), np.sin(cart.heading[0])])
    np.testing.assert_allclose(cart.position - pusher.position, np.tile(ahead, (300, 1)), atol=1e-9)
    np.testing.assert_allclose(
        np.diff(pusher.distance_walked), np.diff(cart.position, axis=0) @ ahead, atol=1e-9
    )


def test_approaching_person_stays_before_moving_camera() -> None:
    poses = camera_path(np.random.default_rng(3), TIMES, "xyz", np.zeros(3))
    way = approach_camera(TIMES, poses)
    offset = way.position - poses[:, :2, 3]
    near = slice(int(0.43 * 300), int(0.63 * 300))
    assert np.all(np.linalg.norm(offset[near], axis=1) < 0.6)
    assert np.linalg.norm(offset[0]) > 1.5
    assert np.linalg.norm(offset[-1]) > 1.5
    assert np.ptp(poses[near, :3, 3], axis=0).max() > 0.1, "though the camera moves"
