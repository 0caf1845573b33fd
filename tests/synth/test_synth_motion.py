"""Camera paths and walks: smooth, within their reach, out of sight when they jump."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.synth.motion import MOTIONS, camera_path, crowd

TIMES = np.arange(300) / 30


@pytest.mark.parametrize("motion", MOTIONS)
def test_camera_moves_smoothly_about_the_eye(motion: str) -> None:
    eye = np.array([0.1, 0.9, 1.4])
    poses = camera_path(np.random.default_rng(1), TIMES, motion, eye)  # type: ignore[arg-type]
    rotations, offsets = poses[:, :3, :3], poses[:, :3, 3] - eye
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
    np.testing.assert_array_equal(poses[:, 3], np.tile([0, 0, 0, 1], (300, 1)))
    speed = np.linalg.norm(np.diff(offsets, axis=0), axis=1) * 30
    turn = np.arccos(np.clip((np.einsum("nij,nij->n", rotations[1:], rotations[:-1]) - 1) / 2, -1, 1)) * 30
    spread = offsets.max(axis=0) - offsets.min(axis=0)
    assert speed.max() < 0.9
    assert np.degrees(turn).max() < 60
    assert rotations[:, 1, 2].min() > 0.5, "looks along +y"
    assert rotations[:, 2, 1].max() < -0.5, "upright"
    lowest, highest = {"xyz": (0.4, 0.62), "halfsphere": (0.3, 1.1), "static": (0.001, 0.02), "rpy": (0.01, 0.06)}[
        motion
    ]
    assert lowest < spread.max() < highest


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), people=st.integers(1, 4))
def test_a_crowd_walks_steadily_and_jumps_only_out_of_sight(seed: int, people: int) -> None:
    distances = 1.2 + 0.35 * np.arange(people)
    ways = crowd(np.random.default_rng(seed), TIMES, distances, 0.85)
    assert len(ways) == people
    for way, distance in zip(ways, distances, strict=True):
        assert way.position.shape == (300, 2)
        assert way.heading.shape == way.travelled.shape == way.pace.shape == (300,)
        step = np.linalg.norm(np.diff(way.position, axis=0), axis=1)
        jumps = np.flatnonzero(step > 1.3 / 30)
        assert len(jumps) <= 3
        for k in (*jumps, *(jumps + 1)):
            assert abs(way.position[k, 0]) > 0.62 * distance + 0.7, "out of sight of a still camera"
        assert np.all(np.diff(way.travelled) >= 0)
        assert np.diff(way.travelled).max() < 1.3 / 30
        assert np.abs(way.position[:, 1] - distance).max() < 0.1
        velocity = np.diff(way.position, axis=0)
        walking = (step > 0.005) & (step < 1.3 / 30)
        ahead = np.stack([np.cos(way.heading[1:]), np.sin(way.heading[1:])], 1)
        forward = np.einsum("ni,ni->n", ahead, velocity) > 0
        assert forward[walking].mean() > 0.98, "all but the first step after a turn out of sight"
    apart = [np.linalg.norm(a.position - b.position, axis=1).min() for i, a in enumerate(ways) for b in ways[:i]]
    assert all(gap > 0.15 for gap in apart)
