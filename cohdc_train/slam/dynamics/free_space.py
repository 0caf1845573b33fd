"""Moving objects of any class, found by depth: what stands in space that a keyframe saw free.

The multi-view test of DynaSLAM, dense on a grid of cells: each cell of the frame is placed in the
world by the predicted pose, and compared with the depth of keyframes from other times. A point
clearly nearer than what a keyframe measured in this direction violates free space. A static surface
never does, so two votes suffice. Depth that agrees, or that is occluded, is no evidence of motion.
"""

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FreeSpaceConfig, SurfaceConfig
from cohdc_train.slam.dynamics.moving_surfaces import BoolGrid, DepthGrid
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, inverse

_Value = TypeVar("_Value", bound=np.generic)
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class ReferenceDepth:
    """Depth that a keyframe has measured.

    Attributes:
        T_cw: [4, 4] world to camera, m.
        min_depth: [h, w] m, smallest depth around each cell.
    """

    T_cw: Array
    min_depth: DepthGrid


@dataclass(frozen=True)
class DepthComparison:
    """Depth of a frame compared with that of k keyframes, per cell [h, w].

    Attributes:
        depth: [h, w] m, of the frame.
        violations: [k, h, w] bool, True = the point lies in space that the keyframe saw free.
        consistent: [k, h, w] bool, True = the keyframe saw a surface there.
    """

    depth: DepthGrid
    violations: NDArray[np.bool_]
    consistent: NDArray[np.bool_]

    def select(self, rows: list[int]) -> "DepthComparison":
        """Return the comparison with some of the keyframes."""
        return DepthComparison(self.depth, self.violations[rows], self.consistent[rows])

    @property
    def static(self) -> BoolGrid:
        """Cells [h, w] where a keyframe saw a surface and none saw free space."""
        return np.asarray(self.consistent.any(axis=0) & ~self.violations.any(axis=0))


