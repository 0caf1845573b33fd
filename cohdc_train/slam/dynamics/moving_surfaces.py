"""Moving surfaces: motion found on a part of a surface is extended to all of it and over time.

A surface is a connected part of a depth image without depth jumps. Free-space violations are found
only where some keyframe has looked past the object; of a person who comes close to the camera, most
lies where no keyframe has measured depth. The surface counts as moving until it is observed at
rest, or until no part of it is found any more.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import SurfaceConfig
from cohdc_train.slam.geometry.se3 import Array

BoolGrid = NDArray[np.bool_]  # [h, w] cells
DepthGrid = NDArray[np.float32]  # [h, w] m, 0 = unknown; without distortion


@dataclass(frozen=True)
class SurfaceEvidence:
    """Observations of one frame, per cell [h, w].

    Attributes:
        depth: m, 0 = unknown.
        moving: True = a free-space violation was found.
        static_recently: True = a surface was observed there a moment ago.
        static_long: True = a surface was observed there long ago.
        masked: True = under the mask of the segmenter. Such cells belong to no surface, or a floor
            would be one surface with the people on it; but they are tracked, so that a person
            whom a later mask misses continues to move.
    """

    depth: DepthGrid
    moving: BoolGrid
    static_recently: BoolGrid
    static_long: BoolGrid
    masked: BoolGrid


@dataclass(frozen=True)
class _Memory:
    """Moving surfaces of the latest frame.

    depth: [h, w] m of moving and masked cells, 0 elsewhere; last_seen: [h, w] s when motion was
    last found there, -inf elsewhere; masked: [h, w] the mask.
    """

    depth: DepthGrid
    last_seen: Array
    masked: BoolGrid


class MovingSurfaceTracker:
    """Tracker of moving surfaces over consecutive frames."""

    def __init__(self, config: SurfaceConfig = SurfaceConfig()) -> None:
        """Start without moving surfaces."""
        self._config = config
        self._memory: _Memory | None = None

    def reset(self) -> None:
        """Forget all moving surfaces."""
        self._memory = None

    def update(self, timestamp: float, evidence: SurfaceEvidence) -> BoolGrid:
        """Extend motion found in some cells to whole surfaces.

        Args:
            timestamp: of the frame, s.
            evidence: of the frame.

        Returns:
            [h, w] bool, True = moving and not masked.
        """
        config = self._config
        depth = evidence.depth
        if not (depth > 0).any():
            return np.zeros_like(evidence.moving)
        visible = (depth > 0) & ~evidence.masked
        moved_before = self._moved_before(depth)
        labels = label_surfaces(np.where(visible, depth, np.float32(0)), config.depth_jump_m)
        num_surfaces = int(labels.max(initial=0)) + 1

        def count(cells: BoolGrid) -> NDArray[np.int64]:
            return np.bincount(labels[cells & visible], minlength=num_surfaces)

        area = count(visible)
        num_moving = count(evidence.moving)
        last_seen = self._last_seen(timestamp, num_moving, labels, moved_before & visible)

        is_large = area >= config.min_area
        starts = is_large & (num_moving >= config.min_moving_ratio * area)
        starts &= count(evidence.static_recently) <= config.max_static_ratio * area

        continues = is_large & (count(moved_before) >= config.min_continued_ratio * area)
        continues &= count(evidence.static_long) <= config.max_static_ratio * area
        continues &= timestamp - last_seen <= config.memory_s

        still_moving = continues[labels] & (moved_before | ~evidence.static_recently)
        moving = visible & (evidence.moving | starts[labels] | still_moving)
        # Where nearly all cells seem to move, the predicted pose is wrong.
        if np.count_nonzero(moving) > config.max_moving_ratio * np.count_nonzero(visible):
            moving = np.zeros_like(moving)

        masked_surfaces = self._masked_surfaces(evidence)
        seen_by_cell = np.where(moving, last_seen[labels], -np.inf)
        self._memory = _Memory(
            depth=np.where(moving | masked_surfaces, depth, np.float32(0)),
            last_seen=np.where(masked_surfaces, timestamp, seen_by_cell),
            masked=evidence.masked,
        )
        return moving

    def _moved_before(self, depth: DepthGrid) -> BoolGrid:
        """Return the cells [h, w] that held a moving surface at this depth in the latest frame."""
        if self._memory is None:
            return np.zeros(depth.shape, dtype=np.bool_)
        before = self._memory.depth
        is_near = np.abs(before - depth) < self._config.depth_jump_m
        return np.asarray((before > 0) & is_near)

    def _last_seen(
        self,
        timestamp: float,
        num_moving: NDArray[np.int64],
        labels: NDArray[np.int32],
        moved_before: BoolGrid,
    ) -> Array:
        """Return when each surface was last found moving, if only in part, or masked.

        Returns:
            [surfaces] s, -inf where never.
        """
        last_seen = np.full(len(num_moving), -np.inf)
        if self._memory is not None:
            cells = moved_before
            np.maximum.at(last_seen, labels[cells], self._memory.last_seen[cells])
        return np.where(num_moving >= self._config.min_area, timestamp, last_seen)

    def _masked_surfaces(self, evidence: SurfaceEvidence) -> BoolGrid:
        """Return the cells [h, w] of surfaces that were masked in this frame and in the latest."""
        masked = evidence.masked
        if self._memory is not None:
            masked = masked & self._memory.masked
        return _covered_surfaces(masked, evidence.depth, self._config)


def _covered_surfaces(masked: BoolGrid, depth: DepthGrid, config: SurfaceConfig) -> BoolGrid:
    """Select the surfaces under a mask that reach past its rim, where it covers the background."""
    side = 2 * config.mask_rim_cells + 1
    kernel = np.ones((side, side), np.uint8)
    # The image border counts as the mask's edge.
    padding, outside = cv2.BORDER_CONSTANT, (0,)
    values = masked.astype(np.uint8)
    inner = cv2.erode(values, kernel, borderType=padding, borderValue=outside) > 0
    labels = label_surfaces(np.where(masked, depth, np.float32(0)), config.depth_jump_m)
    num_surfaces = int(labels.max(initial=0)) + 1
    reaches = np.bincount(labels[inner], minlength=num_surfaces) >= config.min_area
    reaches[0] = False
    return np.asarray(reaches[labels])


def label_surfaces(depth: DepthGrid, depth_jump_m: float) -> NDArray[np.int32]:
    """Assign a number to each connected surface of a depth image.

    Args:
        depth: [h, w] m, 0 = unknown.
        depth_jump_m: step between two cells from which on they belong to two surfaces, m.

    Returns:
        [h, w] int32, 0 where depth is unknown.
    """
    height, width = depth.shape
    known = depth > 0
    joins_right = np.abs(depth[:, 1:] - depth[:, :-1]) < depth_jump_m
    joins_below = np.abs(depth[1:] - depth[:-1]) < depth_jump_m

    # Cells at even coordinates, and between two cells a node that is set where they are connected.
    nodes = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.uint8)
    nodes[::2, ::2] = known
    nodes[::2, 1::2] = known[:, 1:] & known[:, :-1] & joins_right
    nodes[1::2, ::2] = known[1:] & known[:-1] & joins_below
    _, labels = cv2.connectedComponents(nodes, connectivity=4)
    return np.ascontiguousarray(labels[::2, ::2], dtype=np.int32)
