"""Triangles with normals, texture coordinates and instance numbers, and solids made of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from cohdc_train.types import Float32Array, Int32Array, IntArray


@dataclass(frozen=True)
class Mesh:
    """T triangles that share nothing.

    Attributes:
        corners: [T, 3, 3] m.
        normals: [T, 3, 3] unit vectors, in the frame of the corners.
        uv: [T, 3, 2] in 0..1, v downwards in the texture.
        texture: [T] int32 index into a list of textures.
        instance: [T] int32, 0 = room, 1.. = actors.
    """

    corners: Float32Array
    normals: Float32Array
    uv: Float32Array
    texture: Int32Array
    instance: Int32Array

    def transformed(self, rotation: ArrayLike, translation: ArrayLike) -> "Mesh":
        """Return the mesh in another frame: rotation [3, 3], translation [3] m."""
        turn = np.asarray(rotation, dtype=np.float32).T
        shift = np.asarray(translation, dtype=np.float32)
        corners = (self.corners.reshape(-1, 3) @ turn + shift).reshape(-1, 3, 3)
        return replace(
            self, corners=corners, normals=(self.normals.reshape(-1, 3) @ turn).reshape(-1, 3, 3)
        )

    def as_instance(self, instance: int, first_texture: int) -> "Mesh":
        """Return the mesh with another instance number, and textures from `first_texture` on."""
        return replace(
            self,
            instance=np.full_like(self.instance, instance),
            texture=(self.texture + first_texture).astype(np.int32),
        )


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return all triangles of several meshes, in order, with their texture and instance numbers."""
    return Mesh(
        np.concatenate([m.corners for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.texture for m in meshes]),
        np.concatenate([m.instance for m in meshes]),
    )


