"""Voxel grid that averages colored points in bounded memory."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array

_BITS = 21  # per axis, so that a key of three fits into an int64
_HALF = 1 << (_BITS - 1)
_LOW = (1 << _BITS) - 1
_MIN_BATCH = 500_000  # voxels that wait before they are merged, at least


class VoxelGrid:
    """Sums of the points in each voxel.

    Attributes:
        edge: side of a voxel, m; it doubles when there are too many voxels.
    """

    def __init__(self, edge: float, max_voxels: int) -> None:
        """Start with an empty grid.

        Args:
            edge: side of a voxel, m.
            max_voxels: number of voxels above which the side doubles.
        """
        self.edge = edge
        self._max_voxels = max_voxels
        self._keys = np.zeros(0, dtype=np.int64)
        self._sums = np.zeros((0, 7))  # of x y z (m) and r g b, and the number of points
        self._images = np.zeros((0, 2), dtype=np.int32)  # first and last that filled the voxel
        self._waiting: list[tuple[NDArray[np.int64], Array, NDArray[np.int32]]] = []

    def add(self, points: Array, colors: NDArray[np.uint8], image: int) -> None:
        """Add the points of an image.

        Args:
            points: [n, 3] m.
            colors: [n, 3] RGB.
            image: number of the image, which tells voxels seen once from others.
        """
        cells = np.floor(points / self.edge).astype(np.int64)
        inside = (np.abs(cells) < _HALF).all(axis=1)
        rows = np.column_stack([points, colors, np.ones(len(points))])[inside]
        images = np.full((len(rows), 2), image, dtype=np.int32)
        self._waiting.append(_merge(_pack(cells[inside]), rows, images))
        num_waiting = sum(len(keys) for keys, _, _ in self._waiting)
        if num_waiting > max(len(self._keys), _MIN_BATCH):
            self._merge_waiting()

    def cells(self, min_images: int) -> tuple[Array, NDArray[np.uint8]]:
        """Return the mean point and color of each voxel that enough images filled.

        Args:
            min_images: 1 or 2.

        Returns:
            [n, 3] m, and [n, 3] uint8 RGB.
        """
        self._merge_waiting()
        sums = self._sums
        if min_images > 1:
            sums = sums[self._images[:, 0] != self._images[:, 1]]
        means = sums[:, :6] / sums[:, 6:]
        return means[:, :3], np.rint(means[:, 3:]).astype(np.uint8)

    def _merge_waiting(self) -> None:
        """Merge the voxels that wait, and double the voxels' side while there are too many."""
        parts = [(self._keys, self._sums, self._images), *self._waiting]
        self._waiting = []
        keys, sums, images = (np.concatenate(column) for column in zip(*parts, strict=True))
        self._keys, self._sums, self._images = _merge(keys, sums, images)
        while len(self._keys) > self._max_voxels:
            self.edge *= 2
            coarser = _pack(_unpack(self._keys) >> 1)
            self._keys, self._sums, self._images = _merge(coarser, self._sums, self._images)


def _pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keys [n] of voxels [n, 3]."""
    x, y, z = (cells + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def _unpack(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the voxels [n, 3] of keys [n]."""
    return np.stack([keys >> 2 * _BITS, (keys >> _BITS) & _LOW, keys & _LOW], axis=1) - _HALF


def _merge(
    keys: NDArray[np.int64], sums: Array, images: NDArray[np.int32]
) -> tuple[NDArray[np.int64], Array, NDArray[np.int32]]:
    """Merge rows of the same key; returns rising keys."""
    if len(keys) == 0:
        return keys, sums, images
    order = np.argsort(keys, kind="stable")
    keys, sums, images = keys[order], sums[order], images[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    first = np.minimum.reduceat(images[:, 0], starts)
    last = np.maximum.reduceat(images[:, 1], starts)
    merged_sums = np.add.reduceat(sums, starts, axis=0)
    return keys[starts], merged_sums, np.stack([first, last], axis=1)
