"""Colored points as PLY, which MeshLab, CloudCompare, Blender and Open3D read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.files import write_bytes

_VERTEX = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])
# Bytes of map.ply and cloud.ply are compared between versions: the comment keeps its spelling.
_HEADER = """ply
format binary_little_endian 1.0
comment metres; x right, y down, z forward of the first camera
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def write_ply(path: Path, points: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
    """Write points as binary little-endian PLY, whole or not at all.

    Args:
        path: of the file.
        points: [n, 3] m.
        colors: [n, 3] uint8 RGB.
    """
    rows = np.empty(len(points), dtype=_VERTEX)
    rows["position"] = points
    rows["color"] = colors
    write_bytes(path, _HEADER.format(count=len(points)).encode("ascii") + rows.tobytes())
