"""ONNX translations (opset 18) of the network's custom operators, for torch's exporter."""

import math
from collections.abc import Callable
from typing import Any

import onnxscript
import torch

from cohdc_train.models.ops import CANONICAL_LEVEL, CANONICAL_SIDE, SAMPLING_RATIO

op: Any = onnxscript.opset18  # its type hints refuse the exporter's symbolic values
_FLOAT, _BOOL = 1, 9  # onnx.TensorProto


def _ints(*values: int) -> Any:
    return op.Constant(value_ints=list(values))


def _float(value: float) -> Any:
    return op.Constant(value_float=value)


def _range(count: Any) -> Any:
    return op.Range(op.Constant(value_int=0), count, op.Constant(value_int=1))


def letterbox(images: Any, rows: int, columns: int) -> tuple[Any, Any]:
    """Translate `models.ops.letterbox`.

    exclude_outside makes the filter weights at the border those of torch.
    """
    shape = op.Shape(images)
    height, width = op.Gather(shape, _ints(1)), op.Gather(shape, _ints(2))
    tall = op.LessOrEqual(op.Mul(_ints(rows), width), op.Mul(_ints(columns), height))

    def fit(side: Any, limit: int, other: Any) -> Any:
        """Compute max(1, round(side * limit / other)), halves up, in integers."""
        doubled = op.Add(op.Mul(op.Mul(_ints(2), side), _ints(limit)), other)
        return op.Max(_ints(1), op.Div(doubled, op.Mul(_ints(2), other)))

    h = op.Where(tall, _ints(rows), fit(height, columns, width))
    w = op.Where(tall, fit(width, rows, height), _ints(columns))
    x = op.Cast(op.Transpose(images, perm=[0, 3, 1, 2]), to=_FLOAT)
    size = op.Concat(op.Gather(shape, _ints(0)), _ints(3), h, w, axis=0)
    x = op.Resize(
        x,
        None,
        None,
        size,
        mode="linear",
        coordinate_transformation_mode="half_pixel",
        antialias=1,
        exclude_outside=1,
    )
    margin = op.Concat(
        _ints(0, 0, 0, 0, 0, 0), op.Sub(_ints(rows), h), op.Sub(_ints(columns), w), axis=0
    )
    canvas = op.Pad(op.Div(x, _float(255.0)), margin, _float(0.0))
    content = [op.Cast(side, to=_FLOAT) for side in (h, w)]
    image = [op.Cast(side, to=_FLOAT) for side in (height, width)]
    geometry = op.Concat(
        *content, op.Div(image[0], content[0]), op.Div(image[1], content[1]), axis=0
    )
    return canvas, geometry


def nms_keep(boxes: Any, scores: Any, iou_threshold: float, score_threshold: float) -> Any:
    """Translate `models.ops.nms_keep`: the (image, box) pairs that NMS keeps, as a mask."""
    wanted = op.Gather(op.Shape(scores), _ints(1))
    kept = op.NonMaxSuppression(
        boxes,
        op.Unsqueeze(scores, _ints(1)),
        wanted,
        _float(iou_threshold),
        _float(score_threshold),
    )
    pairs = op.Gather(kept, _ints(0, 2), axis=1)
    ones = op.Expand(op.Constant(value_int=1), op.Gather(op.Shape(kept), _ints(0)))
    nothing = op.Expand(op.Constant(value_int=0), op.Shape(scores))
    return op.Cast(op.ScatterND(nothing, pairs, ones), to=_BOOL)


def roi_pool_levels(
    features: list[Any], boxes: Any, images: Any, strides: list[int], side: int
) -> Any:
    """Translate `models.ops.roi_pool_levels`: one RoiAlign per level, in the boxes' order."""
    sides = op.Sub(
        op.Slice(boxes, _ints(2), _ints(4), _ints(1)), op.Slice(boxes, _ints(0), _ints(2), _ints(1))
    )
    area = op.ReduceProd(sides, _ints(1), keepdims=0)
    octave = op.Log(op.Add(op.Div(op.Sqrt(area), _float(float(CANONICAL_SIDE))), _float(1e-8)))
    level = op.Add(_float(float(CANONICAL_LEVEL)), op.Div(octave, _float(math.log(2.0))))
    level = op.Floor(op.Add(level, _float(1e-6)))
    first = strides[0].bit_length() - 1
    level = op.Clip(level, _float(float(first)), _float(float(first + len(features) - 1)))
    pooled, chosen = [], []
    for i, feature in enumerate(features):
        rows = op.Reshape(op.NonZero(op.Equal(level, _float(float(first + i)))), _ints(-1))
        chosen.append(rows)
        pooled.append(
            op.RoiAlign(
                feature,
                op.Gather(boxes, rows),
                op.Gather(images, rows),
                coordinate_transformation_mode="output_half_pixel",
                mode="avg",
                output_height=side,
                output_width=side,
                sampling_ratio=SAMPLING_RATIO,
                spatial_scale=1.0 / strides[i],
            )
        )
    order = op.Concat(*chosen, axis=0)
    inverse = op.ScatterElements(order, order, _range(op.Size(order)), axis=0)
    return op.Gather(op.Concat(*pooled, axis=0), inverse, axis=0)


def rows_to_segment(present: Any) -> Any:
    """Translate `models.ops.rows_to_segment`."""
    first = op.Equal(_range(op.Squeeze(op.Shape(present))), op.Constant(value_int=0))
    return op.Reshape(op.NonZero(op.Or(present, first)), _ints(-1))


TRANSLATIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.ops.cohdc.letterbox.default: letterbox,
    torch.ops.cohdc.nms_keep.default: nms_keep,
    torch.ops.cohdc.roi_pool_levels.default: roi_pool_levels,
    torch.ops.cohdc.rows_to_segment.default: rows_to_segment,
}
