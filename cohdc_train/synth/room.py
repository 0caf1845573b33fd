"""Furnished room: triangles, textures, lamps, and free floor."""

from dataclasses import dataclass

import numpy as np

from cohdc_train.synth.mesh import Mesh
from cohdc_train.synth.textures import Texture
from cohdc_train.types import Float32Array


@dataclass(frozen=True)
class Lighting:
    """Lamps and ambient light. World frame, z up.

    Attributes:
        lamps: [L, 3] m.
        power: [L, 3] RGB.
        ambient: [3] RGB.
    """

    lamps: Float32Array
    power: Float32Array
    ambient: Float32Array


@dataclass(frozen=True)
class Room:
    """A room in the world frame: x in -width/2..width/2, y in 0..length, z in 0..height (up), m.

    Attributes:
        size: (width, length, height), m.
        mesh: walls and furniture.
        textures: of the mesh.
        lighting: lamps and ambient light.
        footprints: [F, 4] (x, y, half x, half y) of furniture standing on the floor.
    """

    size: tuple[float, float, float]
    mesh: Mesh
    textures: tuple[Texture, ...]
    lighting: Lighting
    footprints: Float32Array

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Return whether a disc on the floor stays clear of walls and furniture; all in m."""
        if abs(x) > self.size[0] / 2 - radius or not radius <= y <= self.size[1] - radius:
            return False
        near = np.abs(self.footprints[:, :2] - np.array([x, y])) - self.footprints[:, 2:]
        return bool(np.all(near.max(axis=1) > radius)) if len(near) else True
