"""Movers of any class, found by depth alone: what stands where a keyframe looked through is no part
of the map.

The multi-view test of DynaSLAM, dense and coarse: every eighth pixel of the frame is placed in the
world by the pose that is expected, and looked up in the depth of keyframes from other times. A
point clearly nearer than what a keyframe saw behind it lies in space that was free then. A surface
that stands still is never there, so two such votes are enough; depth that agrees, or that lies
hidden behind something, says nothing.
"""

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.moving_surfaces import JUMP, LEAST
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse

_STEP = 8  # px of the image per coarse pixel
_CENTRE = (_STEP - 1) / 2
_NEARER, _NEARER_PER_M = 0.1, 0.03  # m, and m per m of depth: nearer by less is noise
_NEAR = 0.2  # m: the sensor sees nothing nearer
_FAR = 5.0  # m: nor anything reliable further off
_VOTES = 2  # keyframes that must have looked through the place
_GROWTH = 3  # coarse px a mover grows over its own surface
_JUDGED, _MOVED = (
    0.6,
    0.05,
)  # of a part at rest: readings that agree, at least, and that do not, at most

_Value = TypeVar("_Value", bound=np.generic)
DepthGrid = NDArray[np.float32]  # [h, w] m, 0 = unknown; free of distortion
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class ReferenceDepth:
    """What a keyframe saw. T_cw: [4, 4] world to camera, m; nearest: Coarse, the least depth around
    every pixel.
    """

    T_cw: Array
    nearest: DepthGrid


@dataclass(frozen=True)
class DepthComparison:
    """A frame's depth held against k references.

    image: Coarse, the frame's; through: [k, h, w] bool, the reference looked through the pixel's
    place; agrees: [k, h, w] bool, it saw a surface there.
    """

    image: DepthGrid
    violations: NDArray[np.bool_]
    consistent: NDArray[np.bool_]

    def only(self, rows: list[int]) -> "DepthComparison":
        """The same with some of the references."""
        return DepthComparison(self.image, self.violations[rows], self.consistent[rows])

    @property
    def static(self) -> NDArray[np.bool_]:
        """[h, w] bool: a reference saw a surface there and none looked through."""
        return np.asarray(self.consistent.any(axis=0) & ~self.violations.any(axis=0))


