#!/usr/bin/env python3
"""Speed of training and validation against plain torchvision and pycocotools loops.

    tools/experiments/bench_training.py --data ROOT [--classes person] [--canvas 320 416]
        [--threads 1] [--blocks 8] [--out FILE.json]

Both sides train the same ResNet-18 Mask R-CNN from the same weights on the same images in the same
order; ours has a CQE head, too. The reference does what torchvision's detection training does:
CocoDetection, polygons to masks, horizontal flip, resizing inside the model, SGD, float32; and
validates by pasting masks, pycocotools' encoding and COCOeval of boxes and masks. Each side has a
process of its own; blocks alternate, so that whatever else runs on the machine hits both.
Validation needs a checkpoint, or detects next to nothing to paste: --checkpoint best.ckpt; the
phase `file` validates its exported file instead: --onnx model.onnx.
"""

import argparse
import json
import os
import statistics
import time
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

SIDES = ("ours", "reference")


class Gate:
    """The worker's end of the pipe: `next` reports a block's time and waits for the next one."""

    def __init__(self, pipe: Connection) -> None:
        """Wait at the worker's end of a pipe."""
        self.pipe = pipe
        # MiB before the first block: the packages, which both sides share, and the network.
        self.resident = 0
        self.started = time.perf_counter()

    def next(self) -> bool:
        """Report a block; returns False when no further one is wanted."""
        self.resident = self.resident or mebibytes("VmRSS")
        self.pipe.send(time.perf_counter() - self.started)
        go: bool = self.pipe.recv()
        self.started = time.perf_counter()
        return go


