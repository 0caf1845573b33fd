"""Camera paths and walks: smooth, within their reach, out of sight when they jump."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.synth.motion import MOTIONS, camera_path, walk

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
@given(seed=st.integers(0, 10_000), usual=st.sampled_from([-1.0, 1.0]))
def test_people_walk_steadily_and_jump_only_out_of_sight(seed: int, usual: float) -> None:
    way = walk(np.random.default_rng(seed), TIMES, (1.2, 1.6), usual, 0.85, 0.3)
    assert way.position.shape == (300, 2)
    assert way.heading.shape == way.travelled.shape == way.pace.shape == (300,)
    step = np.linalg.norm(np.diff(way.position, axis=0), axis=1)
    jumps = np.flatnonzero(step > 1.2 / 30)
    for k in jumps:
        assert abs(way.position[k, 0]) > 0.62 * 1.2 + 0.5
        assert abs(way.position[k + 1, 0]) > 0.62 * 1.2 + 0.5
    assert np.delete(step, jumps).max() < 1.0 / 30
    assert np.all(np.diff(way.travelled) >= 0)
    assert np.all((way.position[:, 1] >= 1.2 - 1e-6) & (way.position[:, 1] <= 1.6 + 1e-6))
    forward = np.diff(way.position[:, 0])
    walking = (step > 0.01) & (step < 1.2 / 30)
    np.testing.assert_array_equal(np.sign(forward[walking]), np.sign(np.cos(way.heading[:-1][walking])))
