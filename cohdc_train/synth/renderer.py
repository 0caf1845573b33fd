"""Cast rays (Embree) at textured triangles: color, exact depth and instance of every pixel."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from cohdc_train.synth.mesh import Mesh
from cohdc_train.synth.room import Lighting
from cohdc_train.synth.textures import Texture
from cohdc_train.types import Float32Array, FloatArray, Int32Array


@dataclass(frozen=True)
class RenderCamera:
    """Pinhole camera; px. Whole numbers are pixel centers, as in TUM's intrinsics."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @classmethod
    def freiburg3(cls, size: tuple[int, int]) -> "RenderCamera":
        """Return TUM's freiburg3 camera (640 x 480), scaled to `size` (height, width)."""
        sy, sx = size[0] / 480, size[1] / 640
        return cls(
            535.4 * sx,
            539.2 * sy,
            (320.1 + 0.5) * sx - 0.5,
            (247.6 + 0.5) * sy - 0.5,
            size[1],
            size[0],
        )

    def resized(self, factor: float) -> "RenderCamera":
        """Return the camera of the same view with `factor` times as many pixels a side."""
        return RenderCamera(
            self.fx * factor,
            self.fy * factor,
            (self.cx + 0.5) * factor - 0.5,
            (self.cy + 0.5) * factor - 0.5,
            round(self.width * factor),
            round(self.height * factor),
        )


@dataclass(frozen=True)
class Hits:
    """First triangles that the N rays of a view meet.

    Attributes:
        triangle: [N] int32, -1 = nothing.
        weights: [N, 2] barycentric.
        depth: [N] m.
        directions: [N, 3] world frame.
    """

    triangle: Int32Array
    weights: Float32Array
    depth: Float32Array
    directions: Float32Array


@dataclass(frozen=True)
class RenderedView:
    """A rendered frame.

    Attributes:
        rgb: [H, W, 3] float32 >= 0, light before exposure.
        depth: [H, W] m along the optical axis, 0 = nothing.
        instance: [H, W] int32, 0 = room.
        facing: [H, W] cosine between the ray and the surface normal.
    """

    rgb: Float32Array
    depth: Float32Array
    instance: Int32Array
    facing: Float32Array


