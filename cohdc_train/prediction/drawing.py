"""What was found, drawn over the picture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.contour import Polygon
from cohdc_train.drawing import fill_mask
from cohdc_train.segmenter import Detections
from cohdc_train.types import Image

# RGB; neighbours in the list differ in hue, so that people side by side can be told apart
_COLORS = (
    (230, 25, 75),
    (60, 180, 75),
    (0, 130, 200),
    (245, 130, 48),
    (145, 30, 180),
    (70, 240, 240),
    (240, 50, 230),
)
_OPACITY = 0.45  # share of the color in a filled mask


def draw(rgb: Image, found: Detections, outlines: list[list[Polygon]]) -> Image:
    """The image with every object's mask, outline and text (class, score, quality). rgb, result:
    uint8 [H, W, 3].
    """
    canvas = rgb.copy()
    masks = found.masks()
    unit = max(rgb.shape[0], rgb.shape[1]) / 640  # line and letter size grow with the image
    thick = max(1, round(1.5 * unit))
    for row in range(len(found)):
        color = _COLORS[row % len(_COLORS)]
        fill_mask(canvas, masks[row], color, _OPACITY)
        # OpenCV counts from the centre of the first pixel
        rings = [
            np.round(ring - 0.5).astype(np.int32)
            for polygon in outlines[row]
            for ring in polygon.rings
        ]
        cv2.polylines(canvas, rings, True, color, thick, cv2.LINE_AA)
    for row in range(len(found)):
        text = f"{found.class_names[found.labels[row]]} {found.scores[row]:.2f} q{found.quality[row]:.2f}"
        _write_text(canvas, text, found.boxes[row], _COLORS[row % len(_COLORS)], 0.45 * unit)
    return canvas


def _write_text(
    canvas: Image, text: str, box: NDArray[np.float32], color: tuple[int, int, int], scale: float
) -> None:
    thick = max(1, round(2 * scale))
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    x = int(np.clip(box[0], 0, max(canvas.shape[1] - width - 4, 0)))
    y = int(np.clip(box[1], height + 6, max(canvas.shape[0] - 2, height + 6)))
    cv2.rectangle(canvas, (x, y - height - 6), (x + width + 4, y), color, -1)
    cv2.putText(
        canvas,
        text,
        (x + 2, y - 4),
        cv2.FONT_HERSHEY_SIMPLEX,
        scale,
        (255, 255, 255),
        thick,
        cv2.LINE_AA,
    )
