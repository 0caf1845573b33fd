"""Random streams that never overlap: sets share no draws, whatever the seed."""

import numpy as np

_KEYS = {"coco-train": 1, "coco-val": 2, "sequence": 3}


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return the generator of one room of one set.

    Different (name, index) have different spawn keys, so numpy guarantees independent streams.

    Args:
        seed: of all sets.
        name: `coco-train`, `coco-val` or `sequence`.
        index: number of the room.

    Raises:
        KeyError: there is no such name.
    """
    return np.random.default_rng(
        np.random.SeedSequence(entropy=seed, spawn_key=(_KEYS[name], index))
    )
