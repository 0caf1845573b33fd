"""Small networks whose random weights detect something, and a short training of one."""

import dataclasses
import json
import warnings
from pathlib import Path

import coco_toys
import torch

from cohdc_train.cli import main
from cohdc_train.models import MaskRCNN, NetworkConfig
from cohdc_train.models.frozen_norm import FrozenNorm
from cohdc_train.train.module import MaskRCNNModule

SMALL = NetworkConfig(
    depth=18,
    width=0.25,
    canvas=(96, 128),
    fpn_channels=16,
    fc=32,
    proposals=(100, 50),
    rois=32,
    detections=10,
    anchor_scales=(16, 32, 64, 128),
    score_threshold=0.45,
)
MOBILENET = dataclasses.replace(
    SMALL,
    backbone="mobilenet_v2",
    width=1.0,
    rates=((1,), (1,), (1, 2), (1, 2, 3)),
    norm="frozen",
    score_threshold=0.05,
)


def opinionated_network() -> MaskRCNN:
    """Make a network with random weights, scaled until its outputs vary and do not saturate."""
    torch.manual_seed(0)
    network = MaskRCNN(2, SMALL).eval()
    with torch.no_grad():
        network.rpn.head.cls_logits.weight.mul_(3)
        network.rpn.head.bbox_pred.weight.mul_(10)
        network.roi_heads.mask_predictor.mask_fcn_logits.weight.mul_(5)
    return network


def with_statistics(config: NetworkConfig) -> MaskRCNN:
    """Return a network of two classes whose frozen norms do something."""
    torch.manual_seed(0)
    network = MaskRCNN(2, config).eval()
    for module in network.modules():
        if isinstance(module, FrozenNorm):
            module.weight.uniform_(0.5, 1.5)
            module.bias.normal_(std=0.2)
            module.running_mean.normal_(std=0.2)
            module.running_var.uniform_(0.5, 2)
    with torch.no_grad():
        network.rpn.head.cls_logits.weight.mul_(3)
        network.rpn.head.bbox_pred.weight.mul_(10)
    return network


def fine_tune(folder: Path, config: NetworkConfig) -> None:
    """Train three steps and export by the command line: training/best.ckpt and model.onnx."""
    data = coco_toys.folder(folder / "data")
    module = MaskRCNNModule(["person", "car"], config)
    module.network = with_statistics(config)
    content = {"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()}
    torch.save(content, folder / "start.ckpt")
    options = {
        "data": {"root": str(data), "canvas": config.canvas, "workers": 0},
        "model": {"network": dataclasses.asdict(config)},
        "trainer": {"accelerator": "cpu", "max_epochs": 1, "precision": "32-true"},
        "figures": False,
    }
    (folder / "tiny.yaml").write_text(json.dumps(options), encoding="utf-8")

    start, out = f"--pretrained={folder / 'start.ckpt'}", f"--out={folder / 'training'}"
    assert main(["fit", "--config", str(folder / "tiny.yaml"), start, out]) == 0

    checkpoint, file = folder / "training" / "best.ckpt", folder / "model.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's exporter
        words = ["--out", str(file), "--images", str(data / "images")]
        assert main(["export", str(checkpoint), *words]) == 0
