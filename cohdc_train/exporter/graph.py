"""A network -> an ONNX file with the contract's names and metadata, slimmed."""

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
_PER_DETECTION = (
    "roi_heads.mask_head",
    "roi_heads.mask_predictor",
    "cqe",
)  # modules that see detections only


@dataclass(frozen=True)
class Cost:
    """What a network computes: GFLOPs (a multiplication and an addition are two) of one image, and
    of each detection's mask and quality besides.
    """

    image: float
    detection: float


def write_graph(network: MaskRCNN, class_names: list[str], path: Path) -> int:
    """Export, slim (norms go into their convolutions), check and save; returns the number of nodes.

    Raises ExportError when the exporter or the checker refuses.
    """
    rows, columns = network.config.canvas
    example = torch.zeros((2, rows + 32, columns + 64, 3), dtype=torch.uint8)
    free = {i: torch.export.Dim(name) for i, name in enumerate(("batch", "height", "width"))}
    program = torch.onnx.export(
        Detector(network).eval(),
        (example,),
        dynamo=True,
        opset_version=OPSET,
        input_names=[signature.INPUT],
        output_names=list(signature.OUTPUTS),
        dynamic_shapes=(free,),
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
    """Of a network on one image of its canvas; RoIAlign and suppression are not counted."""
    rows, columns = network.config.canvas
    counter = FlopCounterMode(display=False)
    with torch.no_grad(), counter:
        count = Detector(network)(torch.zeros((1, rows, columns, 3), dtype=torch.uint8))[-1]
    by_module = {name: sum(flops.values()) for name, flops in counter.get_flop_counts().items()}
    masks = sum(by_module.get(f"Detector.network.{name}", 0) for name in _PER_DETECTION)
    return Cost((counter.get_total_flops() - masks) / 1e9, masks / max(int(count), 1) / 1e9)


def _metadata(network: MaskRCNN, class_names: list[str]) -> dict[str, str]:
    config = network.config
    rule = {
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
        signature.KEY_INPUT: json.dumps(rule),
        signature.KEY_THRESHOLDS: json.dumps(thresholds),
    }
