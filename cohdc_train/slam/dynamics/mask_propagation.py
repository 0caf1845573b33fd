"""Propagation of masks from the frame they were made for to later frames.

All of it runs at half the width and height, where optical flow costs a quarter. One step from a
frame to the next:

1. DIS optical flow tells where each pixel of the new frame was in the old one; the mask is sampled
   there.
2. Depth gate: a pixel stays in the mask if its depth has changed by no more than 0.3 m.
3. Depth edge: in a narrow band around the mask's edge, a pixel belongs to the mask if its depth is
   that of the mask nearby. Where the background nearby is as deep, flow alone decides.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MaskConfig
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.types import Mask

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class HalfResFrame:
    """Frame at half the width and height.

    Attributes:
        gray: [h, w] uint8.
        depth: [h, w] m, 0 = no reading.
    """

    gray: NDArray[np.uint8]
    depth: Floats


def downsample(rgb: NDArray[np.uint8], depth: Floats) -> HalfResFrame:
    """Halve a frame; every second depth reading is taken, because a mean would mix surfaces.

    Args:
        rgb: [H, W, 3].
        depth: [H, W] m.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    half_depth = np.ascontiguousarray(depth[::2, ::2])
    height, width = half_depth.shape
    half_gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA)
    return HalfResFrame(np.asarray(half_gray, dtype=np.uint8), half_depth)


def downsample_mask(mask: Mask) -> Mask:
    """Halve a mask [H, W]; a pixel of the result is True where two of four are."""
    height, width = mask.shape
    size = ((width + 1) // 2, (height + 1) // 2)
    mean = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA)
    return np.asarray(mean > 127)


@dataclass(frozen=True)
class _PassedFrame:
    """Frame that masks are propagated through. flow: [h, w, 2] px in the frame before it."""

    number: int
    frame: HalfResFrame
    flow: Floats


class MaskPropagator:
    """Propagator that keeps the newest mask at the newest frame.

    `advance` takes each frame. `update` takes a mask when one is ready, also of an earlier frame:
    it is propagated through all frames since.
    """

    def __init__(self, config: MaskConfig = MaskConfig()) -> None:
        """Start without a mask."""
        self._config = config
        # Any: OpenCV's stubs do not know that the initial flow may be None.
        self._optical_flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._frames: deque[_PassedFrame] = deque(maxlen=self._config.max_history)
        self._grid: Floats | None = None
        self._mask: Mask | None = None
        self._number = 0

    def advance(self, frame: HalfResFrame) -> int:
        """Propagate the mask to the next frame. Returns the number of this frame: 1, 2, ..."""
        before = self._frames[-1].frame if self._frames else frame
        flow = self._flow_between(before, frame)
        self._number += 1
        self._frames.append(_PassedFrame(self._number, frame, flow))
        if self._mask is not None:
            self._mask = propagate(self._mask, before, frame, flow, self._config)
        return self._number

    def update(self, mask: Mask, number: int, frame: HalfResFrame) -> None:
        """Replace the mask by one that was made for an earlier frame.

        Args:
            mask: [h, w] bool.
            number: of its frame, as `advance` returned it.
            frame: its frame.
        """
        later = [passed for passed in self._frames if passed.number > number]
        if later and later[0].number > number + 1:
            # The frames in between are forgotten: one step leads to the newest.
            newest = later[-1].frame
            flow = self._flow_between(frame, newest)
            later = [_PassedFrame(self._number, newest, flow)]
        for passed in later:
            mask = propagate(mask, frame, passed.frame, passed.flow, self._config)
            frame = passed.frame
        self._mask = mask

    def mask(self) -> Mask | None:
        """Return the mask [h, w] bool at the newest frame; None before the first mask."""
        return self._mask

    def _flow_between(self, old: HalfResFrame, new: HalfResFrame) -> Floats:
        """Return the place in the old frame of each pixel of the new frame: [h, w, 2] px."""
        if self._grid is None:
            rows, columns = np.indices(new.gray.shape, dtype=np.float32)
            self._grid = np.stack([columns, rows], axis=-1)
        if old is new:
            return self._grid
        shift = self._optical_flow.calc(new.gray, old.gray, None)
        return np.asarray(self._grid + shift, dtype=np.float32)


