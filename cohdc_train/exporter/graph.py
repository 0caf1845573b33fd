"""ONNX graph of a network, with the names and metadata of the contract, slimmed."""

import json
from dataclasses import dataclass
from pathlib import Path

import onnx
import onnxslim
import torch
from torch.utils.flop_counter import FlopCounterMode

from cohdc_train import __version__, signature
from cohdc_train.errors import ExportError
from cohdc_train.exporter.operators import TRANSLATIONS
from cohdc_train.models import Detector, MaskRCNN

OPSET = 18
MASK_THRESHOLD = 0.5
# Modules that run on detections only.
_PER_DETECTION = ("roi_heads.mask_head", "roi_heads.mask_predictor", "cqe")


@dataclass(frozen=True)
class Cost:
    """Cost of a network in GFLOPs; a multiplication and an addition are two.

    Attributes:
        image: of one image, without what depends on the number of detections.
        detection: of the mask and quality of each detection.
    """

    image: float
    detection: float


def write_graph(network: MaskRCNN, class_names: list[str], path: Path) -> int:
    """Export, slim (norms go into their convolutions), check and save a network.

    Returns:
        The number of nodes.

    Raises:
        ExportError: the exporter failed.
    """
    rows, columns = network.config.canvas
    example = torch.zeros((2, rows + 32, columns + 64, 3), dtype=torch.uint8)
    names = ("batch", "height", "width")
    dynamic = {axis: torch.export.Dim(name) for axis, name in enumerate(names)}
    program = torch.onnx.export(
        Detector(network).eval(),
        (example,),
        dynamo=True,
        opset_version=OPSET,
        input_names=[signature.INPUT],
        output_names=list(signature.OUTPUTS),
        dynamic_shapes=(dynamic,),
        custom_translation_table=TRANSLATIONS,
        verbose=False,
    )
    if program is None:
        raise ExportError(f"{path}: torch.onnx.export returned nothing")
    model = onnxslim.slim(program.model_proto)
    onnx.helper.set_model_props(model, _metadata(network, class_names))
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return len(model.graph.node)


def count_flops(network: MaskRCNN) -> Cost:
    """Count the FLOPs of a network on a black image of its canvas, without RoIAlign and NMS."""
    rows, columns = network.config.canvas
    counter = FlopCounterMode(display=False)
    with torch.no_grad(), counter:
        images = torch.zeros((1, rows, columns, 3), dtype=torch.uint8)
        num_detections = int(Detector(network)(images)[-1])
    by_module = {name: sum(flops.values()) for name, flops in counter.get_flop_counts().items()}
    per_detection = sum(by_module.get(f"Detector.network.{name}", 0) for name in _PER_DETECTION)
    image_flops = counter.get_total_flops() - per_detection
    return Cost(image_flops / 1e9, per_detection / max(num_detections, 1) / 1e9)


def _metadata(network: MaskRCNN, class_names: list[str]) -> dict[str, str]:
    config = network.config
    input_rule = {
        "color": "RGB",
        "layout": "NHWC",
        "dtype": "uint8",
        "canvas": list(config.canvas),
        "resize": "inside: fitted into the canvas, bilinear, antialiased, top left, black padding",
    }
    thresholds = {
        "score": config.score_threshold,
        "nms_iou": config.nms_iou,
        "mask": MASK_THRESHOLD,
        "mask_cut": config.mask_cut,
    }
    return {
        signature.KEY_CONTRACT: str(signature.CONTRACT_VERSION),
        signature.KEY_VERSION: __version__,
        signature.KEY_CLASSES: json.dumps(class_names),
        signature.KEY_INPUT: json.dumps(input_rule),
        signature.KEY_THRESHOLDS: json.dumps(thresholds),
    }
