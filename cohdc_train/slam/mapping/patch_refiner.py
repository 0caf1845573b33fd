"""Photometric refinement: a measurement moves to where the point's patch fits best (paper eqs. 8 and 9).

A corner of ORB lies on a whole pixel of its pyramid level. The patch that was cut out where the point was first seen,
turned and scaled as the camera has moved since, says where in the image the point is to a fraction of that. Such
measurements are `precise` and weigh accordingly, in a frame's pose as in bundle adjustment. We depart from eq. 9 in
that A has four free entries: the patch is taken for a plane that faced the first camera.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import SCALE, Features
from cohdc_train.slam.mapping.map import Keyframe, Map
from cohdc_train.slam.optimization.pose import Array, to_local

_STORED = 16  # px, side of a stored patch at its corner's level
_SIDE = 8  # px, side of the part that is compared
_COARSEST = 4  # level, beyond which a patch is so wide that it is seldom flat: points were drawn off by centimetres
_AT_ONCE = 1024  # patches that are turned in one call
_STEPS = 3  # what is left after them is a hundredth of a pixel
_FURTHEST = 1.5  # px at the corner's level: what fits better further off is something else
_DONE = 0.03  # px
_LIKENESS = 0.8  # least normalised correlation of patch and image
_TEXTURE = 400.0  # least eigenvalue of the patch's gradients, squared grey values

Floats = NDArray[np.float32]


class Pyramid:
    """A grey image at the finer levels of the corners."""

    def __init__(self, gray: NDArray[np.uint8]) -> None:
        """gray: [H, W]."""
        height, width = gray.shape
        levels = [gray]
        for level in range(1, _COARSEST + 1):
            size = (round(width / SCALE**level), round(height / SCALE**level))
            smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR_EXACT)
            levels.append(np.asarray(smaller, dtype=np.uint8))
        self.levels: list[Floats] = [level.astype(np.float32) for level in levels]

    def cut(self, pixels: Array, octaves: NDArray[np.int64], side: int, shift: Array | float = 0.0) -> Floats:
        """Grey values of the square around each of pixels [n, 2] px of level 0. side, and shift [n, 2]: px of each
        one's own level.

        Returns [n, side * side], row by row; beyond the border the border's.
        """
        result = np.empty((len(pixels), side * side), dtype=np.float32)
        height, width = self.levels[0].shape
        shift, (right, down) = np.broadcast_to(shift, pixels.shape), square(side)
        for level in np.unique(octaves).tolist():
            rows = np.flatnonzero(octaves == level)
            image = self.levels[level]
            share = np.array([image.shape[1] / width, image.shape[0] / height])
            places = ((pixels[rows] + 0.5) * share - 0.5 + shift[rows]).astype(np.float32)
            x, y = places[:, :1] + right, places[:, 1:] + down
            result[rows] = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return result


@dataclass
class Refiner:
    """Keeps the patches of a map's points, of all but the coarsest corners, and moves measurements by them."""

    world: Map

    def __post_init__(self) -> None:
        self._patches = np.zeros((0, _STORED, _STORED), dtype=np.uint8)
        self._octaves = np.zeros(0, dtype=np.int64)
        self._pyramid: Pyramid | None = None

    def look_at(self, gray: NDArray[np.uint8]) -> None:
        """The frame that is meant from now on, [H, W]."""
        self._pyramid = Pyramid(gray)

    def remember(self, keyframe: Keyframe) -> None:
        """Cut out the points that were born in a keyframe, the newest in the map, made of the frame looked at."""
        assert self._pyramid is not None
        grown = len(self.world.positions) - len(self._patches)  # the map doubles its arrays, so this is rarely copied
        if grown > 0:
            self._patches = np.concatenate([self._patches, np.zeros((grown, _STORED, _STORED), dtype=np.uint8)])
            self._octaves = np.concatenate([self._octaves, np.zeros(grown, dtype=np.int64)])
        born = np.flatnonzero(self.world.born[: len(self._patches)] == keyframe.index)
        self._patches[born] = 0  # blank, or a point without one would have that of the point whose row it took
        corners = np.flatnonzero((keyframe.point_ids >= 0) & (keyframe.features.octaves <= _COARSEST))
        corners = corners[self.world.born[keyframe.point_ids[corners]] == keyframe.index]
        ids, octaves = keyframe.point_ids[corners], keyframe.features.octaves[corners]
        patches = self._pyramid.cut(keyframe.features.pixels[corners], octaves, _STORED)
        self._patches[ids] = np.rint(patches).reshape(-1, _STORED, _STORED)
        self._octaves[ids] = octaves
        keyframe.features.precise[corners] = True  # where the patch lies, by which others are moved

    def refine(self, features: Features, matches: Matches, T_cw: Array) -> Features:
        """The features with those matched corners moved that found a better place in the frame looked at.

        T_cw: [4, 4] the frame's pose.
        """
        assert self._pyramid is not None
        matches = matches.take(features.octaves[matches.corners] <= _COARSEST)
        if len(matches) == 0:
            return features
        ids, corners = matches.points, matches.corners
        octaves = features.octaves[corners]
        A = affine(self.world, ids, T_cw)
        back = np.linalg.inv(A) * (SCALE ** (octaves - self._octaves[ids]))[:, None, None]
        template = warped(self._patches[ids], back, _SIDE + 2)
        shift, good = align(self._pyramid, features.pixels[corners], octaves, template)
        rows = corners[good]
        pixels, points = features.pixels.copy(), features.points.copy()
        pixels[rows] += shift[good] * SCALE ** octaves[good, None]
        undistort = self.world.camera.undistort  # the difference, for points may be unrolled (`shutter`)
        points[rows] += undistort(pixels[rows]) - undistort(features.pixels[rows])
        precise = np.zeros(len(features), dtype=np.bool_)
        precise[rows] = True
        return replace(features, pixels=pixels, points=points, precise=precise)


