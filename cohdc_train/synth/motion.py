"""How the camera moves and how people walk in a sequence. World frame: z up, y away from the camera, m, s, rad."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
CameraMotion = Literal["xyz", "halfsphere", "static", "rpy"]
MOTIONS: tuple[str, ...] = get_args(CameraMotion)
_LEVEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # optical axes (right, down, forward) as columns, looking at +y


def _sway(rng: np.random.Generator, times: Doubles, amplitude: float, period: float) -> Doubles:
    """A smooth swing that starts anywhere in its cycle: two sines, the second small and faster."""
    first, second = rng.uniform(0, 2 * np.pi, 2)
    period = period * rng.uniform(0.9, 1.1)
    slow, fast = 2 * np.pi / period, 2 * np.pi / (0.37 * period)
    swing: Doubles = amplitude * (0.9 * np.sin(slow * times + first) + 0.1 * np.sin(fast * times + second))
    return swing


def camera_path(rng: np.random.Generator, times: Doubles, motion: CameraMotion, eye: Doubles) -> Doubles:
    """[n, 4, 4] T_wc at `times` [n] s, about `eye` [3] m: TUM's four hand motions.

    xyz: +-0.3 m along each axis, angles within 3 degrees; halfsphere: half a sphere of 0.5 m radius, looking at its
    front; static: a hand's tremor; rpy: +-15 degrees about each axis almost on the spot.
    """
    reach = {"xyz": 0.3, "halfsphere": 0.03, "static": 0.004, "rpy": 0.02}[motion]
    angle = {"xyz": 3.0, "halfsphere": 2.0, "static": 0.3, "rpy": 15.0}[motion]
    shift = np.stack([_sway(rng, times, reach, period) for period in (5.1, 6.7, 5.9)], 1)
    turn = np.stack([_sway(rng, times, np.radians(angle), period) for period in (6.1, 5.3, 7.3)], 1)
    if motion == "halfsphere":
        azimuth, elevation = (
            _sway(rng, times, np.radians(55), 8.0),
            np.radians(30) + _sway(rng, times, np.radians(25), 5.0),
        )
        ball = np.stack(
            [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], 1
        )
        shift = shift + 0.5 * (ball - np.array([0, -1, 0.5]))
        turn[:, 1] -= np.arctan2(shift[:, 0], 3.0)
        turn[:, 0] -= np.arctan2(shift[:, 2], 3.0)
    tremor = np.stack([_sway(rng, times, 0.0015, period) for period in (0.7, 0.9, 0.8)], 1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = _LEVEL @ _euler(turn + np.array([-np.radians(8), 0, 0]))
    poses[:, :3, 3] = eye + shift + tremor
    return poses


def _euler(angles: Doubles) -> Doubles:
    """[n, 3, 3] rotations by angles [n, 3] about the camera's x (pitch), y (yaw) and z (roll)."""
    from scipy.spatial.transform import Rotation

    matrices: Doubles = Rotation.from_euler("yxz", angles[:, [1, 0, 2]]).as_matrix()
    return matrices


@dataclass(frozen=True)
class Walk:
    """One person's way.

    position: [n, 2] m from the eye; heading: [n] rad; travelled: [n] m; pace: [n] 0 = stands, 1 = walks.
    """

    position: Doubles
    heading: Doubles
    travelled: Doubles
    pace: Doubles


def crowd(rng: np.random.Generator, times: Doubles, distances: Doubles, reach: float) -> tuple[Walk, ...]:
    """People who cross the view side by side, again and again, slowly, mostly in one direction, stopping midway.

    times: [n] s, even steps; distances: [p] m, how far in front of the eye each one walks; reach: how far beyond the
    border of the view a crossing begins and ends, m. Between two crossings nobody is in sight. A group that moves as
    one and covers half the view is what misleads a camera that trusts the majority.
    """
    step = float(times[1] - times[0])
    sides = 0.3 * distances * rng.permutation(np.linspace(-1, 1, len(distances)) if len(distances) > 1 else np.zeros(1))
    half = float(np.max(0.62 * distances + np.abs(sides))) + reach
    usual = float(rng.choice([-1.0, 1.0]))
    pieces: list[Doubles] = []
    while sum(len(piece) for piece in pieces) < len(times):
        direction = usual if rng.random() < 5 / 6 else -usual
        path = direction * _crossing(rng, step, half)
        pieces.append(path if pieces else path[int(len(path) * rng.uniform(0.3, 0.4)) :])
    jumps = np.cumsum([len(piece) for piece in pieces])
    line = np.concatenate(pieces)[: len(times)]
    return tuple(
        _walk(rng, times, line, (float(d), float(side)), jumps[jumps < len(times)])
        for d, side in zip(distances, sides, strict=True)
    )


def _walk(
    rng: np.random.Generator, times: Doubles, line: Doubles, place: tuple[float, float], jumps: NDArray[np.int64]
) -> Walk:
    """One of a crowd: `line` [n] m is the way of its middle, `place` (distance, side) m this person's place in it."""
    step = float(times[1] - times[0])
    x = line + place[1] + _sway(rng, times, 0.06, 4.0)
    y = place[0] + _sway(rng, times, 0.08, 6.0)
    velocity = np.stack([np.diff(x, prepend=x[0]), np.diff(y, prepend=y[0])], 1)
    velocity[jumps] = velocity[jumps - 1]
    velocity[0] = velocity[min(1, len(x) - 1)]
    speed = np.linalg.norm(velocity, axis=1)
    pace = np.clip(speed / step / 0.4, 0, 1.15)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    gone = rng.uniform(0, 1.4) + np.cumsum(speed)
    return Walk(np.stack([x, y], 1), heading, gone, pace)


def _crossing(rng: np.random.Generator, step: float, half: float) -> Doubles:
    """[k] m from -half to half at even time steps, with a stop near the middle."""
    pace = rng.uniform(0.5, 0.75)
    stop = rng.uniform(-0.25, 0.25)
    pause = rng.uniform(0.7, 1.5)
    first, last = (stop + half) / pace, (half - stop) / pace
    duration = first + pause + last
    x = np.interp(np.arange(0, duration, step), [0, first, first + pause, duration], [-half, stop, stop, half])
    window = max(round(0.35 / step), 1) | 1
    smooth: Doubles = np.convolve(np.pad(x, window // 2, mode="edge"), np.ones(window) / window, mode="valid")
    return smooth
