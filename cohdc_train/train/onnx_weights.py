"""Weights of an exported file, loaded into a network: a start where no checkpoint is left."""

import json
import re
from pathlib import Path

import onnx
import torch
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from onnx import ModelProto, NodeProto, numpy_helper
from torch import Tensor, nn

from cohdc_train.models import MaskRCNN, detect, fuse_conv_bn
from cohdc_train.models.frozen_norm import FrozenNorm, conv_bn_pairs
from cohdc_train.signature import KEY_CLASSES

_LAYERS = nn.Conv2d | nn.ConvTranspose2d | nn.Linear
_NAMED, _NUMBER = re.compile(r"network\.(.+)\.weight"), re.compile(r"\d+")
_OPERATORS = ("Conv", "ConvTranspose", "Gemm")


def read_onnx_weights(path: Path) -> tuple[ModelProto, list[str]]:
    """Read an ONNX file that `cohdc export` wrote, and its class names.

    Raises:
        ValueError: it is no such file.
        OSError: it cannot be read.
    """
    try:
        model = onnx.load(path)
    except DecodeError as error:
        raise ValueError("not an ONNX file") from error
    classes = {entry.key: entry.value for entry in model.metadata_props}.get(KEY_CLASSES)
    if classes is None:
        raise ValueError(f"not written by cohdc export: no {KEY_CLASSES} in its metadata")
    return model, list(json.loads(classes))


def load_onnx_weights(network: MaskRCNN, model: ModelProto) -> None:
    """Load the weights of an exported file, quantized or not, into a network of the same shape.

    A layer into which its norm was folded has lost its name; such layers are paired in the order in
    which they run. Norms must be frozen here; they become the identity and a shift.

    Raises:
        ValueError: the layers do not agree, or a norm is one that is trained.
    """
    stored = _read_layers(model)
    layers = _layers_in_order(network)
    numbered = iter(sorted(key for key in stored if isinstance(key, int)))
    if len(layers) != len(stored):
        raise ValueError(f"the file has {len(stored)} layers, the network {len(layers)}")
    norms = {
        getattr(module, name): getattr(module, norm)
        for module, name, norm in conv_bn_pairs(network)
    }
    own = dict(network.named_modules())
    for name in layers:
        key = name if name in stored else next(numbered, None)
        if key is None:
            raise ValueError(f"the file has no layer {name}")
        weights, bias = stored[key]
        layer = own[name]
        norm = norms.get(layer)
        if layer.weight.shape != weights.shape:
            raise ValueError(
                f"layer {name} is {list(weights.shape)} in the file, "
                f"{list(layer.weight.shape)} here"
            )
        with torch.no_grad():
            layer.weight.copy_(weights)
            if norm is None:
                layer.bias.copy_(bias)
                continue
            if not isinstance(norm, FrozenNorm):
                raise ValueError(
                    f"the norm behind {name} is trained, and the file holds none; freeze it"
                )
            norm.weight.fill_(1)
            norm.running_mean.zero_()
            norm.running_var.fill_(1 - norm.eps)
            norm.bias.copy_(bias)


def _layers_in_order(network: MaskRCNN) -> list[str]:
    """Return the names of the layers in the order in which they first run.

    The mask and CQE heads run without a detection too.
    """
    names: list[str] = []
    copy = fuse_conv_bn(network)
    for name, module in copy.named_modules():
        if isinstance(module, _LAYERS):
            module.register_forward_pre_hook(lambda _, __, name=name: names.append(name))
    detect(copy, [torch.zeros(3, *network.config.canvas, dtype=torch.uint8)])
    return list(dict.fromkeys(names))


def _read_layers(model: ModelProto) -> dict[str | int, tuple[Tensor, Tensor]]:
    """Return weights and bias of each layer by its name, or by the exporter's number for it."""
    tensors = {one.name: one for one in model.graph.initializer}
    makers = {name: node for node in model.graph.node for name in node.output}
    found: dict[str | int, tuple[Tensor, Tensor]] = {}
    for node in model.graph.node:
        if node.op_type in _OPERATORS:
            weights, *biases = (_value(name, tensors, makers) for name in node.input[1:3])
            bias = biases[0] if biases else torch.zeros(())  # the export drops a bias of zeros
            found[_key(node.input[1])] = weights, bias
    return found


def _key(weights: str) -> str | int:
    """Return the name of a layer, or its number, from the name of its weights."""
    if named := _NAMED.match(weights):
        return named[1]
    if number := _NUMBER.search(weights):
        return int(number[0])
    raise ValueError(f"its weights {weights} have no name that cohdc export gives")


def _value(name: str, tensors: dict[str, onnx.TensorProto], makers: dict[str, NodeProto]) -> Tensor:
    """Return an initializer, or what DequantizeLinear makes of one."""
    if name in tensors:
        return torch.from_numpy(numpy_helper.to_array(tensors[name]).copy())
    node = makers[name]
    if node.op_type != "DequantizeLinear":
        raise ValueError(f"{name} is made by {node.op_type}")
    quantized, scale, *zero = (_value(one, tensors, makers) for one in node.input)
    axis = next((a.i for a in node.attribute if a.name == "axis"), 1)
    shape = [1] * quantized.ndim
    if scale.numel() > 1:
        shape[axis] = -1
    shift = zero[0].float().reshape(shape) if zero else 0.0
    return (quantized.float() - shift) * scale.reshape(shape)
