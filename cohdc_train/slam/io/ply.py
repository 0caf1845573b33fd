"""Coloured points as PLY, which MeshLab, CloudCompare, Blender and Open3D read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.files import write_bytes

_VERTEX = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])
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
    """Write points ([n, 3], m) with colours ([n, 3] uint8 RGB) as binary little-endian PLY, whole
    or not at all.
    """
    rows = np.empty(len(points), dtype=_VERTEX)
    rows["position"], rows["colour"] = points, colors
    write_bytes(path, _HEADER.format(count=len(points)).encode("ascii") + rows.tobytes())
