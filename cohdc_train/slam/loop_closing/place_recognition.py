"""Recognising a place without a vocabulary: binary descriptors vote for the keyframes that hold
nearly the same.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.descriptors import bits_of

_TABLES = 8
_BITS = 16  # of 256, drawn per table: two descriptors meet in a table when all these agree


class PlaceRecognizer:
    """An index over keyframes by locality-sensitive hashing.

    Each table hashes a descriptor by its own random bits. A hash that few keyframes hold says much,
    one that many hold says little: votes are weighed by inverse document frequency.
    """

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self._bits = np.stack([rng.choice(256, _BITS, replace=False) for _ in range(_TABLES)])
        self._holders = np.zeros(_TABLES << _BITS, dtype=np.int32)  # keyframes per hash
        self._hashes: dict[int, NDArray[np.int64]] = {}

    def add(self, index: int, descriptors: NDArray[np.uint64]) -> None:
        """The next keyframe. descriptors: [n, 4]."""
        hashes = self._hash(descriptors)
        self._holders[hashes] += 1
        self._hashes[index] = hashes

    def remove(self, index: int) -> None:
        """Take out a keyframe."""
        self._holders[self._hashes.pop(index)] -= 1

    def similarity(self, descriptors: NDArray[np.uint64]) -> NDArray[np.float64]:
        """descriptors: [n, 4]. Returns [keyframes] 0..1, the weighed share of the hashes that each
        one has too, in the order they were added."""
        hashes = self._hash(descriptors)
        weight = np.zeros(_TABLES << _BITS, dtype=np.float32)
        weight[hashes] = np.log((len(self._hashes) + 1) / np.maximum(self._holders[hashes], 1))
        total = float(weight[hashes].sum())
        votes = np.array([float(weight[held].sum()) for held in self._hashes.values()])
        return votes / max(total, 1e-9)

    def _hash(self, descriptors: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Sorted hashes without repetition: a pattern that repeats in one picture votes once."""
        keys = bits_of(descriptors)[:, self._bits].astype(np.int64) @ (1 << np.arange(_BITS))
        return np.unique(keys + (np.arange(_TABLES) << _BITS))