def options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="COCO-format folder")
    parser.add_argument("--classes", nargs="*", help="these classes only")
    parser.add_argument(
        "--canvas",
        type=int,
        nargs=2,
        default=(320, 416),
        metavar=("H", "W"),
        help="px, of both sides",
    )
    parser.add_argument(
        "--network", help="YAML file of both sides' network, such as networks/hdc_net_n.yaml"
    )
    parser.add_argument(
        "--weights", help="ImageNet weights of both backbones: a torchvision name or a file"
    )
    parser.add_argument(
        "--checkpoint", type=Path, help="weights of both sides in validation, by cohdc fit"
    )
    parser.add_argument(
        "--onnx", type=Path, help="the checkpoint's file, by cohdc export, for the phase `file`"
    )
    parser.add_argument("--threads", type=int, default=1, help="of each side")
    parser.add_argument(
        "--blocks", type=int, default=8, help="timed blocks of each side, after one that is not"
    )
    parser.add_argument("--steps", type=int, default=8, help="training steps per block")
    parser.add_argument("--batch", type=int, default=2, help="training images per step")
    parser.add_argument("--val-images", type=int, default=20, help="validation images per block")
    parser.add_argument(
        "--phases", nargs="*", choices=("train", "val", "file"), default=("train", "val")
    )
    parser.add_argument("--precision", default="bf16-mixed", help="ours; the reference is float32")
    parser.add_argument(
        "--augment", choices=("flip", "full"), default="flip", help="ours; the reference flips"
    )
    parser.add_argument("--cqe", default="concat", help="ours; 'off' leaves the head out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    args = parser.parse_args()
    if "file" in args.phases and args.onnx is None:
        parser.error("the phase `file` needs --onnx")
    return args


def network_config(args: argparse.Namespace) -> Any:
    """Return the network of both sides: the checkpoint's, or a slim ResNet-18 with HDC."""
    import yaml

    from cohdc_train.models import NetworkConfig
    from cohdc_train.presets import config_path

    if args.network:
        fields = yaml.safe_load(config_path(args.network).read_text(encoding="utf-8"))["model"][
            "network"
        ]
        own = {
            "weights": args.weights,
            "norm": "frozen",
            "frozen_stages": 2,
            "canvas": tuple(args.canvas),
        }
        return NetworkConfig(**{**fields, **own, "cqe": args.cqe})
    return NetworkConfig(
        **{
            "depth": 18,
            "rates": ((1,), (1,), (1, 2, 3), (1, 2, 3)),
            "weights": args.weights,
            "norm": "frozen",
        },
        **{
            "frozen_stages": 2,
            "canvas": tuple(args.canvas),
            "anchor_scales": (16, 32, 64, 128, 256),
            "cqe": args.cqe,
        },
        **{"fpn_channels": 64, "fc": 512, "proposals": (500, 200), "rois": 64, "detections": 32},
    )


def open_data(args: argparse.Namespace) -> Any:
    """Our data."""
    from cohdc_train.data.datamodule import CocoDataModule
    from cohdc_train.data.transforms import Augmentation

    flips = Augmentation(flip=0.5, scale_jitter=(1.0, 1.0), photometric=False)
    augment = Augmentation() if args.augment == "full" else flips
    return CocoDataModule(args.data, args.classes, tuple(args.canvas), args.batch, 0, augment)


def built(args: argparse.Namespace, checkpoint: Path | None = None) -> tuple[Any, Any]:
    """Build our module and its data; both sides have the same weights."""
    import torch

    from cohdc_train.train.module import MaskRCNNModule, OptimizerConfig

    data = open_data(args)
    torch.manual_seed(args.seed)
    sgd = OptimizerConfig("sgd", 1e-3, 1e-4)
    if checkpoint is not None:
        return MaskRCNNModule.load(checkpoint, tuple(args.canvas)), data
    return MaskRCNNModule(data.class_names, network_config(args), sgd), data


def order(args: argparse.Namespace, data: Any) -> list[int]:
    """List the training images that have objects, in the order in which both sides see them."""
    import numpy as np

    images = data.folder.train[0].images
    usable = [i for i, image in enumerate(images) if any(not o.crowd for o in image.objects)]
    wanted = (args.blocks + 1) * args.steps * args.batch
    rng = np.random.default_rng(args.seed)
    return [
        int(i)
        for i in np.concatenate([rng.permutation(usable) for _ in range(wanted // len(usable) + 1)])
    ][:wanted]


def train_ours(args: argparse.Namespace, gate: Gate) -> None:
    """Train with `cohdc fit`'s module, data and trainer; a callback stops between blocks."""
    import lightning.pytorch as pl
    from torch.utils.data import DataLoader, Subset

    module, data = built(args)
    whole = data.train_dataloader()
    positions = order(args, data)
    loader = DataLoader(Subset(whole.dataset, positions), args.batch, collate_fn=whole.collate_fn)
    data.train_dataloader = lambda: loader

    class Blocks(pl.Callback):
        """Callback that stops between blocks of steps."""

        def on_train_start(self, trainer: Any, pl_module: Any) -> None:
            """Wait for the first block."""
            gate.next()

        def on_train_batch_end(
            self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
        ) -> None:
            """Wait after the last step of a block."""
            if (batch_idx + 1) % args.steps == 0:
                gate.next()

    trainer = pl.Trainer(
        **{
            "accelerator": "cpu",
            "precision": args.precision,
            "max_epochs": 1,
            "limit_val_batches": 0,
            "logger": False,
        },
        **{"callbacks": [Blocks()], "enable_checkpointing": False, "enable_progress_bar": False},
        **{"enable_model_summary": False, "gradient_clip_val": 5.0},
    )
    trainer.fit(module, datamodule=data)


def train_reference(args: argparse.Namespace, gate: Gate) -> None:
    """Train with torchvision's loop."""
    import reference_loops

    module, data = built(args)
    reference_loops.train(module, data, order(args, data), args, gate)


def validate_reference(args: argparse.Namespace, gate: Gate) -> None:
    """Validate with torchvision's loop and pycocotools."""
    import reference_loops

    module, data = built(args, args.checkpoint)
    reference_loops.validate(module, data, args, gate)


def validate_ours(args: argparse.Namespace, gate: Gate) -> None:
    """Validate as `cohdc validate`: the trainer, the padded forward, all scores."""
    import lightning.pytorch as pl
    from torch.utils.data import DataLoader, Subset

    module, data = built(args, args.checkpoint)
    whole = data.val_dataloader()
    loader = DataLoader(
        Subset(whole.dataset, range(args.val_images)), args.batch, collate_fn=whole.collate_fn
    )
    data.val_dataloader = lambda: loader
    trainer = pl.Trainer(
        **{
            "accelerator": "cpu",
            "precision": args.precision,
            "logger": False,
            "enable_checkpointing": False,
        },
        **{"enable_progress_bar": False, "enable_model_summary": False},
    )
    while gate.next():
        (scores,) = trainer.validate(module, datamodule=data, verbose=False)
    print(
        f"ours: segm AP {scores['val/segm_AP']:.3f}, box AP {scores['val/box_AP']:.3f}", flush=True
    )


def validate_file(args: argparse.Namespace, gate: Gate) -> None:
    """Validate as `cohdc validate FILE.onnx`: onnxruntime, image by image, all scores."""
    from dataclasses import replace

    from cohdc_train.segmenter import Segmenter
    from cohdc_train.validation import score_segmenter

    split = open_data(args).folder.val
    split = replace(split, images=split.images[: args.val_images])
    segmenter = Segmenter(args.onnx, args.threads)
    while gate.next():
        scores = score_segmenter(segmenter, split).scores
    print(f"ours: segm AP {scores['segm_AP']:.3f}, box AP {scores['box_AP']:.3f}", flush=True)


def mebibytes(line: str) -> int:
    """Read this process's resident memory: VmRSS now, VmHWM its peak.

    ru_maxrss would count the parent's too.
    """
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.partition(f"{line}:")[2].split()[0]) // 1024


def work(side: str, phase: str, args: argparse.Namespace, pipe: Connection) -> None:
    """Run one side of one phase in a worker process."""
    if side == "ours":  # as `cohdc fit` and `cohdc validate` do
        from cohdc_train.train.malloc import keep_freed_memory

        keep_freed_memory()
    import logging
    import warnings

    import cv2
    import lightning.pytorch  # noqa: F401  sets the level that is set below
    import torch

    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    warnings.simplefilter("ignore")
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    loops = {
        "train": (train_ours, train_reference),
        "val": (validate_ours, validate_reference),
        "file": (validate_file, validate_reference),
    }
    loops[phase][SIDES.index(side)](args, gate := Gate(pipe))
    pipe.send([gate.resident, mebibytes("VmHWM")])


def measure(phase: str, args: argparse.Namespace) -> dict[str, Any]:
    """Measure the seconds of all blocks and the peak memory of both sides."""
    context = get_context("spawn")
    pipes: dict[str, Connection] = {}
    for side in SIDES:
        pipes[side], theirs = context.Pipe()
        context.Process(target=work, args=(side, phase, args, theirs), daemon=True).start()
        theirs.close()
        pipes[side].recv()  # ready
    seconds: dict[str, list[float]] = {side: [] for side in SIDES}
    for block in range(args.blocks + 1):
        for side in SIDES if block % 2 else SIDES[::-1]:
            pipes[side].send(True)
            seconds[side].append(pipes[side].recv())
    for side in SIDES:
        pipes[side].send(False)
    images = args.steps * args.batch if phase == "train" else args.val_images
    rate = {side: [images / s for s in seconds[side][1:]] for side in SIDES}
    ratios = [ours / theirs for ours, theirs in zip(rate["ours"], rate["reference"], strict=True)]
    return {
        "images_per_s": rate,
        "ratios": ratios,
        "mib_before_and_peak": {side: pipes[side].recv() for side in SIDES},
    }


def report(phase: str, found: dict[str, Any]) -> str:
    """Format the medians of both sides."""
    rates = ", ".join(
        f"{side} {statistics.median(found['images_per_s'][side]):.2f} images/s" for side in SIDES
    )
    memory = ", ".join(
        "{} {}, before {}".format(side, *found["mib_before_and_peak"][side][::-1]) for side in SIDES
    )
    ratios = sorted(found["ratios"])
    quartiles = statistics.quantiles(ratios, n=4) if len(ratios) > 1 else ratios * 3
    spread = (
        f"quartiles {quartiles[0]:.2f}-{quartiles[2]:.2f}, range {ratios[0]:.2f}-{ratios[-1]:.2f}"
    )
    return f"{phase}: {rates}; ratio {statistics.median(ratios):.2f} ({spread}); peak MiB {memory}"


def main() -> int:
    """Run both sides of all phases, and print."""
    args = options()
    os.environ |= {"OMP_NUM_THREADS": str(args.threads)}  # before torch is loaded in the workers
    found = {}
    for phase in args.phases:
        found[phase] = measure(phase, args)
        print(report(phase, found[phase]), flush=True)
    if args.out is not None:
        args.out.write_text(
            json.dumps({"options": vars(args), **found}, indent=1, default=str), encoding="utf-8"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
