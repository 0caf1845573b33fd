"""Build a room piece by piece: walls, posters, furniture, lamps."""

import cv2
import numpy as np

from cohdc_train.synth import mesh as solids
from cohdc_train.synth import textures
from cohdc_train.synth.mesh import Mesh
from cohdc_train.synth.room import Lighting, Room
from cohdc_train.synth.textures import Texture
from cohdc_train.types import Float32Array, FloatArray


class RoomBuilder:
    """Collects solids, textures and footprints of one room."""

    def __init__(
        self, rng: np.random.Generator, size: tuple[float, float, float], detail: int
    ) -> None:
        """Begin an empty room.

        Args:
            rng: random numbers.
            size: (width, length, height), m.
            detail: side of the largest texture, px.
        """
        self.rng, self.size, self.detail = rng, size, detail
        self.parts: list[Mesh] = []
        self.textures: list[Texture] = []
        self.floor = 0
        self.footprints: list[tuple[float, float, float, float]] = []

    def add_texture(self, image: Texture) -> int:
        """Store a texture and return its number."""
        self.textures.append(image)
        return len(self.textures) - 1

    def add_material(self) -> int:
        """Draw a texture for a piece of furniture and return its number."""
        maker = textures.FACES[int(self.rng.integers(len(textures.FACES)))]
        return self.add_texture(maker(self.rng, self.detail // 4, self.detail // 4))

    def add_shell(self, plain: bool = False) -> None:
        """Add floor, ceiling and four walls with a texture each, darker toward the border.

        plain: walls of even paint, without a mark.
        """
        w, length, h = self.size
        rng, d = self.rng, self.detail
        floor = textures.FLOORS[int(rng.integers(len(textures.FLOORS)))]
        walls = [textures.WALLS[int(k)] for k in rng.permutation(len(textures.WALLS))[:4]]
        walls = [textures.paint] * 4 if plain else walls
        low, high = (
            _darken_border(floor(rng, d, d)),
            _darken_border(textures.plaster(rng, d // 2, d // 2)),
        )
        sides = [self.add_texture(_darken_border(maker(rng, d // 2, d))) for maker in walls]
        self.floor = self.add_texture(low)
        self.parts += [
            solids.quad((-w / 2, length, 0), (w, 0, 0), (0, -length, 0), self.floor),
            solids.quad((-w / 2, 0, h), (w, 0, 0), (0, length, 0), self.add_texture(high)),
            solids.quad((-w / 2, length, h), (w, 0, 0), (0, 0, -h), sides[0]),
            solids.quad((w / 2, 0, h), (-w, 0, 0), (0, 0, -h), sides[1]),
            solids.quad((-w / 2, 0, h), (0, length, 0), (0, 0, -h), sides[2]),
            solids.quad((w / 2, length, h), (0, -length, 0), (0, 0, -h), sides[3]),
        ]

    def add_posters(self, walls: int = 3) -> None:
        """Add posters to the far wall, to both side walls and, of four `walls`, to the near one."""
        w, length, h = self.size
        for wall in range(walls):
            span = w if wall in (0, 3) else length
            for x in np.arange(0.7, span - 0.7, self.rng.uniform(0.9, 1.5)):
                if self.rng.random() < 0.2:
                    continue
                wide, tall = self.rng.uniform(0.4, 0.8), self.rng.uniform(0.4, 0.9)
                z = self.rng.uniform(1.2, max(h - tall / 2 - 0.25, 1.25)) + tall / 2
                side = self.detail // 2 if wall in (0, 3) else self.detail // 4
                look = self.add_texture(textures.poster_texture(self.rng, side, side))
                left = x - wide / 2 + self.rng.uniform(-0.15, 0.15)
                self.parts.append(self._poster(wall, (left, z), (wide, tall), look))

    def _poster(
        self, wall: int, position: tuple[float, float], size: tuple[float, float], texture: int
    ) -> Mesh:
        """Return a poster on a wall; position: along the wall, and its top, m."""
        w, length, _ = self.size
        (left, z), (wide, tall) = position, size
        down = (0, 0, -tall)
        if wall == 0:
            return solids.quad((left - w / 2, length - 0.02, z), (wide, 0, 0), down, texture)
        if wall == 1:
            return solids.quad((0.02 - w / 2, left, z), (0, wide, 0), down, texture)
        if wall == 2:
            return solids.quad((w / 2 - 0.02, left + wide, z), (0, -wide, 0), down, texture)
        return solids.quad((left + wide - w / 2, 0.02, z), (-wide, 0, 0), down, texture)

    def add_shelf(self, x: float, y: float, yaw: float) -> None:
        """Add a bookcase."""
        size = (self.rng.uniform(0.7, 1.1), 0.32, self.rng.uniform(1.0, 2.0))
        look = self.add_texture(textures.books(self.rng, self.detail // 2, self.detail // 2))
        self.parts.append(solids.box((x, y, size[2] / 2), size, yaw, look, self.add_material()))
        self.add_footprint(x, y, size, yaw)

    def add_table(self, x: float, y: float, yaw: float) -> None:
        """Add a table with a monitor, boxes and cans on it."""
        rng = self.rng
        size = (rng.uniform(1.0, 1.6), rng.uniform(0.6, 0.8), rng.uniform(0.68, 0.78))
        look = self.add_material()
        turn = solids.yaw_rotation(yaw)
        parts = [solids.box((0, 0, size[2]), (size[0], size[1], 0.04), 0, look, look)]
        for sx in (-1, 1):
            for sy in (-1, 1):
                leg = (sx * (size[0] / 2 - 0.05), sy * (size[1] / 2 - 0.05), size[2] / 2)
                parts.append(solids.box(leg, (0.05, 0.05, size[2]), 0, look, look))
        monitor = self.add_texture(textures.screen(rng, self.detail // 4, self.detail // 4))
        parts.append(
            solids.box(
                (rng.uniform(-0.3, 0.3), 0.12, size[2] + 0.24),
                (0.52, 0.05, 0.34),
                rng.normal(0, 0.2),
                monitor,
                look,
            )
        )
        for _ in range(int(rng.integers(3, 7))):
            thing = rng.uniform(0.07, 0.26, 3)
            place = (
                rng.uniform(-0.42, 0.42) * size[0],
                rng.uniform(-0.4, 0.4) * size[1],
                size[2] + 0.02 + thing[2] / 2,
            )
            parts.append(self.small_object(place, thing))
        self.parts.append(solids.join_meshes(parts).transformed(turn, (x, y, 0.0)))
        self.add_footprint(x, y, size, yaw)

    def small_object(self, place: tuple[float, float, float], size: FloatArray) -> Mesh:
        """Return a small box or can."""
        if self.rng.random() < 0.6:
            look = self.add_material()
            return solids.box(place, size, self.rng.uniform(0, 3), look, look)
        return self.cylinder(place, size[0] / 2, size[2])

    def cylinder(self, center: tuple[float, float, float], radius: float, height: float) -> Mesh:
        """Return an upright cylinder with a lid."""
        z = np.array([0.5, 0.5, 0.4, -0.5], dtype=np.float32) * height
        r = np.array([0.02, 1.0, 1.0, 1.0], dtype=np.float32) * radius
        rings = np.zeros((4, 3), dtype=np.float32)
        rings[:, 2] = z
        turn: tuple[float, float, float] = (0.0, 1.0, 0.0)
        return solids.tube(
            rings + np.array(center, dtype=np.float32),
            np.stack([r, r], 1),
            turn,
            self.add_material(),
            20,
        )

    def add_carton(self, x: float, y: float, yaw: float) -> None:
        """Add a crate, cupboard or barrel on the floor."""
        size = self.rng.uniform((0.35, 0.35, 0.3), (0.8, 0.6, 1.1))
        if self.rng.random() < 0.7:
            self.parts.append(
                solids.box((x, y, size[2] / 2), size, yaw, self.add_material(), self.add_material())
            )
        else:
            self.parts.append(self.cylinder((x, y, size[2] / 2), size[0] / 2, size[2]))
        self.add_footprint(x, y, (size[0], size[1], size[2]), yaw)

    def add_footprint(
        self, x: float, y: float, size: tuple[float, float, float], yaw: float
    ) -> None:
        """Store the part of the floor that a piece of furniture covers."""
        c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
        half = ((c * size[0] + s * size[1]) / 2, (s * size[0] + c * size[1]) / 2)
        self.footprints.append((x, y, float(half[0]), float(half[1])))

    def lighting(self) -> Lighting:
        """Draw two or three lamps below the ceiling and an ambient light, each with its tint."""
        w, length, h = self.size
        count = int(self.rng.integers(2, 4))
        lamps = self.rng.uniform((-w / 2, 0.3, h - 0.6), (w / 2, length - 0.3, h - 0.1), (count, 3))
        tint = 1 + self.rng.normal(0, 0.05, (count, 3))
        power = tint * self.rng.uniform(0.5, 1.1, (count, 1))
        ambient = self.rng.uniform(0.4, 0.7) * (1 + self.rng.normal(0, 0.03, 3))
        return Lighting(
            lamps.astype(np.float32), power.astype(np.float32), ambient.astype(np.float32)
        )

    def add_side_furniture(self, first: float) -> None:
        """Add furniture along both side walls from y = `first` m on."""
        w, length, _ = self.size
        for side in (-1, 1):
            for y in np.arange(first, length - 0.9, 1.2):
                add = (self.add_shelf, self.add_carton)[int(self.rng.integers(2))]
                add(side * (w / 2 - 0.35), float(y), np.pi / 2)

    def build(self) -> Room:
        """Return the room, with shadows under the furniture and lamps above."""
        footprints = np.array(self.footprints, dtype=np.float32).reshape(-1, 4)
        _shade_floor(self.textures[self.floor], footprints, self.size)
        return Room(
            self.size,
            solids.join_meshes(self.parts),
            tuple(self.textures),
            self.lighting(),
            footprints,
        )


def _darken_border(image: Texture) -> Texture:
    """Return a texture darkened toward its border, as walls are toward the corners of a room."""
    height, width = image.shape[:2]
    x = np.minimum(np.arange(width), np.arange(width)[::-1]) / width
    y = np.minimum(np.arange(height), np.arange(height)[::-1]) / height
    shade = (1 - 0.3 * np.exp(-x / 0.05))[None] * (1 - 0.3 * np.exp(-y / 0.06))[:, None]
    darkened: Texture = np.clip(image * shade[..., None], 0, 255).astype(np.uint8)
    return darkened


def _shade_floor(
    floor: Texture, footprints: Float32Array, size: tuple[float, float, float]
) -> None:
    """Draw soft shadows of the furniture over the floor's texture, in place."""
    height, width = floor.shape[:2]
    shadow = np.ones((height, width), dtype=np.float32)
    scale = np.array([width / size[0], height / size[1]])
    for x, y, half_x, half_y in footprints:
        low = (np.array([x - half_x + size[0] / 2, size[1] - y - half_y]) * scale).astype(int)
        high = (np.array([x + half_x + size[0] / 2, size[1] - y + half_y]) * scale).astype(int)
        shadow[max(low[1], 0) : high[1], max(low[0], 0) : high[0]] = 0.45
    soft = cv2.GaussianBlur(shadow, (0, 0), 0.18 * float(scale[0]))
    floor[:] = (floor * soft[..., None]).astype(np.uint8)
