"""Random streams that cannot meet: what is drawn for one set is never drawn for another, whatever
the seed.
"""

import numpy as np

_KEYS = {"coco-train": 1, "coco-val": 2, "sequence": 3}


def stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """The generator of one room of one set.

    name: `coco-train`, `coco-val` or `sequence`; index: number of the room. Different (name, index)
    have different spawn keys, so numpy guarantees independent streams. Raises KeyError for another
    name.
    """
    return np.random.default_rng(
        np.random.SeedSequence(entropy=seed, spawn_key=(_KEYS[name], index))
    )