class FreeSpaceChecker:
    """The test for one camera. Depth images and masks are as measured, lens and all."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._shape = (camera.height // _STEP, camera.width // _STEP)
        downsample = _STEP * _grid(*self._shape) + _CENTRE
        self._rays = camera.backproject(downsample, np.ones(len(downsample))).T.astype(np.float32)
        to_coarse = np.diag([1 / _STEP, 1 / _STEP, 1.0])
        to_coarse[:2, 2] = -_CENTRE / _STEP
        self._matrix = to_coarse @ camera.matrix()
        where = np.rint(camera.distort(downsample)).astype(np.int64).T
        self._column, self._row = (
            np.clip(p, 0, n - 1) for p, n in zip(where, (camera.width, camera.height), strict=True)
        )
        self._measured = _maps((camera.distort(downsample) - _CENTRE) / _STEP, self._shape)
        whole = (camera.height, camera.width)
        flat = cv2.convertMaps(
            *_maps(camera.undistort(_grid(*whole)), whole), cv2.CV_16SC2, nninterpolation=True
        )
        self._flat = flat[0]  # where each pixel would be without distortion, whole px

    def min_depth_grid(self, depth: NDArray[np.float32]) -> DepthGrid:
        """What a keyframe remembers of its depth image [H, W] m: the least around every coarse
        pixel.
        """
        return np.asarray(
            cv2.erode(self._coarse(depth), np.ones((3, 3), np.uint8)), dtype=np.float32
        )

    def compare(
        self, depth: NDArray[np.float32], T_cw: Array, references: list[ReferenceDepth]
    ) -> DepthComparison:
        """depth: [H, W] m, 0 = none; T_cw: [4, 4] the frame's expected pose."""
        image = self._coarse(depth)
        rows = np.flatnonzero(image)
        shape = (len(references), *self._shape)
        violations, consistent = (
            np.zeros((shape[0], image.size), dtype=np.bool_) for _ in range(2)
        )
        if references and len(rows):
            seen, z = self._lookup_depth(
                self._rays[:, rows] * image.ravel()[rows], inverse(T_cw), references
            )
            tolerance = _NEARER + _NEARER_PER_M * z
            violations[:, rows] = (seen - z > tolerance) & (z > _NEAR)
            consistent[:, rows] = (seen > 0) & (np.abs(seen - z) <= tolerance) & (z > _NEAR)
        return DepthComparison(image, violations.reshape(shape), consistent.reshape(shape))

    def find_moving(self, comparison: DepthComparison) -> NDArray[np.bool_]:
        """Returns [h, w] bool, coarse: what two references looked through, and its surface around
        it.
        """
        image, votes = comparison.image, np.count_nonzero(comparison.violations, axis=0)
        return _grown(
            votes >= min(_VOTES, max(len(comparison.violations) - 1, 1)), comparison.static, image
        )

    def downsample(self, picture: NDArray[_Value]) -> NDArray[_Value]:
        """picture: [H, W] as measured. Returns [h, w]: what it says in the middle of every coarse
        pixel.
        """
        return np.asarray(picture[self._row, self._column]).reshape(self._shape)

    def upsample(self, find_moving: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """movers: [h, w] bool, coarse. Returns [H, W] bool, the same in the image as measured."""
        if not find_moving.any():
            return np.zeros((self.camera.height, self.camera.width), dtype=np.bool_)
        size = (_STEP * self._shape[1], _STEP * self._shape[0])
        smooth = cv2.resize(
            find_moving.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR
        )
        return np.asarray(cv2.remap(smooth, self._flat, np.empty(0), cv2.INTER_NEAREST) > 127)

    def static_components(
        self, mask: NDArray[np.bool_], comparison: DepthComparison
    ) -> NDArray[np.bool_]:
        """The connected parts of a mask [H, W] that lie where every reference that could see them
        saw a surface.

        Returns [H, W] bool. Movement within the tolerance of depth, a seated person's, is not told
        from rest.
        """
        count, parts = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
        downsample = self.downsample(parts)
        readings, static, moved = (
            np.bincount(downsample[chosen], minlength=count)
            for chosen in (
                comparison.image > 0,
                comparison.static,
                comparison.violations.any(axis=0),
            )
        )
        rests = (static >= np.maximum(_JUDGED * readings, LEAST)) & (moved <= _MOVED * static)
        rests[0] = False
        return np.asarray(rests[parts]) if rests.any() else np.zeros_like(mask)

    def _coarse(self, depth: NDArray[np.float32]) -> DepthGrid:
        """The least reading of every block, 0 where less than half of it has one."""
        h, w = self._shape
        depth = depth[: h * _STEP, : w * _STEP]
        # Read as integers, floats from 0 up keep their order; one less, and 0, no reading, becomes
        # the largest.
        bits = (depth.view(np.uint32) - np.uint32(1)).reshape(h, _STEP, w * _STEP).min(axis=1)
        bits = np.ascontiguousarray(bits.reshape(h, w, _STEP).transpose(2, 0, 1)).min(axis=0)
        least = (bits + np.uint32(1)).view(np.float32)
        known = (depth > 0).view(np.uint8) * np.uint8(128)
        share = cv2.resize(
            known, (w, h), interpolation=cv2.INTER_AREA
        )  # mean: 64 is half of a block
        image = np.where((share >= 64) & (least < _FAR), least, 0.0).astype(np.float32)
        return np.asarray(cv2.remap(image, *self._measured, cv2.INTER_NEAREST), dtype=np.float32)

    def _lookup_depth(
        self, points: NDArray[np.float32], T_wc: Array, references: list[ReferenceDepth]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """points: [3, n] in the frame T_wc, m. Returns [k, n] m: the depth each reference has
        there, and that of the points from it. float32: that is a hundredth of a coarse pixel, and
        half the time."""
        h, w = self._shape
        T = np.stack([reference.T_cw for reference in references]) @ T_wc
        bent = np.concatenate(
            [self._matrix @ T[:, :3, :3], self._matrix @ T[:, :3, 3:]], axis=2
        ).astype(np.float32)
        local = (bent[:, :, :3].reshape(-1, 3) @ points).reshape(len(references), 3, -1) + bent[
            :, :, 3:
        ]
        z = local[:, 2]
        places = local[:, :2] / np.maximum(z, np.float32(_NEAR))[:, None] + np.float32(
            1.5
        )  # of the image with a rim
        x, y = (
            np.clip(places[:, axis], 0, size + 1).astype(np.int32)
            for axis, size in ((0, w), (1, h))
        )
        rimmed = np.zeros((len(references), h + 2, w + 2), dtype=np.float32)
        for image, reference in zip(rimmed, references, strict=True):
            image[1:-1, 1:-1] = reference.nearest
        first = np.arange(len(references), dtype=np.int32)[:, None] * ((h + 2) * (w + 2))
        return rimmed.ravel().take(first + y * (w + 2) + x), z


def _grid(height: int, width: int) -> Array:
    """[height * width, 2] (x, y) of an image's pixels, row by row."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def _maps(places: Array, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places [h * w, 2] as cv2.remap takes them."""
    x, y = places.astype(np.float32).T
    return x.reshape(shape), y.reshape(shape)


def _grown(
    found: NDArray[np.bool_], static: NDArray[np.bool_], image: DepthGrid
) -> NDArray[np.bool_]:
    """Specks dropped; the rest grown over its own surface, as far as that is not known to stand
    still.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=8)
    big = stats[:, cv2.CC_STAT_AREA] >= LEAST
    big[0] = False
    kept = big[labels]
    for _ in range(_GROWTH):
        beside = cv2.dilate(
            np.where(kept, image, 0.0).astype(np.float32), _CROSS
        )  # depth of the mover next to it
        kept |= (beside > 0) & (image > 0) & ~static & (np.abs(beside - image) < JUMP)
    return np.asarray(cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_CLOSE, _CROSS) > 0)