class Atlas:
    """All textures and their reduced copies in one image, so that one remap colors a frame."""

    _WIDTH = 4096

    def __init__(self, textures: Sequence[Texture]) -> None:
        """Lay out textures [h, w, 3] uint8, whose sides are powers of two of at most 2048."""
        order = sorted(range(len(textures)), key=lambda k: -textures[k].shape[0])
        places: dict[int, tuple[int, int]] = {}
        x = y = shelf = 0
        for k in order:
            height, width = textures[k].shape[:2]
            if x + width * 3 // 2 > self._WIDTH:
                x, y, shelf = 0, y + shelf, 0
            places[k] = (x, y)
            x, shelf = x + width * 3 // 2, max(shelf, height)
        self.image: Texture = np.zeros((y + shelf, self._WIDTH, 3), dtype=np.uint8)
        self.levels = np.array(
            [int(np.log2(min(t.shape[:2]))) - 1 for t in textures], dtype=np.int32
        )
        self.size = np.array([[t.shape[1], t.shape[0]] for t in textures], dtype=np.float32)
        # per texture and level: left, top, width - 1, height - 1 of the copy, px of the atlas
        self.copies = np.zeros((len(textures), int(self.levels.max()), 4), dtype=np.float32)
        for k, (left, top) in places.items():
            self._place(k, textures[k], left, top)

    def _place(self, k: int, image: Texture, left: int, top: int) -> None:
        x, y = left, top
        for level in range(int(self.levels[k])):
            height, width = image.shape[:2]
            self.image[y : y + height, x : x + width] = image
            self.copies[k, level] = (x, y, width - 1, height - 1)
            x, y = (left + width, top) if level == 0 else (x, y + height)
            image = cv2.resize(
                image, (width // 2, height // 2), interpolation=cv2.INTER_AREA
            ).astype(np.uint8)

    def sample(
        self, texture: Int32Array, uv: Float32Array, footprint: Float32Array, columns: int
    ) -> Float32Array:
        """Return the colors of N pixels, [N, 3] float32 in 0..1.

        Args:
            texture: [N] numbers.
            uv: [N, 2] in 0..1.
            footprint: [N] texels of the full texture that a pixel covers.
            columns: width of the image, px.
        """
        level = np.rint(np.log2(np.maximum(footprint, 1))).astype(np.int32)
        level = np.minimum(level, self.levels[texture] - 1)
        copy = np.take(self.copies.reshape(-1, 4), texture * self.copies.shape[1] + level, axis=0)
        x = (copy[:, 0] + uv[:, 0] * copy[:, 2]).reshape(-1, columns)
        y = (copy[:, 1] + uv[:, 1] * copy[:, 3]).reshape(-1, columns)
        found = cv2.remap(self.image, x, y, cv2.INTER_LINEAR).astype(np.float32)
        return found.reshape(-1, 3) * np.float32(1 / 255)


@lru_cache(maxsize=4)
def rays(camera: RenderCamera) -> Float32Array:
    """Return directions [H * W, 3] in the camera frame with z = 1: the parameter is the depth."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3).astype(np.float32)


def cast_rays(mesh: Mesh, camera: RenderCamera, T_wc: FloatArray) -> Hits:
    """Return the first hits of all rays of `camera` at `T_wc` [4, 4] (camera to world, m)."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, mesh.corners)
    directions = np.ascontiguousarray(rays(camera) @ T_wc[:3, :3].T.astype(np.float32))
    origins = np.broadcast_to(T_wc[:3, 3].astype(np.float32), directions.shape).copy()
    found = scene.run(origins, directions, output=1)
    weights = np.stack([found["u"], found["v"]], 1)
    return Hits(found["primID"], weights, found["tfar"], directions)


def render(
    mesh: Mesh, atlas: Atlas, lighting: Lighting, camera: RenderCamera, T_wc: FloatArray
) -> RenderedView:
    """Render the color, depth and instances that a camera sees.

    Args:
        mesh: triangles, world frame.
        atlas: their textures.
        lighting: lamps and ambient light.
        camera: intrinsics.
        T_wc: [4, 4] camera to world, m.
    """
    hits = cast_rays(mesh, camera, T_wc)
    triangle = np.maximum(hits.triangle, 0)
    met = hits.triangle >= 0
    depth = np.where(met, hits.depth, 0).astype(np.float32)
    normal = _interpolate(mesh.normals, triangle, hits.weights)
    normal /= np.maximum(np.sqrt(_dot(normal, normal)), np.float32(1e-9))[:, None]
    lengths = np.sqrt(_dot(hits.directions, hits.directions))
    facing: Float32Array = np.maximum(-_dot(normal, hits.directions) / lengths, 0)
    uv = _interpolate(mesh.uv, triangle, hits.weights)
    texels = _texel_density(mesh, atlas)[triangle] / np.sqrt(np.maximum(facing, np.float32(0.1)))
    footprint: Float32Array = (depth / np.float32(camera.fx) * texels).astype(
        np.float32, copy=False
    )
    albedo = atlas.sample(mesh.texture[triangle], uv, footprint, camera.width)
    position = hits.directions * depth[:, None] + T_wc[:3, 3].astype(np.float32)
    rgb = albedo * _illuminate(position, normal, lighting) * met[:, None]
    shape = (camera.height, camera.width)
    instance = np.where(met, mesh.instance[triangle], 0).astype(np.int32)
    return RenderedView(
        rgb.reshape(*shape, 3), depth.reshape(shape), instance.reshape(shape), facing.reshape(shape)
    )


def _interpolate(
    corners: Float32Array, triangle: Int32Array, weights: Float32Array
) -> Float32Array:
    """Return [N, C] values between those of the corners, [T, 3, C].

    weights: [N, 2] barycentric, of the second and third corner.
    """
    first = corners[:, 0]
    second, third = corners[:, 1] - first, corners[:, 2] - first
    value: Float32Array = np.take(first, triangle, axis=0)
    value += np.take(second, triangle, axis=0) * weights[:, :1]
    value += np.take(third, triangle, axis=0) * weights[:, 1:]
    return value


def _texel_density(mesh: Mesh, atlas: Atlas) -> Float32Array:
    """Return [T] texels per meter of every triangle."""
    edges = mesh.corners[:, 1:] - mesh.corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    spans = (mesh.uv[:, 1:] - mesh.uv[:, :1]) * atlas.size[mesh.texture][:, None]
    texels = np.abs(spans[:, 0, 0] * spans[:, 1, 1] - spans[:, 0, 1] * spans[:, 1, 0])
    density: Float32Array = np.sqrt(texels / np.maximum(area, 1e-12)).astype(np.float32)
    return density


def _illuminate(position: Float32Array, normal: Float32Array, lighting: Lighting) -> Float32Array:
    """Return [N, 3] light: ambient, stronger from above, and lamps that fade with distance."""
    lamps = lighting.lamps.T
    cosine = np.maximum(normal @ lamps - _dot(normal, position)[:, None], 0)
    square = _dot(position, position)[:, None] - 2 * (position @ lamps) + (lamps * lamps).sum(0)
    square = np.maximum(square, np.float32(1e-4))
    cosine /= np.sqrt(square) * (1 + np.float32(0.12) * square)
    total: Float32Array = cosine @ lighting.power
    total += lighting.ambient * (np.float32(0.82) + np.float32(0.18) * normal[:, 2:])
    return total


def _dot(a: Float32Array, b: Float32Array) -> Float32Array:
    """Return [N] dot products, row by row."""
    product: Float32Array = np.einsum("ij,ij->i", a, b)
    return product
