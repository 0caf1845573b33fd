"""ONNX in float32 -> int8: static quantisation of what is heavy and bears it."""

import logging
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from cohdc_train import signature

CALIBRATION_IMAGES = 64
_OPERATORS = ("Conv", "Gemm", "Relu", "Clip", "Add", "MaxPool", "Resize")
_FLOAT = ("mask_predictor", "cqe.")  # contours and their quality are read off these
_FINEST = "fpn.inner_blocks.0"  # makes the finest level, whose few channels come soon after a light network's stem


def quantize(source: Path, target: Path, pictures: Iterable[NDArray[np.uint8]]) -> int:
    """Write the int8 form of a file that keeps the contract; returns the number of quantised
    operators.

    uint8 activations, int8 weights per channel (QDQ), ranges by minimum and maximum over the
    pictures, uint8 [H, W, 3] RGB each. The mask predictor and the CQE head stay in float32, and so
    does all arithmetic on pixels and boxes. Weights that are multiplied as matrices have 7 bits: on
    x86 without VNNI the sum of two products is kept in 16 bits, and saturates with 8 of them
    (docs/results/int8.md). Depthwise convolutions have a way of their own there.

    In float32 stay, too, the stem of a light network and what makes the pyramid's finest level of
    it: few channels, each of its own range, at the highest resolution, from which masks are cut.
    """
    model = onnx.load(str(source))
    nodes = _bearing(model.graph)
    with _quiet():
        quantize_static(
            str(source),
            str(target),
            _Pictures(pictures),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(_OPERATORS),
            nodes_to_quantize=nodes,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={"TensorQuantOverrides": _seven_bits(model.graph, nodes)},
        )
    return len(nodes)


def _seven_bits(graph: onnx.GraphProto, nodes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """onnxruntime's options for the weights of these operators that are multiplied as matrices."""
    overrides = {}
    for node in graph.node:
        attributes = {attribute.name: attribute.i for attribute in node.attribute}
        dense = node.op_type == "Gemm" or (
            node.op_type == "Conv" and attributes.get("group", 1) == 1
        )
        if dense and node.name in nodes:
            axis = 1 if node.op_type == "Gemm" and not attributes.get("transB") else 0
            overrides[node.input[1]] = [{"axis": axis, "reduce_range": True}]
    return overrides


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the advice to prepare the file, which onnxslim did, and what box arithmetic's ranges
    set off: onnxruntime looks at every Add, and the level of an empty box is the logarithm of 0.
    """
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", category=RuntimeWarning, module=r"onnxruntime\.quantization"
            )
            yield
    finally:
        root.setLevel(level)


class _Pictures(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime is not typed
    def __init__(self, pictures: Iterable[NDArray[np.uint8]]) -> None:
        self._left: Iterator[NDArray[np.uint8]] = iter(pictures)

    def get_next(self) -> dict[str, Any] | None:
        """The feed of the next run; None behind the last."""
        picture = next(self._left, None)
        return None if picture is None else {signature.INPUT: np.ascontiguousarray(picture[None])}


def _bearing(graph: onnx.GraphProto) -> list[str]:
    """Names of the operators on feature maps and on pooled features, without those that stay in
    float32.
    """
    constants = {tensor.name for tensor in graph.initializer}
    stem = _light_stem(graph)
    exact = (*_FLOAT, _FINEST) if stem else _FLOAT
    features: set[str] = set()
    names = []
    for node in graph.node:
        if node.op_type not in _OPERATORS or any(
            part in name for name in node.input for part in exact
        ):
            continue
        data = [name for name in node.input if name and name not in constants]
        begins = node.op_type in ("Conv", "Gemm") and node.name not in stem
        if begins or (
            data
            and data[0] in features
            and all(d in features for d in data if node.op_type == "Add")
        ):
            features.update(node.output)
            names.append(node.name)
    return names


def _light_stem(graph: onnx.GraphProto) -> list[str]:
    """Names of the first three convolutions where the second is depthwise, as in MobileNets; else
    none.
    """
    first = [node for node in graph.node if node.op_type == "Conv"][:3]
    groups = [
        attribute.i
        for node in first[1:2]
        for attribute in node.attribute
        if attribute.name == "group"
    ]
    return [node.name for node in first] if groups and groups[0] > 1 else []