class FreeSpaceChecker:
    """Free-space test for the frames of one camera, with depth images and masks as measured."""

    def __init__(
        self,
        camera: Camera,
        config: FreeSpaceConfig = FreeSpaceConfig(),
        surfaces: SurfaceConfig = SurfaceConfig(),
    ) -> None:
        """Prepare the grid of cells.

        Args:
            camera: of the frames; its distortion is taken into account.
            config: grid and thresholds of the test.
            surfaces: what makes a connected surface.
        """
        self.camera = camera
        self.config = config
        self.surfaces = surfaces
        cell = self.config.cell_px
        center = (cell - 1) / 2
        self._shape = (camera.height // cell, camera.width // cell)

        centers = cell * _pixel_grid(*self._shape) + center  # undistorted px
        self._rays = camera.backproject(centers, np.ones(len(centers))).T.astype(np.float32)
        to_cells = np.diag([1 / cell, 1 / cell, 1.0])
        to_cells[:2, 2] = -center / cell
        self._matrix = to_cells @ camera.matrix()

        measured = camera.distort(centers)
        columns, rows = np.rint(measured).astype(np.int64).T
        self._column = np.clip(columns, 0, camera.width - 1)
        self._row = np.clip(rows, 0, camera.height - 1)
        self._measured = _remap_arguments((measured - center) / cell, self._shape)

        size = (camera.height, camera.width)
        maps = _remap_arguments(camera.undistort(_pixel_grid(*size)), size)
        # The undistorted place of each pixel, in whole px.
        self._undistorted = cv2.convertMaps(*maps, cv2.CV_16SC2, nninterpolation=True)[0]

    def min_depth_grid(self, depth: NDArray[np.float32]) -> DepthGrid:
        """Return the smallest depth around each cell, which a keyframe stores. depth: [H, W] m."""
        nearest = cv2.erode(self._cell_depth(depth), np.ones((3, 3), np.uint8))
        return np.asarray(nearest, dtype=np.float32)

    def compare(
        self, depth: NDArray[np.float32], T_cw: Array, references: list[ReferenceDepth]
    ) -> DepthComparison:
        """Compare the depth of a frame with that of keyframes.

        Args:
            depth: [H, W] m, 0 = no reading.
            T_cw: [4, 4] predicted pose of the frame.
            references: depth of k keyframes.
        """
        config = self.config
        cell_depth = self._cell_depth(depth)
        known = np.flatnonzero(cell_depth)
        flat, shape = (len(references), cell_depth.size), (len(references), *self._shape)
        violations, consistent = np.zeros(flat, dtype=np.bool_), np.zeros(flat, dtype=np.bool_)
        if references and len(known):
            points = self._rays[:, known] * cell_depth.ravel()[known]
            measured, z = self._lookup_depth(points, inverse(T_cw), references)
            tolerance = config.min_violation_m + config.min_violation_per_m * z
            in_front = z > config.min_depth_m
            close = np.abs(measured - z) <= tolerance
            violations[:, known] = (measured - z > tolerance) & in_front
            consistent[:, known] = (measured > 0) & close & in_front
        return DepthComparison(cell_depth, violations.reshape(shape), consistent.reshape(shape))

    def find_moving(self, comparison: DepthComparison) -> BoolGrid:
        """Find the cells [h, w] that enough keyframes saw free, and their surface around them."""
        num_references = len(comparison.violations)
        votes = np.count_nonzero(comparison.violations, axis=0)
        needed = min(self.config.min_votes, max(num_references - 1, 1))
        return self._grow(votes >= needed, comparison)

    def downsample(self, image: NDArray[_Value]) -> NDArray[_Value]:
        """Take the pixel at the center of each cell. image: [H, W] as measured; returns [h, w]."""
        return np.asarray(image[self._row, self._column]).reshape(self._shape)

    def upsample(self, cells: BoolGrid) -> NDArray[np.bool_]:
        """Draw cells [h, w] bool, with smooth outlines, into an image as measured [H, W] bool."""
        if not cells.any():
            return np.zeros((self.camera.height, self.camera.width), dtype=np.bool_)
        height, width = self._shape
        size = (self.config.cell_px * width, self.config.cell_px * height)
        smooth = cv2.resize(cells.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
        measured = cv2.remap(smooth, self._undistorted, np.empty(0), cv2.INTER_NEAREST)
        return np.asarray(measured > 127)

    def static_components(
        self, mask: NDArray[np.bool_], comparison: DepthComparison
    ) -> NDArray[np.bool_]:
        """Select the connected components of a mask where keyframes saw the same surface.

        Movement within the tolerance of depth, such as a seated person's, counts as static.

        Args:
            mask: [H, W] bool.
            comparison: with keyframes old enough to tell.

        Returns:
            [H, W] bool.
        """
        num_components, components = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
        labels = self.downsample(components)

        def count(cells: BoolGrid) -> NDArray[np.int64]:
            return np.bincount(labels[cells], minlength=num_components)

        num_known = count(comparison.depth > 0)
        num_static = count(comparison.static)
        num_moving = count(np.asarray(comparison.violations.any(axis=0)))
        needed = np.maximum(self.config.min_static_ratio * num_known, self.surfaces.min_area)
        is_static = num_static >= needed
        is_static &= num_moving <= self.config.max_moving_ratio * num_static
        is_static[0] = False  # the background
        return np.asarray(is_static[components]) if is_static.any() else np.zeros_like(mask)

    def _cell_depth(self, depth: NDArray[np.float32]) -> DepthGrid:
        """Return the smallest reading of each cell, 0 where less than half of the cell has one."""
        cell, (h, w) = self.config.cell_px, self._shape
        depth = depth[: h * cell, : w * cell]
        # Read as integers, floats from 0 up keep their order. Minus one, 0 (no reading) becomes the
        # largest integer, so that the minimum ignores it.
        bits = (depth.view(np.uint32) - np.uint32(1)).reshape(h, cell, w * cell).min(axis=1)
        bits = np.ascontiguousarray(bits.reshape(h, w, cell).transpose(2, 0, 1)).min(axis=0)
        nearest = (bits + np.uint32(1)).view(np.float32)

        # INTER_AREA takes the mean: 64 of 128 says that half of the cell has a reading.
        has_reading = (depth > 0).view(np.uint8) * np.uint8(128)
        filled = cv2.resize(has_reading, (w, h), interpolation=cv2.INTER_AREA) >= 64
        usable = filled & (nearest < self.config.max_depth_m)
        cells = np.where(usable, nearest, 0.0).astype(np.float32)
        return np.asarray(cv2.remap(cells, *self._measured, cv2.INTER_NEAREST), dtype=np.float32)

    def _lookup_depth(
        self, points: NDArray[np.float32], T_wc: Array, references: list[ReferenceDepth]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Look up the depth that keyframes measured in the direction of points.

        float32 errs by a hundredth of a cell and halves the time.

        Args:
            points: [3, n] m in the camera frame of T_wc.
            T_wc: [4, 4] camera to world.
            references: depth of k keyframes.

        Returns:
            [k, n] m measured depth, 0 = none, and [k, n] m depth of the points.
        """
        h, w = self._shape
        T = np.stack([reference.T_cw for reference in references]) @ T_wc
        rotation, offset = self._matrix @ T[:, :3, :3], self._matrix @ T[:, :3, 3:]
        projection = np.concatenate([rotation, offset], axis=2).astype(np.float32)
        turned = projection[:, :, :3].reshape(-1, 3) @ points
        local = turned.reshape(len(references), 3, -1) + projection[:, :, 3:]
        z = local[:, 2]

        # A border of one cell without depth takes what falls outside the image; +0.5 rounds.
        safe_z = np.maximum(z, np.float32(self.config.min_depth_m))
        places = local[:, :2] / safe_z[:, None] + np.float32(1.5)
        x = np.clip(places[:, 0], 0, w + 1).astype(np.int32)
        y = np.clip(places[:, 1], 0, h + 1).astype(np.int32)
        padded = np.zeros((len(references), h + 2, w + 2), dtype=np.float32)
        for image, reference in zip(padded, references, strict=True):
            image[1:-1, 1:-1] = reference.min_depth
        first = np.arange(len(references), dtype=np.int32)[:, None] * ((h + 2) * (w + 2))
        return padded.ravel().take(first + y * (w + 2) + x), z

    def _grow(self, found: BoolGrid, comparison: DepthComparison) -> BoolGrid:
        """Drop specks, and grow the rest over its own surface where that is not known as static."""
        depth = comparison.depth
        components = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=8)
        _, labels, stats, _ = components
        is_large = stats[:, cv2.CC_STAT_AREA] >= self.surfaces.min_area
        is_large[0] = False  # the background
        moving = is_large[labels]
        may_move = (depth > 0) & ~comparison.static
        for _ in range(self.config.growth_cells):
            # Depth of the moving cell next to each cell, 0 where there is none.
            neighbor = cv2.dilate(np.where(moving, depth, 0.0).astype(np.float32), _CROSS)
            connected = np.abs(neighbor - depth) < self.surfaces.depth_jump_m
            moving |= (neighbor > 0) & may_move & connected
        return np.asarray(cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_CLOSE, _CROSS) > 0)


def _pixel_grid(height: int, width: int) -> Array:
    """Return the coordinates (x, y) of an image's pixels, row by row: [height * width, 2]."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def _remap_arguments(
    pixels: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Convert pixels [h * w, 2] to the two maps that cv2.remap takes."""
    x, y = pixels.astype(np.float32).T
    return x.reshape(shape), y.reshape(shape)
