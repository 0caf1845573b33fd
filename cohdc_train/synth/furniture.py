"""Furniture that people use: a chair, and a loaded cart to push.

Own frame as a person's: x forward, z up, m.
"""

import numpy as np

from cohdc_train.synth import mesh as solids
from cohdc_train.synth.mesh import Mesh
from cohdc_train.synth.textures import (
    Texture,
    carton_texture,
    poster_texture,
    wood_texture,
    write_letters,
)

HANDLE = -0.47  # m: where along x a cart's handle stands
_SIDE = 256  # px of a texture
_UPRIGHT = (0.0, 1.0, 0.0)


def chair(seat: float) -> Mesh:
    """Return a chair whose seat is `seat` m above the floor; its only texture is number 0."""
    parts = [
        solids.box((0.12, 0, seat - 0.02), (0.44, 0.46, 0.04), 0, 0, 0),
        solids.box((-0.17, 0, seat + 0.33), (0.03, 0.44, 0.3), 0, 0, 0),
    ]
    for y in (-0.2, 0.2):
        parts.append(solids.box((0.31, y, seat / 2 - 0.02), (0.035, 0.035, seat - 0.04), 0, 0, 0))
        parts.append(solids.box((-0.17, y, seat / 2 + 0.14), (0.035, 0.035, seat + 0.28), 0, 0, 0))
    return solids.join_meshes(parts)


def chair_texture(rng: np.random.Generator) -> Texture:
    """Draw the texture of a chair."""
    return wood_texture(rng, _SIDE, _SIDE)


def cart(rng: np.random.Generator) -> tuple[Mesh, tuple[Texture, ...]]:
    """Draw a cart of 1 x .6 m with a handle at its back, loaded to 1.2-1.5 m, and its textures."""
    looks = (
        _metal(rng),
        carton_texture(rng, _SIDE, _SIDE),
        poster_texture(rng, _SIDE, _SIDE),
        carton_texture(rng, _SIDE, _SIDE),
    )
    parts = [solids.box((0, 0, 0.2), (1.0, 0.6, 0.05), 0, 0, 0)]
    for x in (-0.4, 0.4):
        parts += [
            solids.capsule((x, y - 0.02, 0.09), (x, y + 0.02, 0.09), (0.08, 0.08), _UPRIGHT, 0)
            for y in (-0.25, 0.25)
        ]
    parts += [solids.box((HANDLE, y, 0.62), (0.04, 0.04, 0.84), 0, 0, 0) for y in (-0.27, 0.27)]
    parts.append(solids.box((HANDLE, 0, 1.04), (0.04, 0.58, 0.04), 0, 0, 0))
    low, high = float(rng.uniform(0.55, 0.65)), float(rng.uniform(0.45, 0.58))
    parts.append(
        solids.box((0.02, 0, 0.225 + low / 2), (0.86, 0.54, low), float(rng.normal(0, 0.02)), 1, 1)
    )
    parts.append(
        solids.box(
            (0.2, 0, 0.225 + low + high / 2), (0.42, 0.46, high), float(rng.normal(0, 0.1)), 2, 3
        )
    )
    parts.append(
        solids.box(
            (-0.2, 0.05, 0.225 + low + 0.11), (0.3, 0.34, 0.22), float(rng.normal(0, 0.1)), 3, 1
        )
    )
    return solids.join_meshes(parts), looks


def _metal(rng: np.random.Generator) -> Texture:
    """Draw painted metal with a label."""
    image = np.full((_SIDE, _SIDE, 3), rng.uniform(60, 190), dtype=np.float32)
    write_letters(image, rng, 2)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
