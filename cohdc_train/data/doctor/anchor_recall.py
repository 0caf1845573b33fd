"""Measure how well anchors of given scales cover the objects of a folder (numpy, no torch)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cohdc_train.types import FloatArray

STRIDES = (4, 8, 16, 32, 64)  # px, of the pyramid's levels
RATIOS = (0.5, 1.0, 2.0)  # height / width
# COCO's, px of sqrt(area)
SIZES = {"small": (0.0, 32.0), "medium": (32.0, 96.0), "large": (96.0, np.inf)}


class AnchorRecall(NamedTuple):
    """Share of the objects of one size that an anchor covers.

    Attributes:
        size: "small", "medium", "large" or "all".
        objects: number of objects.
        at_50: share of them that an anchor covers at an IoU of .5 or more.
        at_70: the same at .7.
    """

    size: str
    objects: int
    at_50: float
    at_70: float


def best_overlap(boxes: FloatArray, scales: Sequence[int], canvas: tuple[int, int]) -> FloatArray:
    """Return the largest IoU of each box with an anchor of torchvision's grid.

    Anchors have one scale per level from stride 4 on, and 3 ratios.

    Args:
        boxes: [N, 4] xyxy, px on the canvas.
        scales: side of the anchors of each level, px.
        canvas: (height, width), px.

    Returns:
        [N], 0..1.
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


def anchor_recall(
    boxes: FloatArray, scales: Sequence[int], canvas: tuple[int, int]
) -> list[AnchorRecall]:
    """Return the share of objects that anchors cover, by the objects' size.

    Sizes without objects are skipped. RPN training calls an anchor positive from an IoU of .7 on,
    and also takes the best anchor of each object. Arguments are those of `best_overlap`.
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
    """Return the IoU of boxes [N, 4] xyxy, pair by pair."""
    inside = (np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])).clip(0).prod(axis=1)
    areas = [(box[:, 2:] - box[:, :2]).prod(axis=1) for box in (a, b)]
    union = areas[0] + areas[1] - inside
    iou: FloatArray = np.divide(inside, union, out=np.zeros_like(inside), where=union > 0)
    return iou