def yaw_rotation(yaw: float) -> Float32Array:
    """Return the rotation [3, 3] by `yaw` rad about the vertical axis z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.float32)


def grid(points: Float32Array, texture: int, closed: bool) -> Mesh:
    """Return the surface through a grid of points, with smooth normals.

    Normals of a closed surface point away from the line through the rings' centers. Those of an
    open one point to where u is seen running to the right and v down.

    Args:
        points: [R, S, 3] m.
        texture: its number.
        closed: the last column meets the first (a tube); uv then runs once around along u.
    """
    ring = np.concatenate([points, points[:, :1]], axis=1) if closed else points
    faces, uv = _grid_faces(ring.shape[0], ring.shape[1])
    along = _differences(ring)
    if closed:
        wrapped = np.concatenate([points[:, -1:], points, points[:, :2]], axis=1)
        around = wrapped[:, 2:] - wrapped[:, :-2]
    else:
        around = _differences(ring.transpose(1, 0, 2)).transpose(1, 0, 2)
    normals = _cross(along, around)
    normals /= np.maximum(np.sqrt(np.einsum("rsk,rsk->rs", normals, normals))[..., None], 1e-12)
    if closed:
        outward = points - points.mean(axis=1, keepdims=True)
        if np.vdot(normals[:, :-1], outward) < 0:
            normals = -normals
    return Mesh(
        ring.reshape(-1, 3)[faces].astype(np.float32),
        normals.reshape(-1, 3)[faces].astype(np.float32),
        uv,
        np.full(len(faces), texture, dtype=np.int32),
        np.zeros(len(faces), dtype=np.int32),
    )


@lru_cache(maxsize=32)
def _grid_faces(rows: int, columns: int) -> tuple[IntArray, Float32Array]:
    """Return faces [T, 3] over a grid of vertices, and their uv [T, 3, 2]."""
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)]
    )
    return faces, np.stack([u, v], -1).reshape(-1, 2)[faces].astype(np.float32)


def _normalize(vectors: Float32Array) -> Float32Array:
    """Return vectors [n, 3] scaled to length 1."""
    scaled: Float32Array = (
        vectors / np.maximum(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)), 1e-9)[:, None]
    )
    return scaled


def _differences(rows: Float32Array) -> Float32Array:
    """Return central differences along the first axis (one-sided at its ends), up to a factor."""
    padded = np.concatenate([rows[:1], rows, rows[-1:]])
    differences: Float32Array = padded[2:] - padded[:-2]
    return differences


def _cross(a: Float32Array, b: Float32Array) -> Float32Array:
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def quad(origin: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike, texture: int) -> Mesh:
    """Return a parallelogram from `origin` [3] m along `edge_u` (u 0..1) and `edge_v` (v 0..1).

    It faces as `grid` says.
    """
    o, a, b = (np.asarray(p, dtype=np.float32) for p in (origin, edge_u, edge_v))
    return grid(
        np.stack([np.stack([o, o + a]), np.stack([o + b, o + a + b])]), texture, closed=False
    )


def box(center: ArrayLike, size: ArrayLike, yaw: float, side: int, top: int) -> Mesh:
    """Return a box.

    Args:
        center: [3] m.
        size: [3] m.
        yaw: rotation about z, rad.
        side: number of the texture of its sides.
        top: number of the texture of its top.
    """
    x, y, z = (float(v) / 2 for v in np.asarray(size, dtype=np.float32))
    faces = [
        quad((-x, -y, z), (2 * x, 0, 0), (0, 0, -2 * z), side),
        quad((x, y, z), (-2 * x, 0, 0), (0, 0, -2 * z), side),
        quad((-x, y, z), (0, -2 * y, 0), (0, 0, -2 * z), side),
        quad((x, -y, z), (0, 2 * y, 0), (0, 0, -2 * z), side),
        quad((-x, y, z), (2 * x, 0, 0), (0, -2 * y, 0), top),
        quad((-x, -y, -z), (2 * x, 0, 0), (0, 2 * y, 0), top),
    ]
    return join_meshes(faces).transformed(yaw_rotation(yaw), center)


def tube(
    centers: Float32Array, radii: Float32Array, side: ArrayLike, texture: int, segments: int = 12
) -> Mesh:
    """Return a closed tube of elliptic rings.

    u = 0.5 lies on the ring's across axis, side x tangent.

    Args:
        centers: [R, 3] m.
        radii: [R, 2] m along `side` and across it.
        side: [3] direction, made orthogonal to the tube.
        texture: its number.
        segments: number of points of a ring.
    """
    across = np.asarray(side, dtype=np.float32)
    tangent = _normalize(_differences(centers))
    wide = _normalize(across - tangent * (tangent @ across)[:, None])
    deep = _cross(wide, tangent)
    angle = 2 * np.pi * np.arange(segments) / segments - np.pi
    offsets = (
        np.cos(angle)[None, :, None] * (deep * radii[:, 1:])[:, None]
        + np.sin(angle)[None, :, None] * (wide * radii[:, :1])[:, None]
    )
    return grid((centers[:, None] + offsets).astype(np.float32), texture, closed=True)


def capsule(
    start: ArrayLike, end: ArrayLike, radii: tuple[float, float], side: ArrayLike, texture: int
) -> Mesh:
    """Return a limb: a tapered tube with round ends, a little fuller in its upper middle.

    Args:
        start: [3] m.
        end: [3] m.
        radii: at start and end, m.
        side: [3] direction that u is measured from.
        texture: its number.
    """
    a, b = np.asarray(start, dtype=np.float32), np.asarray(end, dtype=np.float32)
    length = max(float(np.linalg.norm(b - a)), 1e-6)
    axis = (b - a) / length
    cap = np.radians([88, 60, 30])
    reach = np.concatenate(
        [
            -radii[0] * np.sin(cap),
            length * np.linspace(0, 1, 5),
            length + radii[1] * np.sin(cap[::-1]),
        ]
    )
    t = np.linspace(0, 1, 5)
    middle = radii[0] + (radii[1] - radii[0]) * t + 0.12 * radii[0] * np.sin(np.pi * t**0.8)
    r = np.concatenate([radii[0] * np.cos(cap), middle, radii[1] * np.cos(cap[::-1])])
    centers = (a + reach[:, None] * axis).astype(np.float32)
    return tube(centers, np.stack([r, r], 1).astype(np.float32), side, texture, segments=10)


def ellipsoid(center: ArrayLike, radii: tuple[float, float, float], texture: int) -> Mesh:
    """Return an ellipsoid with its axes along x, y, z; u = 0.5 faces +x, v runs from the top down.

    radii: m.
    """
    polar = np.radians([2, 25, 50, 70, 90, 110, 130, 155, 178])
    centers = np.zeros((len(polar), 3), dtype=np.float32)
    centers[:, 2] = radii[2] * np.cos(polar)
    rings = np.stack([radii[1] * np.sin(polar), radii[0] * np.sin(polar)], 1).astype(np.float32)
    centers += np.asarray(center, dtype=np.float32)
    return tube(centers, rings, (0.0, -1.0, 0.0), texture, segments=14)
