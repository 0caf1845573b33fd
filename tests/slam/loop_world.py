"""Room of four walls that a camera circles, with a sensor so noisy that tracking drifts."""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from plane_world import CAMERA, Rectangle, render, texture

View = tuple[NDArray[np.uint8], NDArray[np.float32]]
_HALF = 3.6  # m from the center to a wall
_RADIUS = 2.3  # m, of the camera's circle


@cache
def hall(seed: int = 3) -> list[Rectangle]:
    """Return four walls around the origin, each with its own texture."""
    rng = np.random.default_rng(seed)
    walls = []
    for turn in np.arange(4) * np.pi / 2:
        ahead = np.array([np.sin(turn), 0.0, np.cos(turn)])
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        corner = _HALF * (ahead - right) + np.array([0.0, -1.4, 0.0])
        walls.append(
            Rectangle(
                corner,
                2 * _HALF * right,
                np.array([0.0, 2.8, 0.0]),
                texture(rng, 460, 1200, 4800),
            )
        )
    return walls


def way_round(frames: int, turns: float = 1.1) -> NDArray[np.float64]:
    """Return poses [frames, 4, 4] T_wc of a camera that moves in a circle and looks outward.

    The first pose has no rotation.
    """
    angle = np.linspace(0, turns * 2 * np.pi, frames)
    T_wc = np.tile(np.eye(4), (frames, 1, 1))
    T_wc[:, 0, 0], T_wc[:, 0, 2] = np.cos(angle), np.sin(angle)
    T_wc[:, 2, 0], T_wc[:, 2, 2] = -np.sin(angle), np.cos(angle)
    T_wc[:, 0, 3], T_wc[:, 2, 3] = _RADIUS * np.sin(angle), _RADIUS * np.cos(angle)
    T_wc[:, 1, 3] = 0.05 * np.sin(3 * angle)
    return T_wc


def poor_view(T_wc: NDArray[np.float64], rng: np.random.Generator) -> View:
    """Render the hall with a noisy sensor.

    The standard deviation is 5 gray levels, and 3 mm of depth at 1 m, growing with its square.
    """
    rgb, depth, _ = render(hall(), T_wc, CAMERA)
    noisy = np.clip(rgb + 5 * rng.standard_normal(rgb.shape, dtype=np.float32), 0, 255).astype(
        np.uint8
    )
    return noisy, depth + 0.003 * depth**2 * rng.standard_normal(depth.shape, dtype=np.float32)
