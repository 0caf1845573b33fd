"""Movers of any class, found by depth alone: what stands where a keyframe looked through is no part of the map.

The multi-view test of DynaSLAM, dense and coarse: every eighth pixel of the frame is placed in the world by the pose
that is expected, and looked up in the depth of keyframes from other times. A point clearly nearer than what a keyframe
saw behind it lies in space that was free then. A surface that stands still is never there, so two such votes are
enough; depth that agrees, or that lies hidden behind something, says nothing.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.camera import Camera
from cohdc_train.slam.optimization import Array, inverse, to_local

_STEP = 8  # px of the image per coarse pixel
_CENTRE = (_STEP - 1) / 2
_NEARER, _NEARER_PER_M = 0.1, 0.03  # m, and m per m of depth: nearer by less is noise
_NEAR = 0.2  # m: the sensor sees nothing nearer
_FAR = 5.0  # m: nor anything reliable further off
_VOTES = 2  # keyframes that must have looked through the place
_LEAST = 8  # coarse px of a mover: smaller ones are noise at edges
_GROWTH, _SAME = 3, 0.12  # coarse px a mover grows over its own surface, and m its depth may change per px
_JUDGED, _MOVED = 0.6, 0.05  # of a part at rest: readings that agree, at least, and that do not, at most
_MOST = 0.8  # of the readings: so many movers mean that the pose is wrong

Coarse = NDArray[np.float32]  # [h, w] m, 0 = unknown; free of distortion
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class Reference:
    """What a keyframe saw. T_cw: [4, 4] world to camera, m; nearest: Coarse, the least depth around every pixel."""

    T_cw: Array
    nearest: Coarse


class Geometry:
    """The test for one camera. Depth images and masks are as measured, lens and all."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._shape = (camera.height // _STEP, camera.width // _STEP)
        coarse = _STEP * _grid(*self._shape) + _CENTRE
        self._rays = camera.backproject(coarse, np.ones(len(coarse)))
        self._blocks = _maps(camera.distort(coarse), self._shape)  # where each coarse pixel is measured, px
        self._measured = _maps((camera.distort(coarse) - _CENTRE) / _STEP, self._shape)
        whole = (camera.height, camera.width)
        self._flat = _maps((camera.undistort(_grid(*whole)) - _CENTRE) / _STEP, whole)

    def nearest(self, depth: NDArray[np.float32]) -> Coarse:
        """What a keyframe remembers of its depth image [H, W] m: the least around every coarse pixel."""
        return np.asarray(cv2.erode(self._coarse(depth), np.ones((3, 3), np.uint8)), dtype=np.float32)

    def movers(self, depth: NDArray[np.float32], T_cw: Array, references: list[Reference]) -> NDArray[np.bool_]:
        """depth: [H, W] m, 0 = none; T_cw: the frame's expected pose. Returns [H, W] bool, True = moves."""
        image = self._coarse(depth)
        through, agrees = self._votes(image, T_cw, references)
        found = _whole(through >= min(_VOTES, max(len(references) - 1, 1)), (agrees > 0) & (through == 0), image)
        if not found.any() or np.count_nonzero(found) > _MOST * np.count_nonzero(image):
            return np.zeros(depth.shape, dtype=np.bool_)
        return np.asarray(cv2.remap(found.astype(np.float32), *self._flat, cv2.INTER_LINEAR) > 0.5)

    def at_rest(
        self, mask: NDArray[np.bool_], depth: NDArray[np.float32], T_cw: Array, references: list[Reference]
    ) -> NDArray[np.bool_]:
        """The connected parts of a mask [H, W] that lie where every reference that could see them saw a surface.

        Returns [H, W] bool. Movement within the tolerance of depth, a seated person's, is not told from rest.
        """
        image = self._coarse(depth)
        through, agrees = self._votes(image, T_cw, references)
        _, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        coarse = cv2.remap(parts.astype(np.float32), *self._blocks, cv2.INTER_NEAREST).astype(np.int64)
        count = int(parts.max()) + 1
        readings, still, moved = (
            np.bincount(coarse[chosen], minlength=count)
            for chosen in (image > 0, (agrees > 0) & (through == 0), through > 0)
        )
        rests = (still >= np.maximum(_JUDGED * readings, _LEAST)) & (moved <= _MOVED * still)
        rests[0] = False
        return np.asarray(rests[parts])

    def _coarse(self, depth: NDArray[np.float32]) -> Coarse:
        """The least reading of every block, 0 where less than half of it has one."""
        h, w = self._shape
        blocks = depth[: h * _STEP, : w * _STEP].reshape(h, _STEP, w, _STEP)
        known = np.count_nonzero(blocks, axis=(1, 3)) >= _STEP * _STEP // 2
        least = np.where(blocks > 0, blocks, np.float32(np.inf)).min(axis=(1, 3))
        image = np.where(known & (least < _FAR), least, 0.0).astype(np.float32)
        return np.asarray(cv2.remap(image, *self._measured, cv2.INTER_NEAREST), dtype=np.float32)

    def _votes(
        self, image: Coarse, T_cw: Array, references: list[Reference]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """How many references looked through each coarse pixel's place, and how many saw a surface there: [h, w]."""
        h, w = self._shape
        rows = np.flatnonzero(image)
        world = to_local(inverse(T_cw), self._rays[rows] * image.ravel()[rows, None])
        through, agrees = (np.zeros(h * w, dtype=np.int64) for _ in range(2))
        for reference in references:
            local = to_local(reference.T_cw, world)
            depth = local[:, 2]
            ahead = depth > _NEAR
            places = self.camera.project(np.where(ahead[:, None], local, 1.0))
            x, y = np.rint((places - _CENTRE) / _STEP).astype(np.int64).T
            inside = ahead & (x >= 0) & (y >= 0) & (x < w) & (y < h)
            seen = np.where(inside, reference.nearest[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)], 0.0)
            tolerance = _NEARER + _NEARER_PER_M * depth
            through[rows] += seen - depth > tolerance
            agrees[rows] += (seen > 0) & (np.abs(seen - depth) <= tolerance)
        return through.reshape(h, w), agrees.reshape(h, w)


def _grid(height: int, width: int) -> Array:
    """[height * width, 2] (x, y) of an image's pixels, row by row."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def _maps(places: Array, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places [h * w, 2] as cv2.remap takes them."""
    x, y = places.astype(np.float32).T
    return x.reshape(shape), y.reshape(shape)


def _whole(found: NDArray[np.bool_], still: NDArray[np.bool_], image: Coarse) -> NDArray[np.bool_]:
    """Specks dropped; the rest grown over its own surface, as far as that is not known to stand still."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=8)
    big = stats[:, cv2.CC_STAT_AREA] >= _LEAST
    big[0] = False
    kept = big[labels]
    for _ in range(_GROWTH):
        beside = cv2.dilate(np.where(kept, image, 0.0).astype(np.float32), _CROSS)  # depth of the mover next to it
        kept |= (beside > 0) & (image > 0) & ~still & (np.abs(beside - image) < _SAME)
    return np.asarray(cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_CLOSE, _CROSS) > 0)
