"""Choose the canvas size from the images of a data set (no torch)."""

import math
import statistics
from collections.abc import Sequence

MAX_AREA_PX = 480 * 640  # HDC-Net n trains on it in minutes on one core
GRID_PX = 32  # stride of the coarsest level that RoIs are pooled from


def choose_canvas(sizes: Sequence[tuple[int, int]], max_area: int = MAX_AREA_PX) -> tuple[int, int]:
    """Choose the canvas that training images are fitted into.

    The median height by the median width of the images, scaled down where it exceeds `max_area`,
    each side rounded to a multiple of GRID_PX.

    Args:
        sizes: (height, width) of every training image, px.
        max_area: largest canvas, px^2, before rounding.

    Returns:
        (height, width), px.
    """
    height = statistics.median(height for height, _ in sizes)
    width = statistics.median(width for _, width in sizes)
    scale = min(1.0, math.sqrt(max_area / (height * width)))
    rows, columns = (
        max(GRID_PX, round(side * scale / GRID_PX) * GRID_PX) for side in (height, width)
    )
    return rows, columns
