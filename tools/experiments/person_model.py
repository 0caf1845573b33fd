#!/usr/bin/env python3
"""Person networks of the HDC-Net family: from photographs to a scored int8 file.

    tools/experiments/person_model.py n --data COCO_SMALL --out DIR
        [--weights BACKBONE.pth | --pretrained person [--mean]]

Renders DIR/synth and, with people close to the camera, DIR/near, trains DIR/fit, exports
DIR/person.onnx and person.int8.onnx, calibrated on training photographs, and writes the scores of
both on the validation photographs to DIR/scores.json. What is trained already is not trained again.
With --minutes 0 nothing is trained: --pretrained is written again, as the package exports and
quantizes now.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import torch
import yaml

from cohdc_train.bench.training import budget_arguments, train
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.exporter.export import export
from cohdc_train.files import write_json
from cohdc_train.models import NetworkConfig
from cohdc_train.presets import config_path, model_path
from cohdc_train.synth.coco import coco
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.validation import score_file

CANVAS = {"n": (480, 640), "s": (640, 864)}
CALIBRATION = 64  # photographs
NEAR = (0.45, 1.3)  # m from the camera


def main() -> None:
    """Render, train, export, score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("size", choices=CANVAS)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--weights", default="imagenet", help="of the backbone, to begin with: imagenet or a file"
    )
    parser.add_argument(
        "--pretrained", help="checkpoint, exported file or shipped network to begin with instead"
    )
    parser.add_argument(
        "--mean",
        action="store_true",
        help="export the mean of --pretrained's weights and the trained",
    )
    budgets = parser.add_mutually_exclusive_group()
    budgets.add_argument("--epochs", type=int, help="person.yaml's, 28")
    budgets.add_argument("--minutes", type=int, help="budget of training instead of epochs")
    parser.add_argument("--lr", type=float, help="person.yaml's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    if (arguments.mean or arguments.minutes == 0) and not arguments.pretrained:
        parser.error("--mean and --minutes 0 need --pretrained")
    out, data = arguments.out.resolve(), arguments.data.resolve()
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(arguments.threads)
    canvas = CANVAS[arguments.size]
    if arguments.minutes == 0:
        checkpoint = untrained(
            arguments.size, canvas, model_path(arguments.pretrained), out / "untrained.ckpt"
        )
    else:
        checkpoint = trained(arguments, data, out, canvas)
    photographs = out / "calibration"
    photographs.mkdir(exist_ok=True)
    for image in CocoDataModule(data, ["person"]).folder.train[0].images[:CALIBRATION]:
        if not (link := photographs / image.path.name).exists():
            link.symlink_to(image.path)
    file = out / "person.onnx"
    export(
        checkpoint,
        file,
        canvas=canvas,
        images=photographs,
        int8=photographs,
        data=data,
        allow_drop=True,
    )
    scores = {
        kind: score_file(path, data, threads=arguments.threads).scores
        for kind, path in (("float32", file), ("int8", out / "person.int8.onnx"))
    }
    write_json(out / "scores.json", scores)
    print(json.dumps(scores, indent=2))


def trained(arguments: argparse.Namespace, data: Path, out: Path, canvas: tuple[int, int]) -> Path:
    """Train on photographs and rendered people; returns the checkpoint.

    With --mean it holds the mean of first and last weights.
    """
    if not (out / "synth").is_dir():
        coco(out / "synth", train=64, val=8, size=(384, 512), seed=7)
    if not (out / "near").is_dir():
        coco(out / "near", train=64, val=8, size=(384, 512), seed=8, distance=NEAR)
    start = f"--pretrained={arguments.pretrained or arguments.weights}"
    options = (
        *(f"--config=networks/hdc_net_{arguments.size}.yaml", "--config=person.yaml", start),
        *(f"--seed_everything={arguments.seed}", f"--data.canvas=[{canvas[0]}, {canvas[1]}]"),
        *budget_arguments(arguments.epochs or 28, arguments.minutes),
        *([f"--model.optimizer.lr={arguments.lr}"] if arguments.lr else []),
    )
    checkpoint = train(
        out / "fit", [data, out / "synth", out / "near"], options, arguments.threads
    ).checkpoint
    if not arguments.mean:
        return checkpoint
    return mean_with_start(checkpoint, model_path(arguments.pretrained), out / "mean.ckpt")


def untrained(size: str, canvas: tuple[int, int], began: Path, out: Path) -> Path:
    """Write a checkpoint of weights as they are, in the network of a size."""
    shape: dict[str, Any] = {}
    for name in (f"networks/hdc_net_{size}.yaml", "person.yaml"):
        shape |= yaml.safe_load(config_path(name).read_text(encoding="utf-8"))["model"]["network"]
    fields = {**shape, "norm": "frozen", "frozen_stages": 2, "canvas": canvas}
    module = MaskRCNNModule(["person"], NetworkConfig(**fields))
    module.load_pretrained(began)
    torch.save({"hyper_parameters": dict(module.hparams), "state_dict": module.state_dict()}, out)
    return out


def mean_with_start(ended: Path, began: Path, out: Path) -> Path:
    """Write a checkpoint of the mean of the weights before and after a training."""
    module, stored = (
        MaskRCNNModule.load(ended),
        torch.load(ended, map_location="cpu", weights_only=True),
    )
    last = {name: weights.clone() for name, weights in module.network.state_dict().items()}
    module.load_pretrained(began)
    for name, weights in module.network.state_dict().items():
        if weights.is_floating_point():
            stored["state_dict"][f"network.{name}"] = (weights + last[name]) / 2
    torch.save(stored, out)
    return out


if __name__ == "__main__":
    main()
