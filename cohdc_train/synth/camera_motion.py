"""Camera paths of sequences. World frame: z up, y away from the camera, m, s, rad."""

from typing import Literal, get_args

import numpy as np

from cohdc_train.types import FloatArray

CameraMotion = Literal["xyz", "halfsphere", "static", "rpy", "loop"]
MOTIONS: tuple[str, ...] = get_args(CameraMotion)
_LOOP_RADIUS = 0.7  # m
_LOOP_START, _LOOP_END = 0.03, 0.9  # shares of the time between which the camera turns
# Optical axes (right, down, forward) as columns, looking at +y.
_LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def sway(
    rng: np.random.Generator, times: FloatArray, amplitude: float, period: float
) -> FloatArray:
    """Return a smooth swing that begins anywhere in its cycle: a slow sine and a small fast one."""
    first, second = rng.uniform(0, 2 * np.pi, 2)
    period = period * rng.uniform(0.9, 1.1)
    slow, fast = 2 * np.pi / period, 2 * np.pi / (0.37 * period)
    swing: FloatArray = amplitude * (
        0.9 * np.sin(slow * times + first) + 0.1 * np.sin(fast * times + second)
    )
    return swing


def camera_path(
    rng: np.random.Generator, times: FloatArray, motion: CameraMotion, eye: FloatArray
) -> FloatArray:
    """Return T_wc, [n, 4, 4], of a moving camera: TUM's four hand motions, and a loop in the room.

    xyz: +-0.3 m along each axis, angles within 3 degrees. halfsphere: half a sphere of 0.5 m
    radius, looking at its front. static: the tremor of a hand. rpy: +-15 degrees about each axis,
    nearly without translation. loop: once round a circle of 0.7 m radius about `eye`, looking
    outwards, back at its beginning for the last tenth of the time.

    Args:
        rng: random numbers.
        times: [n], s.
        motion: kind of the motion.
        eye: [3], m, center of the motion.
    """
    reach = {"xyz": 0.3, "halfsphere": 0.03, "static": 0.004, "rpy": 0.02, "loop": 0.03}[motion]
    angle = {"xyz": 3.0, "halfsphere": 2.0, "static": 0.3, "rpy": 15.0, "loop": 2.0}[motion]
    shift = np.stack([sway(rng, times, reach, period) for period in (5.1, 6.7, 5.9)], 1)
    turn = np.stack([sway(rng, times, np.radians(angle), period) for period in (6.1, 5.3, 7.3)], 1)
    if motion == "halfsphere":
        azimuth = sway(rng, times, np.radians(55), 8.0)
        elevation = np.radians(30) + sway(rng, times, np.radians(25), 5.0)
        flat = np.cos(elevation)
        ball = np.stack([np.sin(azimuth) * flat, -np.cos(azimuth) * flat, np.sin(elevation)], 1)
        shift = shift + 0.5 * (ball - np.array([0, -1, 0.5]))
        turn[:, 1] -= np.arctan2(shift[:, 0], 3.0)
        turn[:, 0] -= np.arctan2(shift[:, 2], 3.0)
    if motion == "loop":
        ahead = loop_heading(times)
        turn[:, 1] += ahead
        shift += _LOOP_RADIUS * np.stack([np.sin(ahead), np.cos(ahead), np.zeros_like(ahead)], 1)
    tremor = np.stack([sway(rng, times, 0.0015, period) for period in (0.7, 0.9, 0.8)], 1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = _LEVEL @ _euler(turn + np.array([-np.radians(8), 0, 0]))
    poses[:, :3, 3] = eye + shift + tremor
    return poses


def loop_heading(times: FloatArray) -> FloatArray:
    """Return [n] angles, rad, to the right of +y that the camera of a loop has turned to.

    They rise from 0 to 2 pi, slowly at both ends.
    """
    done = np.clip((times / times[-1] - _LOOP_START) / (_LOOP_END - _LOOP_START), 0, 1)
    turned: FloatArray = 2 * np.pi * done - 0.6 * np.sin(2 * np.pi * done)
    return turned


def _euler(angles: FloatArray) -> FloatArray:
    """Return rotations [n, 3, 3] by angles [n, 3] about the camera's x (pitch), y and z (roll)."""
    from scipy.spatial.transform import Rotation

    matrices: FloatArray = Rotation.from_euler("yxz", angles[:, [1, 0, 2]]).as_matrix()
    return matrices
