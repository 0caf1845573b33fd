"""Coloured points averaged in cubes, in bounded memory: when too many cubes are filled, their edge
doubles.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.se3 import Array

_BITS = 21  # of a key per axis
_HALF = 1 << (_BITS - 1)
_LOW = (1 << _BITS) - 1


class VoxelGrid:
    """Sums of what falls into every cube. edge: m of a cube's side; limit: cubes held before the
    edge doubles.
    """

    def __init__(self, edge: float, limit: int = 4_000_000) -> None:
        self.edge = edge
        self._limit = limit
        self._keys = np.zeros(0, dtype=np.int64)
        self._rows = np.zeros((0, 7))  # sums of x y z (m) and r g b, and how many points
        self._spans = np.zeros(
            (0, 2), dtype=np.int32
        )  # first and last picture that filled the cube
        self._waiting: list[tuple[NDArray[np.int64], Array, NDArray[np.int32]]] = []

    def add(self, points: Array, colors: NDArray[np.uint8], picture: int) -> None:
        """points: [n, 3] m; colours: [n, 3] RGB; picture: its number, which tells cubes seen once
        from others.
        """
        cells = np.floor(points / self.edge).astype(np.int64)
        inside = (np.abs(cells) < _HALF).all(axis=1)
        rows = np.column_stack([points, colors, np.ones(len(points))])[inside]
        spans = np.full((len(rows), 2), picture, dtype=np.int32)
        self._waiting.append(_summed(_pack(cells[inside]), rows, spans))
        if sum(len(keys) for keys, _, _ in self._waiting) > max(len(self._keys), 500_000):
            self._settle()

    def cells(self, pictures: int = 2) -> tuple[Array, NDArray[np.uint8]]:
        """The mean point ([n, 3] m) and mean colour ([n, 3] RGB) of every cube that so many
        pictures filled: 1 or 2.
        """
        self._settle()
        keep = slice(None) if pictures < 2 else self._spans[:, 0] != self._spans[:, 1]
        rows = self._rows[keep]
        means = rows[:, :6] / rows[:, 6:]
        return means[:, :3], np.rint(means[:, 3:]).astype(np.uint8)

    def _settle(self) -> None:
        parts = [(self._keys, self._rows, self._spans), *self._waiting]
        self._waiting = []
        keys, rows, spans = (np.concatenate(column) for column in zip(*parts, strict=True))
        self._keys, self._rows, self._spans = _summed(keys, rows, spans)
        while len(self._keys) > self._limit:
            self.edge *= 2
            self._keys, self._rows, self._spans = _summed(
                _pack(_unpack(self._keys) >> 1), self._rows, self._spans
            )


def _pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (cells + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)


def _unpack(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([keys >> 2 * _BITS, (keys >> _BITS) & _LOW, keys & _LOW], axis=1) - _HALF


def _summed(
    keys: NDArray[np.int64], rows: Array, spans: NDArray[np.int32]
) -> tuple[NDArray[np.int64], Array, NDArray[np.int32]]:
    """One row per key: rows added, spans joined; keys rising."""
    if len(keys) == 0:
        return keys, rows, spans
    order = np.argsort(keys, kind="stable")
    keys, rows, spans = keys[order], rows[order], spans[order]
    starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    first, last = np.minimum.reduceat(spans[:, 0], starts), np.maximum.reduceat(spans[:, 1], starts)
    return keys[starts], np.add.reduceat(rows, starts, axis=0), np.stack([first, last], axis=1)
