"""Quantization of an ONNX file to int8: static, of the heavy operators that tolerate it."""

import logging
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from cohdc_train import signature
from cohdc_train.types import Image

CALIBRATION_IMAGES = 64
_OPERATORS = ("Conv", "Gemm", "Relu", "Clip", "Add", "MaxPool", "Resize")
_FLOAT_MODULES = ("mask_predictor", "cqe.")  # contours and their quality come from these
# Makes the finest level, whose few channels come soon after a light network's stem.
_FINEST_LEVEL = "fpn.inner_blocks.0"


def quantize(source: Path, target: Path, images: Iterable[Image]) -> int:
    """Write the int8 form of a file that keeps the contract.

    uint8 activations, int8 weights per channel (QDQ), ranges by minimum and maximum. The mask
    predictor and the CQE head stay in float32, and so does all arithmetic on pixels and boxes.
    Weights that are multiplied as matrices have 7 bits: on x86 without VNNI the sum of two products
    is kept in 16 bits, and saturates with 8 of them (docs/results/int8.md). Depthwise convolutions
    run in another way there.

    The stem of a light network, and what makes its finest pyramid level, stay in float32, too: few
    channels, each of its own range, at the highest resolution, from which masks are cut.

    Args:
        source: the float32 file.
        target: file to write.
        images: calibration images, uint8 [H, W, 3] RGB each.

    Returns:
        The number of quantized operators.
    """
    model = onnx.load(str(source))
    nodes = _quantizable_nodes(model.graph)
    with _quiet():
        quantize_static(
            str(source),
            str(target),
            _CalibrationReader(images),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(_OPERATORS),
            nodes_to_quantize=nodes,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={"TensorQuantOverrides": _seven_bit_weights(model.graph, nodes)},
        )
    return len(nodes)


def _seven_bit_weights(graph: onnx.GraphProto, nodes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Make onnxruntime's options for the weights that are multiplied as matrices."""
    overrides = {}
    for node in graph.node:
        attributes = {attribute.name: attribute.i for attribute in node.attribute}
        is_dense_conv = node.op_type == "Conv" and attributes.get("group", 1) == 1
        if node.name in nodes and (is_dense_conv or node.op_type == "Gemm"):
            axis = 1 if node.op_type == "Gemm" and not attributes.get("transB") else 0
            overrides[node.input[1]] = [{"axis": axis, "reduce_range": True}]
    return overrides


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the advice to prepare the file, and warnings about the ranges of box arithmetic.

    onnxslim has prepared the file. onnxruntime looks at every Add, and the level of an empty box is
    the logarithm of 0.
    """
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    module = r"onnxruntime\.quantization"
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=RuntimeWarning, module=module)
            yield
    finally:
        root.setLevel(level)


class _CalibrationReader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime is not typed
    """Feeds calibration images one at a time."""

    def __init__(self, images: Iterable[Image]) -> None:
        self._images: Iterator[Image] = iter(images)

    def get_next(self) -> dict[str, Any] | None:
        """Return the inputs of the next run; None after the last."""
        image = next(self._images, None)
        return None if image is None else {signature.INPUT: np.ascontiguousarray(image[None])}


def _quantizable_nodes(graph: onnx.GraphProto) -> list[str]:
    """Name the operators on feature maps and pooled features, except those kept in float32."""
    constants = {tensor.name for tensor in graph.initializer}
    stem = _light_stem(graph)
    kept_float = (*_FLOAT_MODULES, _FINEST_LEVEL) if stem else _FLOAT_MODULES
    features: set[str] = set()
    names = []
    for node in graph.node:
        is_float = any(part in name for name in node.input for part in kept_float)
        if node.op_type not in _OPERATORS or is_float:
            continue
        inputs = [name for name in node.input if name and name not in constants]
        starts = node.op_type in ("Conv", "Gemm") and node.name not in stem
        required = inputs if node.op_type == "Add" else inputs[:1]
        continues = bool(inputs) and all(name in features for name in required)
        if starts or continues:
            features.update(node.output)
            names.append(node.name)
    return names


def _light_stem(graph: onnx.GraphProto) -> list[str]:
    """Name the first three convolutions if the second is depthwise, as in MobileNets; else none."""
    convolutions = [node for node in graph.node if node.op_type == "Conv"][:3]
    for node in convolutions[1:2]:
        for attribute in node.attribute:
            if attribute.name == "group" and attribute.i > 1:
                return [convolution.name for convolution in convolutions]
    return []