def square(side: int) -> Floats:
    """[2, side * side] offsets x and y of a square's pixels from its middle, px, row by row."""
    places = np.arange(side, dtype=np.float32) - (side - 1) / 2
    return np.stack([np.tile(places, side), np.repeat(places, side)])


def affine(world: Map, ids: NDArray[np.int64], T_cw: Array) -> Array:
    """A of eq. 9 for n points: [n, 2, 2] px of a camera at T_cw per px of the keyframe where each was first seen."""
    camera, points = world.camera, world.positions[ids]
    born, which = np.unique(world.born[ids], return_inverse=True)
    T_bw = np.stack([world.pose(index) for index in born.tolist()])[which]
    depth = np.einsum("nj,nj->n", T_bw[:, 2, :3], points) + T_bw[:, 2, 3]  # in the keyframe of its birth
    local = to_local(T_cw, points)
    across = T_cw[:3, :3] @ T_bw[:, :2, :3].transpose(0, 2, 1)  # [n, 3, 2] that keyframe's x and y axes
    across *= (depth[:, None] / np.array([camera.fx, camera.fy]))[:, None]  # m per px
    A: Array = across[:, :2] - (local[:, :2] / local[:, 2:])[:, :, None] * across[:, 2:]
    A *= np.array([camera.fx, camera.fy])[:, None] / local[:, 2, None, None]
    return A


def warped(patches: NDArray[np.uint8], inverse: Array, side: int) -> Floats:
    """[n, side, side]: I_r[A(u)] of eq. 8. inverse: [n, 2, 2] px of the patch per px of the image, at their levels."""
    result = np.empty((len(patches), side * side), dtype=np.float32)
    for start in range(0, len(patches), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        column = patches[some].reshape(-1, _STORED).astype(np.float32)  # one patch below the other
        places = inverse[some].astype(np.float32) @ square(side) + np.float32((_STORED - 1) / 2)
        x, y = np.clip(places, 0, _STORED - 1).transpose(1, 0, 2)
        y += _STORED * np.arange(len(y), dtype=np.float32)[:, None]
        result[some] = cv2.remap(column, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result.reshape(-1, side, side)


def align(
    pyramid: Pyramid, pixels: Array, octaves: NDArray[np.int64], template: Floats
) -> tuple[Array, NDArray[np.bool_]]:
    """Minimise eq. 8 over each pixel by inverse composition; image and patch may differ in brightness and contrast.

    pixels: [n, 2] px; template: [n, side + 2, side + 2], the patch with one px around it for its gradient. Returns
    [n, 2] shifts, px of each one's level, and [n] bool: False where the patch has no texture, leaves its surroundings,
    or does not look alike.
    """
    n = len(pixels)
    inner = _centred(template[:, 1:-1, 1:-1])
    contrast = np.maximum(np.linalg.norm(inner, axis=1, keepdims=True), 1e-6)
    dx = _centred(0.5 * (template[:, 1:-1, 2:] - template[:, 1:-1, :-2]))
    dy = _centred(0.5 * (template[:, 2:, 1:-1] - template[:, :-2, 1:-1]))
    gradient = np.stack([dx, dy], axis=1)  # [n, 2, k]
    H = (gradient @ gradient.transpose(0, 2, 1)).astype(np.float64) + 1e-3 * np.eye(2)
    active = _least_eigenvalue(H) > _TEXTURE
    descent = np.linalg.inv(H).astype(np.float32) @ gradient
    shift, likeness, side = np.zeros((n, 2)), np.zeros(n), template.shape[1] - 2
    for _ in range(_STEPS):
        rows = np.flatnonzero(active)
        if len(rows) == 0:
            break
        seen = _centred(pyramid.cut(pixels[rows], octaves[rows], side, shift[rows]))
        wanted = inner[rows]
        seen *= contrast[rows] / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-6)
        likeness[rows] = np.einsum("nk,nk->n", seen, wanted) / contrast[rows, 0] ** 2
        step = (descent[rows] @ (wanted - seen)[..., None])[..., 0]
        shift[rows] += step
        active[rows] = np.abs(step).max(axis=1) > _DONE
    return shift, (likeness >= _LIKENESS) & (np.linalg.norm(shift, axis=1) <= _FURTHEST)


def _least_eigenvalue(H: Array) -> Array:
    """[n] of symmetric matrices [n, 2, 2]."""
    mean, half = (H[:, 0, 0] + H[:, 1, 1]) / 2, (H[:, 0, 0] - H[:, 1, 1]) / 2
    return np.asarray(mean - np.hypot(half, H[:, 0, 1]))


def _centred(patches: Floats) -> Floats:
    """[n, k]: every patch without its mean."""
    flat = patches.reshape(len(patches), -1)
    return np.asarray(flat - flat.mean(axis=1, keepdims=True), dtype=np.float32)
