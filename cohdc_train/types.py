"""Names for array types. Shapes, units and value ranges are in the docstrings of their users."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
Image = NDArray[np.uint8]  # [H, W, 3], RGB unless the docstring says otherwise
Mask = NDArray[np.bool_]  # [H, W]
Row = dict[str, Any]  # an object of a JSON file, for example a COCO annotation
