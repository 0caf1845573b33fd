"""Draw rooms: furnished on three sides, on four, or plain."""

import numpy as np

from cohdc_train.synth.room import Room
from cohdc_train.synth.room_builder import RoomBuilder


def texture_detail(size: tuple[int, int]) -> int:
    """Return the side, px, of the largest texture that images of a size (height, width) show."""
    widest = max(size)
    return 1024 if widest > 320 else 512 if widest > 160 else 256


def furnished_room(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    walk_depth: float,
    detail: int = 1024,
) -> Room:
    """Draw a room with furniture along the far wall and both sides.

    Tables that would stand in 0..walk_depth are moved behind it.

    Args:
        rng: random numbers.
        size: (width, length, height), m.
        walk_depth: y up to which the floor stays free between the sides, m.
        detail: side of the largest texture, px, a power of two of at least 128.
    """
    build = RoomBuilder(rng, size, detail)
    build.add_shell()
    build.add_posters()
    w, length, _ = size
    for x in np.arange(-w / 2 + 0.6, w / 2 - 0.5, 1.25):
        kinds = (build.add_shelf, build.add_table, build.add_carton, build.add_table)
        add = kinds[int(rng.integers(4))]
        place = float(x + rng.uniform(-0.1, 0.1))
        add(place, length - rng.uniform(0.35, 0.5), rng.normal(0, 0.04))
    for x in np.arange(-w / 2 + 1.2, w / 2 - 1.0, 1.9):
        y = length - rng.uniform(1.4, 1.9)
        if y > walk_depth + 0.5 and rng.random() < 0.7:
            add = (build.add_table, build.add_carton)[int(rng.integers(2))]
            add(float(x), y, rng.uniform(-0.5, 0.5))
    build.add_side_furniture(max(walk_depth - 0.4, 0.8))
    return build.build()


def loop_room(
    rng: np.random.Generator, size: tuple[float, float, float], detail: int = 1024
) -> Room:
    """Draw a room with furniture and posters along all four walls, and a free middle.

    Arguments are those of `furnished_room`.
    """
    build = RoomBuilder(rng, size, detail)
    build.add_shell()
    build.add_posters(walls=4)
    w, length, _ = size
    for y, yaw in ((length - 0.4, 0.0), (0.4, np.pi)):
        for x in np.arange(-w / 2 + 0.6, w / 2 - 0.5, 1.25):
            add = (build.add_shelf, build.add_table, build.add_carton)[int(rng.integers(3))]
            add(float(x + rng.uniform(-0.1, 0.1)), y, yaw + rng.normal(0, 0.04))
    build.add_side_furniture(1.3)
    return build.build()


def plain_room(
    rng: np.random.Generator, size: tuple[float, float, float], detail: int = 1024
) -> Room:
    """Draw a room of plain walls with little before them.

    Arguments are those of `furnished_room`.
    """
    build = RoomBuilder(rng, size, detail)
    build.add_shell(plain=True)
    w, length, _ = size
    for x in (-w / 2 + rng.uniform(0.9, 1.6), w / 2 - rng.uniform(0.9, 1.6)):
        add = (build.add_table, build.add_carton)[int(rng.integers(2))]
        add(float(x), length - 0.5, rng.normal(0, 0.04))
    return build.build()
