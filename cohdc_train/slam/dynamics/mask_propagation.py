"""Masks carried from the frame they were made for to a later one: optical flow moves them, depth
cuts their edge.

Everything here is at half the images' width and height, where flow costs a quarter. One step, from
a frame to the next:

1. DIS optical flow says where every pixel of the new frame was in the old one; the mask is fetched
   from there.
2. Depth gate: a pixel stays in the mask if it is as deep as the pixel it came from, +-0.3 m.
3. Cut by depth: within a narrow band about the edge, a pixel belongs to the mask if it is as deep
   as the mask nearby, unless what lies around the mask is as deep as well: then flow alone says.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.masks import grow
from cohdc_train.slam.frame import View
from cohdc_train.types import Float32Array, Mask

_GATE = 0.3  # m: what moves from one frame to the next keeps its depth
_BAND = 2  # px of half size: how far one step may move the mask's edge to where depth breaks
_NEARBY = 15  # px of half size: window of the mask's own depth
_HISTORY = 45  # frames a late mask is carried through one by one; an older one takes one leap


@dataclass(frozen=True)
class Half:
    """A frame at half size. gray: [h, w] uint8; depth: [h, w] m, 0 = no reading."""

    gray: NDArray[np.uint8]
    depth: Float32Array


def halve(rgb: NDArray[np.uint8], depth: Float32Array) -> Half:
    """rgb: [H, W, 3]; depth: [H, W] m, of which every second reading is taken: a mean would mix
    near and far.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    thin = np.ascontiguousarray(depth[::2, ::2])
    size = (thin.shape[1], thin.shape[0])
    return Half(
        np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), thin
    )


def halve_mask(mask: Mask) -> Mask:
    """[H, W] bool. Returns [h, w] bool of half size, True where half of the four pixels are."""
    size = ((mask.shape[1] + 1) // 2, (mask.shape[0] + 1) // 2)
    return np.asarray(
        cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127
    )


class Propagation:
    """The newest mask, kept at the newest frame.

    `advance` takes every frame; `renew` takes a mask whenever one is ready, which may belong to an
    earlier frame: it is carried through all frames since.
    """

    def __init__(self) -> None:
        # Any: OpenCV's stubs do not know that the flow to start from may be None.
        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._frames: deque[tuple[int, Half, Float32Array]] = deque(
            maxlen=_HISTORY
        )  # number, frame, places in the one before
        self._grid: Float32Array | None = None
        self._mask: Mask | None = None
        self._number = 0

    def advance(self, frame: Half) -> int:
        """Go on to the next frame, and the mask with it. Returns the frame's number, 1, 2, ..."""
        before = self._frames[-1][1] if self._frames else frame
        places = self._places(before, frame)
        self._number += 1
        self._frames.append((self._number, frame, places))
        if self._mask is not None:
            self._mask = carry(self._mask, before, frame, places)
        return self._number

    def renew(self, mask: Mask, number: int, frame: Half) -> None:
        """mask: [h, w] bool of the frame that `advance` gave this number, which has passed."""
        ahead = [entry for entry in self._frames if entry[0] > number]
        if ahead and ahead[0][0] > number + 1:  # so old that the frames between are forgotten
            _, newest, _ = ahead[-1]
            ahead = [(self._number, newest, self._places(frame, newest))]
        for _, later, places in ahead:
            mask = carry(mask, frame, later, places)
            frame = later
        self._mask = mask

    def mask(self) -> Mask | None:
        """[h, w] bool at the newest frame; None before the first mask."""
        return self._mask

    def _places(self, old: Half, new: Half) -> Float32Array:
        """[h, w, 2] px: where every pixel of the new frame was in the old one."""
        if self._grid is None:
            rows, columns = np.indices(new.gray.shape, dtype=np.float32)
            self._grid = np.stack([columns, rows], axis=-1)
        if old is new:
            return self._grid
        return np.asarray(self._grid + self._flow.calc(new.gray, old.gray, None), dtype=np.float32)


def carry(mask: Mask, old: Half, new: Half, places: Float32Array) -> Mask:
    """One step. mask: [h, w] at the old frame; places: [h, w, 2] px in the old frame. Returns [h,
    w] at the new one.

    A pixel that was outside the old frame takes the value at its border: whoever was cut there
    walks in.
    """
    if not mask.any():
        return mask
    columns, rows = places[..., 0], places[..., 1]
    border = cv2.BORDER_REPLICATE
    fetched = cv2.remap(
        mask.astype(np.uint8) * 255, columns, rows, cv2.INTER_LINEAR, borderMode=border
    )
    came_from = cv2.remap(old.depth, columns, rows, cv2.INTER_NEAREST, borderMode=border)
    jumped = (new.depth > 0) & (came_from > 0) & (np.abs(new.depth - came_from) > _GATE)
    return cut_by_depth((fetched > 127) & ~jumped, new.depth)


def cut_by_depth(mask: Mask, depth: Float32Array) -> Mask:
    """Give the band about a mask's edge to what it is as deep as.

    mask: [h, w]; depth: [h, w] m, 0 = no reading. Pixels without depth, without the mask's inside
    nearby to compare with, or where inside and outside are equally deep, as feet and the floor are,
    stay as they are. Returns [h, w].
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _BAND + 1, 2 * _BAND + 1))
    filled, has_depth = mask.astype(np.uint8), depth > 0
    reached, core = cv2.dilate(filled, disc) > 0, cv2.erode(filled, disc) > 0
    near_inside, as_inside = _as_deep(core & has_depth, depth)
    _, as_outside = _as_deep(~reached & has_depth, depth)
    decided = near_inside & has_depth & reached & ~core & ~(as_inside & as_outside)
    return np.where(decided, as_inside, mask)


def _as_deep(part: Mask, depth: Float32Array) -> tuple[Mask, Mask]:
    """Where some of a part of the image [h, w] is nearby, and where depth is its mean there, +-0.3
    m.
    """
    size = (_NEARBY, _NEARBY)
    weight = part.astype(np.float32)
    share, sums = cv2.boxFilter(weight, -1, size), cv2.boxFilter(weight * depth, -1, size)
    return share > 1e-4, np.abs(depth * share - sums) < _GATE * share


@dataclass(frozen=True)
class Job:
    """A frame that may be segmented. number: as Propagation counts."""

    number: int
    view: View
    half: Half


class CarriedMasks:
    """The newest mask there is, carried to every frame, and grown there by what its outline asked
    for.

    newest: the frame that it was made of, None before the first.
    """

    def __init__(self) -> None:
        self.newest: Job | None = None
        self._growth = 0.0
        self._propagation = Propagation()

    def advance(self, view: View) -> Job:
        """Go on to the next view."""
        half = halve(view.rgb, view.depth)
        return Job(self._propagation.advance(half), view, half)

    def renew(self, job: Job, mask: Mask, growth: float) -> None:
        """mask: [h, w] bool of half size, of a frame that has passed; growth: by how many px it is
        to grow.
        """
        self.newest, self._growth = job, growth
        self._propagation.renew(mask, job.number, job.half)

    def mask(self, view: View) -> Mask:
        """[H, W] bool, True = dynamic, for the view that was gone on to."""
        mask = self._propagation.mask()
        assert mask is not None
        height, width = view.rgb.shape[:2]
        grown = grow(mask, self._growth / 2).astype(np.uint8)
        return np.asarray(cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST) > 0)
