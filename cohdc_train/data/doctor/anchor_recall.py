"""How well anchors of given scales cover the objects of a folder (numpy, no torch)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cohdc_train.types import FloatArray

STRIDES = (4, 8, 16, 32, 64)  # px, of the pyramid's levels
RATIOS = (0.5, 1.0, 2.0)  # height / width
SIZES = {
    "small": (0.0, 32.0),
    "medium": (32.0, 96.0),
    "large": (96.0, np.inf),
}  # px, COCO's, of sqrt(area)


class AnchorRecall(NamedTuple):
    """Objects of one size on the canvas, and the share of them that an anchor covers at IoU .5 and
    .7.
    """

    size: str
    objects: int
    at_50: float
    at_70: float


def best_overlap(boxes: FloatArray, scales: Sequence[int], canvas: tuple[int, int]) -> FloatArray:
    """The largest IoU of each box with an anchor of torchvision's grid: one scale per level from
    stride 4, 3 ratios.

    boxes: [N, 4] xyxy, px on the canvas; canvas: (height, width), px. Returns [N].
    """
    best = np.zeros(len(boxes))
    for scale, stride in zip(scales, STRIDES, strict=False):
        steps = np.array([-(-canvas[1] // stride), -(-canvas[0] // stride)])
        for ratio in RATIOS:
            # torchvision rounds half an anchor's sides to whole px
            half = np.round(np.array([scale / np.sqrt(ratio), scale * np.sqrt(ratio)]) / 2)
            center = (
                np.round((boxes[:, :2] + boxes[:, 2:]) / 2 / stride).clip(0, steps - 1) * stride
            )
            best = np.maximum(
                best, _iou(boxes, np.concatenate([center - half, center + half], axis=1))
            )
    return best


def recall(boxes: FloatArray, scales: Sequence[int], canvas: tuple[int, int]) -> list[AnchorRecall]:
    """Anchor-to-object recall by size. boxes, canvas: as `best_overlap` takes them; sizes without
    objects are left out.

    RPN training calls an anchor positive from IoU .7, and takes an object's best one in any case.
    """
    overlap = best_overlap(boxes, scales, canvas)
    side = np.sqrt((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    rows = []
    for size, (low, high) in {**SIZES, "all": (0.0, np.inf)}.items():
        chosen = overlap[(side >= low) & (side < high)]
        if len(chosen):
            rows.append(
                AnchorRecall(
                    size, len(chosen), float((chosen >= 0.5).mean()), float((chosen >= 0.7).mean())
                )
            )
    return rows


def _iou(a: FloatArray, b: FloatArray) -> FloatArray:
    """IoU of boxes [N, 4] xyxy, pair by pair."""
    inside = (np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])).clip(0).prod(axis=1)
    areas = [(box[:, 2:] - box[:, :2]).prod(axis=1) for box in (a, b)]
    union = areas[0] + areas[1] - inside
    iou: FloatArray = np.divide(inside, union, out=np.zeros_like(inside), where=union > 0)
    return iou