def propagate(
    mask: Mask,
    old: HalfResFrame,
    new: HalfResFrame,
    flow: Floats,
    config: MaskConfig = MaskConfig(),
) -> Mask:
    """Propagate a mask by one step.

    A pixel that was outside the old frame takes the value at its border: a person who was cut off
    there walks in.

    Args:
        mask: [h, w] bool at the old frame.
        old: the old frame.
        new: the new frame.
        flow: [h, w, 2] px, place in the old frame of each pixel of the new frame.
        config: thresholds.

    Returns:
        [h, w] bool at the new frame.
    """
    if not mask.any():
        return mask
    columns, rows = flow[..., 0], flow[..., 1]
    border = cv2.BORDER_REPLICATE
    values = mask.astype(np.uint8) * 255
    sampled = cv2.remap(values, columns, rows, cv2.INTER_LINEAR, borderMode=border)
    old_depth = cv2.remap(old.depth, columns, rows, cv2.INTER_NEAREST, borderMode=border)
    both_known = (new.depth > 0) & (old_depth > 0)
    depth_changed = both_known & (np.abs(new.depth - old_depth) > config.max_depth_change_m)
    return snap_to_depth((sampled > 127) & ~depth_changed, new.depth, config)


def snap_to_depth(mask: Mask, depth: Floats, config: MaskConfig = MaskConfig()) -> Mask:
    """Move the edge of a mask to the depth edge nearby.

    Pixels stay as they are without depth, far from the mask's interior, and where interior and
    background are equally deep, as feet and the floor are.

    Args:
        mask: [h, w] bool.
        depth: [h, w] m, 0 = no reading.
        config: width of the band around the edge, and the depth tolerance.

    Returns:
        [h, w] bool.
    """
    side = 2 * config.edge_band_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    values, has_depth = mask.astype(np.uint8), depth > 0
    reached, interior = cv2.dilate(values, disc) > 0, cv2.erode(values, disc) > 0

    interior_nearby, as_interior = _compare_depth(interior & has_depth, depth, config)
    _, as_background = _compare_depth(~reached & has_depth, depth, config)
    in_band = reached & ~interior & has_depth
    decided = in_band & interior_nearby & ~(as_interior & as_background)
    return np.where(decided, as_interior, mask)


def _compare_depth(region: Mask, depth: Floats, config: MaskConfig) -> tuple[Mask, Mask]:
    """Compare each pixel's depth with the mean depth of a region in the window around it.

    Returns:
        [h, w] bool, True = some of the region lies in the window; and [h, w] bool, True = equally
        deep.
    """
    window = (config.window_px, config.window_px)
    weight = region.astype(np.float32)
    share = cv2.boxFilter(weight, -1, window)
    sums = cv2.boxFilter(weight * depth, -1, window)
    # Multiplied by the share instead of divided, so that an empty window needs no special case.
    equally_deep = np.abs(depth * share - sums) < config.max_depth_change_m * share
    return share > 1e-4, equally_deep


@dataclass(frozen=True)
class SegmentationJob:
    """Frame that may be segmented.

    Attributes:
        number: of the frame, as `MaskPropagator.advance` counts.
        frame: at full size.
        half: the frame at half size.
    """

    number: int
    frame: RGBDFrame
    half: HalfResFrame


class PropagatedMask:
    """Newest mask of a segmenter, propagated to each frame and dilated there.

    Attributes:
        newest: the frame that the mask was made for; None before the first.
    """

    def __init__(self, config: MaskConfig = MaskConfig()) -> None:
        """Start without a mask."""
        self.newest: SegmentationJob | None = None
        self._dilation_px = 0.0
        self._propagator = MaskPropagator(config)

    def advance(self, frame: RGBDFrame) -> SegmentationJob:
        """Propagate the mask to the next frame. Returns a job to segment this frame."""
        half = downsample(frame.rgb, frame.depth)
        return SegmentationJob(self._propagator.advance(half), frame, half)

    def update(self, job: SegmentationJob, mask: Mask, dilation_px: float) -> None:
        """Replace the mask by that of a finished job.

        Args:
            job: of this or an earlier frame.
            mask: [h, w] bool, half size.
            dilation_px: dilation that is due, px at full size.
        """
        self.newest = job
        self._dilation_px = dilation_px
        self._propagator.update(mask, job.number, job.half)

    def mask(self, frame: RGBDFrame) -> Mask:
        """Return the dilated mask [H, W] bool at the newest frame; all False before the first mask.

        frame: the newest frame, for its size.
        """
        height, width = frame.rgb.shape[:2]
        mask = self._propagator.mask()
        if mask is None:
            return np.zeros((height, width), dtype=np.bool_)
        dilated = dilate_mask(mask, self._dilation_px / 2).astype(np.uint8)
        full = cv2.resize(dilated, (width, height), interpolation=cv2.INTER_NEAREST)
        return np.asarray(full > 0)
