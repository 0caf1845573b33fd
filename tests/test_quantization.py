"""Static quantization of a MobileNet block after a stem: rounding, and no saturation."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from onnxruntime import InferenceSession, SessionOptions

from cohdc_train import signature
from cohdc_train.exporter.quantization import quantize

CHANNELS = 8


def block(path: Path, stem: bool = True) -> None:
    """Write a model: a stem that changes nothing, then a MobileNet block with ReLU6.

    stem: whether its second convolution is depthwise; else it is one ordinary convolution.
    """
    rng = np.random.default_rng(0)
    numbers: dict[str, NDArray[Any]] = {
        "scale": np.float32(1 / 255),
        "zero": np.float32(0),
        "six": np.float32(6),
        "dense": rng.uniform(0, 0.3, (CHANNELS, 3, 3, 3)).astype(
            np.float32
        ),  # all of one sign: sums grow
        "depthwise": rng.normal(0, 0.4, (CHANNELS, 1, 3, 3)).astype(np.float32),
        "pointwise": rng.uniform(0, 1, (CHANNELS, CHANNELS, 1, 1)).astype(np.float32),
        "same": np.eye(3, dtype=np.float32).reshape(3, 3, 1, 1),
        "each": np.ones((3, 1, 1, 1), np.float32),
    }
    light = [
        helper.make_node("Conv", ["image", "same"], ["p"], "stem1", group=1),
        helper.make_node("Conv", ["p", "each"], ["q"], "stem2", group=3),
        helper.make_node("Conv", ["q", "same"], ["x"], "stem3", group=1),
    ]
    heavy = [
        helper.make_node("Conv", ["image", "same"], ["p"], "stem1", group=1),
        helper.make_node("Conv", ["p", "same"], ["x"], "stem2", group=1),
    ]
    nodes = [
        helper.make_node("Cast", [signature.INPUT], ["float"], "cast", to=onnx.TensorProto.FLOAT),
        helper.make_node("Transpose", ["float"], ["planes"], "transpose", perm=[0, 3, 1, 2]),
        helper.make_node("Mul", ["planes", "scale"], ["image"], "mul"),
        *(light if stem else heavy),
        helper.make_node("Conv", ["x", "dense"], ["a"], "first", group=1, pads=[1, 1, 1, 1]),
        helper.make_node("Clip", ["a", "zero", "six"], ["b"], "relu6"),
        helper.make_node(
            "Conv", ["b", "depthwise"], ["c"], "second", group=CHANNELS, pads=[1, 1, 1, 1]
        ),
        helper.make_node("Clip", ["c", "zero", "six"], ["d"], "another"),
        helper.make_node("Conv", ["d", "pointwise"], ["y"], "third", group=1),
    ]
    image = helper.make_tensor_value_info(signature.INPUT, onnx.TensorProto.UINT8, [1, "h", "w", 3])
    result = helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, None)
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in numbers.items()]
    graph = helper.make_graph(nodes, "block", [image], [result], tensors)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), path
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[NDArray[np.uint8]]]:
    """Make the block's file, its int8 form, and the bright images it was calibrated with."""
    folder, rng = tmp_path_factory.mktemp("block"), np.random.default_rng(1)
    images = [rng.integers(128, 256, (32, 40, 3), dtype=np.uint8) for _ in range(8)]
    block(folder / "block.onnx")
    assert quantize(folder / "block.onnx", folder / "int8.onnx", images) == 5
    return folder / "block.onnx", folder / "int8.onnx", images


def test_matrices_get_seven_bits_and_depthwise_weights_eight(made: tuple[Path, Path, Any]) -> None:
    graph = onnx.load(made[1]).graph
    numbers = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    largest = {
        name.split("_")[0]: int(np.abs(value.astype(int)).max())
        for name, value in numbers.items()
        if value.dtype == np.int8 and value.ndim == 4
    }
    assert largest == {"dense": 64, "depthwise": 127, "pointwise": 64}


def test_relu6_is_left_to_the_rounding_behind_it(made: tuple[Path, Path, Any]) -> None:
    """A map is not rounded twice, and not turned into float32 in between."""
    graph = onnx.load(made[1]).graph
    before = {output: node.op_type for node in graph.node for output in node.output}
    assert not [node for node in graph.node if node.op_type == "Clip"]
    rounded = [before[node.input[0]] for node in graph.node if node.op_type == "QuantizeLinear"]
    assert sorted(rounded) == ["Conv", "Conv", "Conv", "Conv"]


def test_a_light_stem_stays_exact_and_a_heavy_one_does_not(
    made: tuple[Path, Path, Any], tmp_path: Path
) -> None:
    def float_convolutions(path: Path) -> list[str]:
        graph = onnx.load(path).graph
        rounded = {
            output
            for node in graph.node
            if node.op_type == "DequantizeLinear"
            for output in node.output
        }
        return [
            node.name
            for node in graph.node
            if node.op_type == "Conv" and node.input[1] not in rounded
        ]

    assert float_convolutions(made[1]) == ["stem1", "stem2", "stem3"]
    block(tmp_path / "heavy.onnx", stem=False)
    assert quantize(tmp_path / "heavy.onnx", tmp_path / "int8.onnx", made[2]) == 7
    assert float_convolutions(tmp_path / "int8.onnx") == []


def test_no_sum_saturates(made: tuple[Path, Path, list[NDArray[np.uint8]]]) -> None:
    """Results equal float32 arithmetic on the same rounded numbers."""
    whole, small, images = made
    exact = SessionOptions()
    exact.add_session_config_entry("session.disable_quant_qdq", "1")
    sessions = [
        InferenceSession(str(whole)),
        InferenceSession(str(small)),
        InferenceSession(str(small), exact),
    ]
    for image in images:
        truth, found, expected = (s.run(None, {signature.INPUT: image[None]})[0] for s in sessions)
        step = expected.max() / 255
        assert (
            np.abs(found - expected).max() <= 2.1 * step
        )  # a rounding that goes the other way, and one behind it
        assert np.abs(found - truth).mean() < 0.02 * truth.max()
