"""Detections drawn over their image."""

from collections.abc import Sequence

import cv2
import numpy as np

from cohdc_train.contour import Polygon
from cohdc_train.drawing import Color, fill_mask
from cohdc_train.segmenter import Detections
from cohdc_train.types import Float32Array, Image

# Neighbors in the list differ in hue, so that people next to each other can be told apart.
_COLORS: tuple[Color, ...] = (
    (230, 25, 75),
    (60, 180, 75),
    (0, 130, 200),
    (245, 130, 48),
    (145, 30, 180),
    (70, 240, 240),
    (240, 50, 230),
)
_WHITE: Color = (255, 255, 255)
_OPACITY = 0.45  # of a filled mask
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_REFERENCE_SIDE_PX = 640  # longer side of an image with lines and letters at scale 1


def draw_detections(
    rgb: Image, detections: Detections, outlines: Sequence[Sequence[Polygon]]
) -> Image:
    """Draw the mask, outline, class, score and quality of each detection over a copy of an image.

    Args:
        rgb: uint8 [H, W, 3].
        detections: of the image.
        outlines: polygons of each detection.

    Returns:
        uint8 [H, W, 3].
    """
    canvas = rgb.copy()
    masks = detections.masks()
    scale = max(rgb.shape[0], rgb.shape[1]) / _REFERENCE_SIDE_PX
    for row, polygons in enumerate(outlines):
        color = _color(row)
        fill_mask(canvas, masks[row], color, _OPACITY)
        _draw_outline(canvas, polygons, color, scale)
    for row in range(len(detections)):
        name = detections.class_names[detections.labels[row]]
        score, quality = detections.scores[row], detections.quality[row]
        text = f"{name} {score:.2f} q{quality:.2f}"
        _draw_label(canvas, text, detections.boxes[row], _color(row), scale)
    return canvas


def _color(row: int) -> Color:
    return _COLORS[row % len(_COLORS)]


def _draw_outline(canvas: Image, polygons: Sequence[Polygon], color: Color, scale: float) -> None:
    thickness = max(1, round(1.5 * scale))
    rings = []
    for polygon in polygons:
        # OpenCV's coordinates start at the center of the first pixel.
        rings += [np.round(ring - 0.5).astype(np.int32) for ring in polygon.rings]
    cv2.polylines(canvas, rings, True, color, thickness, cv2.LINE_AA)


def _draw_label(canvas: Image, text: str, box: Float32Array, color: Color, scale: float) -> None:
    """Write text on a filled rectangle above a box. box: [4] xyxy, px."""
    font_scale = 0.45 * scale
    thickness = max(1, round(2 * font_scale))
    (text_width, text_height), _ = cv2.getTextSize(text, _FONT, font_scale, thickness)
    max_x = max(canvas.shape[1] - text_width - 4, 0)
    max_y = max(canvas.shape[0] - 2, text_height + 6)
    x = int(np.clip(box[0], 0, max_x))
    y = int(np.clip(box[1], text_height + 6, max_y))

    top_left = (x, y - text_height - 6)
    bottom_right = (x + text_width + 4, y)
    cv2.rectangle(canvas, top_left, bottom_right, color, -1)
    origin = (x + 2, y - 4)
    cv2.putText(canvas, text, origin, _FONT, font_scale, _WHITE, thickness, cv2.LINE_AA)
