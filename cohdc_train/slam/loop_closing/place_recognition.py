"""Place recognition without a vocabulary: hashed binary descriptors vote for keyframes."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import LoopConfig
from cohdc_train.slam.features.descriptors import bits_of


class PlaceRecognizer:
    """Index of keyframes by locality-sensitive hashing of their descriptors.

    Each table hashes a descriptor by random bits of its own, so that similar descriptors meet in
    some tables. Votes are weighted by inverse document frequency: a hash that few keyframes hold
    counts more than one that many hold.
    """

    def __init__(self, config: LoopConfig = LoopConfig(), seed: int = 0) -> None:
        """Draw the bits of each table. config: number of tables and bits; seed: of the draw."""
        rng = np.random.default_rng(seed)
        tables = range(config.hash_tables)
        self._bits = np.stack([rng.choice(256, config.hash_bits, replace=False) for _ in tables])
        self._place_values = 1 << np.arange(config.hash_bits)
        self._table_starts = np.arange(config.hash_tables) << config.hash_bits
        self._num_hashes = config.hash_tables << config.hash_bits
        self._num_holders = np.zeros(self._num_hashes, dtype=np.int32)  # keyframes of each hash
        self._hashes: dict[int, NDArray[np.int64]] = {}

    def add(self, index: int, descriptors: NDArray[np.uint64]) -> None:
        """Add a keyframe. index: of the keyframe; descriptors: [n, 4]."""
        hashes = self._hash(descriptors)
        self._num_holders[hashes] += 1
        self._hashes[index] = hashes

    def remove(self, index: int) -> None:
        """Remove a keyframe."""
        self._num_holders[self._hashes.pop(index)] -= 1

    def similarity(self, descriptors: NDArray[np.uint64]) -> NDArray[np.float64]:
        """Compare an image with all keyframes.

        Args:
            descriptors: [n, 4] of the image.

        Returns:
            [keyframes] 0 to 1, the weighted share of the image's hashes that each keyframe holds,
            in the order in which they were added.
        """
        hashes = self._hash(descriptors)
        num_holders = np.maximum(self._num_holders[hashes], 1)
        weight = np.zeros(self._num_hashes, dtype=np.float32)
        weight[hashes] = np.log((len(self._hashes) + 1) / num_holders)
        total = float(weight[hashes].sum())
        votes = np.array([float(weight[held].sum()) for held in self._hashes.values()])
        return votes / max(total, 1e-9)

    def _hash(self, descriptors: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the sorted hashes of an image; a repetitive pattern counts once."""
        keys = bits_of(descriptors)[:, self._bits].astype(np.int64) @ self._place_values
        return np.unique(keys + self._table_starts)
