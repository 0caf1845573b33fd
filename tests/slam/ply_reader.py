"""Smallest reader of the PLY files that a run writes."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return the points [n, 3] and colors [n, 3] of a binary PLY file with fixed rows."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    words = head.decode("ascii").split("\n")
    assert words[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in words if line.startswith("element vertex"))
    kinds = {"float": "<f4", "uchar": "u1"}
    rows = np.frombuffer(
        body,
        np.dtype([(w[2], kinds[w[1]]) for w in map(str.split, words) if w[:1] == ["property"]]),
    )
    assert len(rows) == count
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return points, np.stack([rows[name] for name in ("red", "green", "blue")], axis=1)
