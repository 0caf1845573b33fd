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


def walk(
    rng: np.random.Generator, times: Doubles, distances: tuple[float, float], usual: float, reach: float, start: float
) -> Walk:
    """A person who crosses the view again and again, slowly, now and then stopping.

    times: [n] s, even steps; distances: nearest and farthest way in front of the eye, m; usual: +1 or -1, the direction
    of five crossings in six (a crowd that moves one way is what misleads a camera); reach: how far beyond the border of
    the view a crossing begins and ends, m; start: the part 0..1 of the first crossing that is over at the beginning.
    Between two crossings the person is out of sight.
    """
    step = float(times[1] - times[0])
    pieces: list[Doubles] = []
    headings: list[Doubles] = []
    missing = len(times)
    while missing > 0:
        direction = usual if rng.random() < 5 / 6 else -usual
        path = _crossing(rng, step, direction, distances, reach)
        if not pieces:
            path = path[int(len(path) * start) :]
        velocity = np.gradient(path, axis=0)
        moving = np.abs(velocity[:, 0]) > 1e-4
        angle = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), 0.0 if direction > 0 else np.pi)
        pieces.append(path[:missing])
        headings.append(angle[:missing])
        missing -= len(path)
    offsets = np.concatenate(pieces)
    steps = np.linalg.norm(np.diff(offsets, axis=0, prepend=offsets[:1]), axis=1)
    steps[steps > 1.2 * step] = 0.0  # from the end of a crossing to the start of the next, out of sight
    pace = np.clip(steps / step / 0.5, 0, 1.15)
    return Walk(offsets, np.concatenate(headings), np.cumsum(steps), pace)


def _crossing(
    rng: np.random.Generator, step: float, direction: float, distances: tuple[float, float], reach: float
) -> Doubles:
    """[k, 2] offsets from the eye on one way through the view, at even time steps."""
    start, end = rng.uniform(*distances, 2)
    half = 0.62 * max(start, end) + reach
    pace = rng.uniform(0.45, 0.85)
    stop = rng.uniform(-0.4, 0.4) * min(start, end)
    pause = rng.uniform(0.8, 1.6) if rng.random() < 0.4 else 0.0
    first, last = (stop + half) / pace, (half - stop) / pace
    duration = first + pause + last
    t = np.arange(0, duration, step)
    x = np.interp(t, [0, first, first + pause, duration], [-half, stop, stop, half])
    window = max(round(0.35 / step), 1) | 1
    x = np.convolve(np.pad(x, window // 2, mode="edge"), np.ones(window) / window, mode="valid")
    y = start + (end - start) * (x + half) / (2 * half)
    return np.stack([direction * x, y], 1)
