"""Paths of people and objects in a sequence.

World frame: z up, y away from the camera; m, s, rad.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cohdc_train.synth.camera_motion import sway
from cohdc_train.types import FloatArray, IntArray

_SMOOTH = 0.35  # s over which a pace changes
_TURN = 0.8  # s that a turn on the spot takes
_NEAR = 0.55  # m from the camera to the axis of a body that fills its view


@dataclass(frozen=True)
class Walk:
    """Path of one person or object.

    Attributes:
        position: [n, 2] m.
        heading: [n] rad.
        distance_walked: [n] m.
        pace: [n] 0 = stands, 1 = walks.
    """

    position: FloatArray
    heading: FloatArray
    distance_walked: FloatArray
    pace: FloatArray

    def shifted(self, x: float, y: float) -> "Walk":
        """Return the path shifted by `x` and `y` m."""
        return replace(self, position=self.position + np.array([x, y]))


def crowd(
    rng: np.random.Generator, times: FloatArray, distances: FloatArray, reach: float
) -> tuple[Walk, ...]:
    """Draw people who cross the view side by side, slowly, mostly in one direction, with a stop.

    Between two crossings nobody is in sight. A group that moves as one and covers half the view
    misleads a camera that trusts the majority. Positions are relative to the eye.

    Args:
        rng: random numbers.
        times: [n] s, even steps.
        distances: [p] m, of each person before the eye.
        reach: how far beyond the border of the view a crossing begins and ends, m.
    """
    step = float(times[1] - times[0])
    sides = (
        0.3
        * distances
        * rng.permutation(np.linspace(-1, 1, len(distances)) if len(distances) > 1 else np.zeros(1))
    )
    half = float(np.max(0.62 * distances + np.abs(sides))) + reach
    usual = float(rng.choice([-1.0, 1.0]))
    pieces: list[FloatArray] = []
    while sum(len(piece) for piece in pieces) < len(times):
        direction = usual if rng.random() < 5 / 6 else -usual
        path = direction * _crossing(rng, step, half)
        pieces.append(path if pieces else path[int(len(path) * rng.uniform(0.3, 0.4)) :])
    jumps = np.cumsum([len(piece) for piece in pieces])
    line = np.concatenate(pieces)[: len(times)]
    return tuple(
        _walk_in_crowd(rng, times, line, (float(d), float(side)), jumps[jumps < len(times)])
        for d, side in zip(distances, sides, strict=True)
    )


def _walk_in_crowd(
    rng: np.random.Generator,
    times: FloatArray,
    line: FloatArray,
    place: tuple[float, float],
    jumps: IntArray,
) -> Walk:
    """Draw the path of one person in a crowd.

    Args:
        rng: random numbers.
        times: [n] s.
        line: [n] m, path of the middle of the crowd.
        place: (distance, side) m, of this person in it.
        jumps: frames at which the crowd is put elsewhere.
    """
    x = line + place[1] + sway(rng, times, 0.06, 4.0)
    y = place[0] + sway(rng, times, 0.08, 6.0)
    return walk_along(times, np.stack([x, y], 1), float(rng.uniform(0, 1.4)), jumps)


def walk_along(
    times: FloatArray, position: FloatArray, start: float, jumps: IntArray | None = None
) -> Walk:
    """Return a person who walks where `position` [n, 2] m leads, looking ahead.

    Args:
        times: [n] s.
        position: [n, 2] m.
        start: m walked before.
        jumps: frames at which the person is put elsewhere and continues as before.
    """
    velocity = np.diff(position, axis=0, prepend=position[:1])
    if jumps is not None:
        velocity[jumps] = velocity[jumps - 1]
    velocity[0] = velocity[min(1, len(position) - 1)]
    speed = np.linalg.norm(velocity, axis=1)
    pace = np.clip(speed / float(times[1] - times[0]) / 0.4, 0, 1.15)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    return Walk(position, heading, start + np.cumsum(speed), pace)


def _crossing(rng: np.random.Generator, step: float, half: float) -> FloatArray:
    """Draw [k] m from -half to half at even time steps, with a stop near the middle."""
    pace = rng.uniform(0.5, 0.75)
    stop = rng.uniform(-0.25, 0.25)
    pause = rng.uniform(0.7, 1.5)
    first, last = (stop + half) / pace, (half - stop) / pace
    duration = first + pause + last
    x = np.interp(
        np.arange(0, duration, step), [0, first, first + pause, duration], [-half, stop, stop, half]
    )
    return _smooth(x, _SMOOTH / step)


def _smooth(line: FloatArray, frames: float) -> FloatArray:
    """Return the moving mean of [n] values over `frames`."""
    window = max(round(frames), 1) | 1
    smooth: FloatArray = np.convolve(
        np.pad(line, window // 2, mode="edge"), np.ones(window) / window, mode="valid"
    )
    return smooth


def follow_camera(
    walks: tuple[Walk, ...], times: FloatArray, eyes: FloatArray, headings: FloatArray
) -> tuple[Walk, ...]:
    """Bend the walks of a crowd into arcs about the eye, and turn them with the camera.

    Distance ahead and to the side of the eye become a distance and an angle, so that people who
    walk round the room with the camera, crossing its view, never meet a wall.

    Args:
        walks: of the crowd.
        times: [n] s.
        eyes: [n, 2] m.
        headings: [n] rad to the right of +y, of the camera.
    """
    bent = []
    for walk in walks:
        distance = walk.position[:, 1]
        angle = headings + walk.position[:, 0] / distance
        position = eyes + distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], 1)
        bent.append(walk_along(times, position, float(walk.distance_walked[0])))
    return tuple(bent)


def back_and_forth(
    rng: np.random.Generator,
    times: FloatArray,
    reach: float,
    pause: tuple[float, float],
    pace: float,
) -> FloatArray:
    """Draw the positions [n], m, of an object that moves within +-reach, and stands between.

    It begins at rest. Every move leads to the other side of 0.

    Args:
        rng: random numbers.
        times: [n] s.
        reach: m.
        pause: shortest and longest, s.
        pace: m/s.
    """
    knots = list(_waypoints(rng, float(times[-1]), reach, pause, pace))
    line = np.interp(times, [t for t, _ in knots], [x for _, x in knots])
    return _smooth(line, _SMOOTH / float(times[1] - times[0]))


def _waypoints(
    rng: np.random.Generator, until: float, reach: float, pause: tuple[float, float], pace: float
) -> Iterator[tuple[float, float]]:
    """Yield (s, m) at which the pace changes, the first at 0 s, the last after `until`."""
    t, x = 0.0, float(rng.choice([-1.0, 1.0]) * reach * rng.uniform(0.5, 1))
    while t <= until:
        yield t, x
        t += float(rng.uniform(*pause))
        yield t, x
        target = -float(np.sign(x)) * reach * float(rng.uniform(0.5, 1))
        t, x = t + abs(target - x) / pace, target
    yield t, x


def cart_path(
    rng: np.random.Generator, times: FloatArray, line: FloatArray, behind: float
) -> tuple[Walk, Walk]:
    """Draw the path of a cart that moves back and forth along a slanted line, and of its pusher.

    Positions are relative to the middle of the line.

    Args:
        rng: random numbers.
        times: [n] s.
        line: [n] m, along the line.
        behind: x of the pusher in the frame of the cart, m.
    """
    slant = float(rng.uniform(-0.25, 0.25))
    heading = slant + np.pi * float(rng.integers(2))
    position = line[:, None] * np.array([np.cos(slant), np.sin(slant)])
    ahead = np.array([np.cos(heading), np.sin(heading)])
    gone = (position - position[0]) @ ahead
    pace = np.clip(
        np.abs(np.diff(gone, prepend=gone[0])) / float(times[1] - times[0]) / 0.4, 0, 1.15
    )
    cart = Walk(position, np.full(len(times), heading), gone, pace)
    return cart, replace(cart, position=position + behind * ahead)


def stop_and_go(
    rng: np.random.Generator, times: FloatArray, distances: FloatArray
) -> tuple[Walk, ...]:
    """Draw people who stand in the view for 1.5-2.5 s, walk on and stand again.

    Each stops at a time of their own. Arguments and frame are those of `crowd`.
    """
    walks = []
    for distance in distances:
        line = back_and_forth(
            rng, times, 0.42 * float(distance), (1.5, 2.5), float(rng.uniform(0.6, 0.8))
        )
        walk = walk_along(
            times, np.stack([line, np.full_like(line, distance)], 1), float(rng.uniform(0, 1.4))
        )
        walks.append(replace(walk, heading=_turn_headings(times, line)))
    return tuple(walks)


def _turn_headings(times: FloatArray, line: FloatArray) -> FloatArray:
    """Return [n] rad: 0 while `line` [n] m rises, pi while it falls.

    A turn is complete when the motion begins.
    """
    lead = round(_TURN / 2 / float(times[1] - times[0]))
    ways = np.sign(np.diff(line, append=line[-1]))
    moving = np.flatnonzero(ways)
    if not len(moving):
        return np.zeros_like(line)
    latest = np.searchsorted(moving, np.arange(lead, lead + len(line)), side="right") - 1
    return _smooth(np.where(ways[moving[np.maximum(latest, 0)]] > 0, 0.0, np.pi), 2 * lead)


def approach_camera(times: FloatArray, poses: FloatArray) -> Walk:
    """Return a person who comes up to the camera, stays before it wherever it moves, and leaves.

    The person stays for 3 tenths of the time. World frame.

    Args:
        times: [n] s.
        poses: [n, 4, 4] T_wc of the camera.
    """
    t = times / times[-1]
    step = float(times[1] - times[0])
    away = _smooth(
        np.interp(t, [0, 0.15, 0.38, 0.68, 0.95, 1], [1.8, 1.8, _NEAR, _NEAR, 2.0, 2.0]),
        _SMOOTH / step,
    )
    aside = _smooth(
        np.interp(t, [0, 0.15, 0.38, 0.68, 0.95], [-0.5, -0.5, 0.0, 0.0, 0.7]), _SMOOTH / step
    )
    forward = poses[:, :2, 2] / np.linalg.norm(poses[:, :2, 2], axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0]], 1)
    walk = walk_along(
        times, poses[:, :2, 3] + away[:, None] * forward + aside[:, None] * right, 0.0
    )
    azimuth = np.arctan2(forward[:, 1], forward[:, 0])
    return replace(walk, heading=azimuth + np.interp(t, [0.66, 0.76], [np.pi, 0.0]))
