"""Things move as a whole: what depth finds moving on a part of a surface moves on all of it, and
goes on moving.

A surface is a connected part of a depth image without jumps. Who comes up to the camera is found by
depth where some keyframe has looked through the place; soon most of him is where none has looked,
being too near. He moves until he has been seen at rest, or nothing of him is found any longer.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array

JUMP = (
    0.12  # m of depth from one coarse pixel to the next, from which on they belong to two surfaces
)
LEAST = 8  # coarse px of a mover: smaller ones are noise at edges
_FOUND = 0.4  # share of a surface that must be found moving for all of it to move
_AGAIN = 0.5  # share of it that must have moved in the frame before, to go on
_STILL = 0.3  # share of it, at most, that is known to have stood there
_LASTS = 0.5  # s for which a surface goes on that is neither found, not even in part, nor masked
_BAND = 3  # coarse px: a mask is so much wider than what it covers, at most
_MOST = 0.95  # of the readings: so many movers mean that the pose is wrong

Bits = NDArray[np.bool_]  # [h, w], coarse


class MovingSurfaceTracker:
    """Remembers what moved in the latest frame."""

    def __init__(self) -> None:
        self._latest: NDArray[np.float32] | None = (
            None  # [h, w] m, depth of what moved, 0 elsewhere
        )
        self._seen: NDArray[np.float64] | None = (
            None  # [h, w] s, when it was last found or masked, -inf elsewhere
        )
        self._masked: Bits | None = None

    def forget(self) -> None:
        """The camera may be elsewhere."""
        self._latest = self._seen = self._masked = None

    def whole(
        self,
        t: float,
        found: Bits,
        stood: Bits,
        rested: Bits,
        image: NDArray[np.float32],
        masked: Bits,
    ) -> Bits:
        """What moves beside the mask: the parts found to, and surfaces of which enough is found, or
        moved just now.

        t: s, of the frame; found: [h, w] bool, seen to move; stood, rested: [h, w] bool, known to
        have stood there a moment ago and long ago; image: [h, w] m, 0 = unknown; masked: [h, w]
        bool, given as moving: no part of a surface, or a floor would be one with those who stand on
        it, but when the mask misses it later on, it goes on.
        """
        if not (image > 0).any():
            return np.zeros_like(found)
        known, before = (image > 0) & ~masked, np.zeros_like(found)
        if self._latest is not None:
            before = (self._latest > 0) & (np.abs(self._latest - image) < JUMP)
        labels = surfaces(np.where(known, image, np.float32(0)))
        count = int(labels.max(initial=0)) + 1
        size, hit, again, short, long = (
            np.bincount(labels[chosen & known], minlength=count)
            for chosen in (known, found, before, stood, rested)
        )
        seen = self._last_seen(t, hit, labels, before & known)
        starts = (hit >= _FOUND * size) & (short <= _STILL * size) & (size >= LEAST)
        goes_on = (
            (again >= _AGAIN * size)
            & (long <= _STILL * size)
            & (size >= LEAST)
            & (t - seen <= _LASTS)
        )
        movers = np.asarray(
            known & (found | starts[labels] | (goes_on[labels] & (before | ~stood)))
        )
        if np.count_nonzero(movers) > _MOST * np.count_nonzero(known):
            movers = np.zeros_like(found)
        covered = _covered(masked if self._masked is None else masked & self._masked, image)
        self._latest = np.where(movers | covered, image, np.float32(0))
        self._seen = np.where(covered, t, np.where(movers, seen[labels], -np.inf))
        self._masked = masked
        return movers

    def _last_seen(
        self, t: float, hit: NDArray[np.int64], labels: NDArray[np.int32], before: Bits
    ) -> Array:
        """[surfaces] s, when each was last found to move, if only in part, or masked; -inf where it
        never was.
        """
        seen = np.full(len(hit), -np.inf)
        if self._seen is not None:
            np.maximum.at(seen, labels[before], self._seen[before])
        return np.where(hit >= LEAST, t, seen)


def _covered(masked: Bits, image: NDArray[np.float32]) -> Bits:
    """[h, w] bool: the surfaces under a mask that reach further in than its rim, where it covers
    what lies behind.
    """
    square = np.ones((2 * _BAND + 1, 2 * _BAND + 1), np.uint8)
    inner = (
        cv2.erode(masked.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=(0,))
        > 0
    )
    labels = surfaces(np.where(masked, image, np.float32(0)))
    reaches = np.bincount(labels[inner], minlength=int(labels.max(initial=0)) + 1) >= LEAST
    reaches[0] = False
    return np.asarray(reaches[labels])


def surfaces(image: NDArray[np.float32]) -> NDArray[np.int32]:
    """image: [h, w] m, 0 = unknown. Returns [h, w] int32: the number of every pixel's surface, 0
    where unknown.
    """
    h, w = image.shape
    known = image > 0
    nodes = np.zeros(
        (2 * h - 1, 2 * w - 1), dtype=np.uint8
    )  # pixels, and between them what joins them
    nodes[::2, ::2] = known
    nodes[::2, 1::2] = known[:, 1:] & known[:, :-1] & (np.abs(image[:, 1:] - image[:, :-1]) < JUMP)
    nodes[1::2, ::2] = known[1:] & known[:-1] & (np.abs(image[1:] - image[:-1]) < JUMP)
    _, labels = cv2.connectedComponents(nodes, connectivity=4)
    return np.ascontiguousarray(labels[::2, ::2], dtype=np.int32)
