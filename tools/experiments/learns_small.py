#!/usr/bin/env python3
"""Scores of `cohdc fit` on small real sets in minutes, against torchvision's recipe.

    tools/experiments/learns_small.py --data SET [SET ...] --imagenet mobilenet_v2.pth --out DIR
        [--minutes 6 60] [--seeds 0 1 2] [--precision 32-true]

Two contenders train at a time, each in a process of its own with one thread, on a core of its own,
by the clock:

    shipped               cohdc fit SET --minutes M (README's command: starts from the shipped
                          weights)
    imagenet              cohdc fit SET --minutes M --pretrained mobilenet_v2.pth
    torchvision-LR        torchvision's references/detection recipe (reference_loops.py): SGD .9,
                          weight decay 1e-4, frozen norms and first two parts, horizontal flip,
                          warm-up of its first epoch (at most 1000 steps), rate divided by ten at
                          16/26 and 22/26 of the budget, the same ImageNet weights and canvas
    torchvision-LR-short  the same recipe with a warm-up of 5 % of the budget: its own takes a third
                          of six minutes

All have the same network (networks/hdc_net_n.yaml), canvas and batch size. The clock of `cohdc fit`
includes its validations; torchvision's clock stops while it is scored. The last weights of each are
scored by pycocotools on the validation split. A cell that is finished lies in DIR and is not
trained again. Writes DIR/results.json, table.md and curves.png.
"""

import argparse
import csv
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

BATCH_SIZE = 2
RATES = (0.005, 0.02)
SHORT_WARMUP = 0.05  # of the budget
POINTS = 4  # of torchvision's curve


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="COCO-format folders")
    parser.add_argument(
        "--imagenet", type=Path, required=True, help="state dict of torchvision's mobilenet_v2"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, nargs="+", default=[6.0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--precision", default="32-true", help="of cohdc fit; torchvision's recipe is float32"
    )
    parser.add_argument("--contenders", nargs="*", help="these only")
    parser.add_argument(
        "--classes", nargs="*", help="train on these classes only, on the images that show them"
    )
    parser.add_argument(
        "--cell",
        nargs=5,
        metavar=("NAME", "DATA", "MINUTES", "SEED", "FOLDER"),
        help=argparse.SUPPRESS,
    )
    return parser.parse_args()


def contenders() -> list[str]:
    """Return the names of the contenders, in the order in which they train."""
    recipe = [f"torchvision-{rate}" for rate in RATES]
    return ["shipped", *recipe, "imagenet", *(f"{name}-short" for name in recipe)]


def main() -> int:
    """Train every cell, two at a time, and write the table."""
    arguments = parse_arguments()
    if arguments.cell is not None:
        name, data, minutes, seed, folder = arguments.cell
        train_cell(name, Path(data), float(minutes), int(seed), Path(folder), arguments)
        return 0
    names = arguments.contenders or contenders()
    if arguments.classes:
        arguments.data = [
            select_classes(data, arguments.classes, arguments.out / "data")
            for data in arguments.data
        ]
    waiting = [
        (name, data.resolve(), minutes, seed)
        for minutes in arguments.minutes
        for seed in arguments.seeds
        for data in arguments.data
        for name in names
    ]
    run_pairs(
        [cell for cell in waiting if not (folder_of(arguments.out, *cell) / "cell.json").is_file()],
        arguments,
    )
    cells = [
        json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(arguments.out.glob("*/cell.json"))
    ]
    (arguments.out / "results.json").write_text(json.dumps(cells, indent=1), encoding="utf-8")
    table = as_table(cells)
    (arguments.out / "table.md").write_text(table, encoding="utf-8")
    plot_curves(cells, arguments.out / "curves.png")
    print(table)
    return 0


def select_classes(data: Path, classes: list[str], out: Path) -> Path:
    """Write a COCO folder with these classes only, and with the images that show them.

    Returns out/NAME_CLASSES; its images/ is a link to the original folder.
    """
    folder = out / "_".join([data.name, *classes])
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "images").exists():
        (folder / "images").symlink_to((data / "images").resolve())

    for name in ("instances_train.json", "instances_val.json"):
        content = json.loads((data / name).read_text(encoding="utf-8"))
        kept = [row for row in content["categories"] if row["name"] in classes]
        ids = {row["id"] for row in kept}
        annotations = [row for row in content["annotations"] if row["category_id"] in ids]
        shown = {row["image_id"] for row in annotations}
        images = [row for row in content["images"] if row["id"] in shown]
        content |= {"categories": kept, "annotations": annotations, "images": images}
        (folder / name).write_text(json.dumps(content), encoding="utf-8")
    return folder


def folder_of(out: Path, name: str, data: Path, minutes: float, seed: int) -> Path:
    """Return the folder of a cell."""
    return out / f"{data.name}_{minutes:g}min_{name}_seed{seed}"


def run_pairs(cells: list[tuple[str, Path, float, int]], arguments: argparse.Namespace) -> None:
    """Train cells, one on each of two cores; the next pair begins when both are done."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    for start in range(0, len(cells), len(cores)):
        running = []
        for core, cell in zip(cores, cells[start : start + len(cores)], strict=False):
            name, data, minutes, seed = cell
            folder = folder_of(arguments.out, *cell)
            folder.mkdir(parents=True, exist_ok=True)
            own = [name, str(data), str(minutes), str(seed), str(folder)]
            fixed = [
                "--data",
                str(data),
                "--imagenet",
                str(arguments.imagenet.resolve()),
                "--out",
                str(arguments.out),
            ]
            command = [
                sys.executable,
                __file__,
                *fixed,
                f"--precision={arguments.precision}",
                "--cell",
                *own,
            ]
            environment = os.environ | {"OMP_NUM_THREADS": "1"}
            log = (folder / "log.txt").open("w", encoding="utf-8")
            pin = ["taskset", "-c", str(core)]
            running.append(
                (cell, subprocess.Popen([*pin, *command], env=environment, stdout=log, stderr=log))
            )
        for cell, process in running:
            if process.wait():
                raise SystemExit(f"{folder_of(arguments.out, *cell)}/log.txt: the cell failed")


def train_cell(
    name: str, data: Path, minutes: float, seed: int, folder: Path, arguments: argparse.Namespace
) -> None:
    """Train and score one contender; write folder/cell.json."""
    if name.startswith("torchvision"):
        _, rate, *short = name.split("-")
        curve, images, segm = train_torchvision(
            data, arguments.imagenet, minutes, seed, float(rate), bool(short)
        )
    else:
        pretrained = str(arguments.imagenet) if name == "imagenet" else "auto"
        curve, images, segm = train_ours(
            data, pretrained, minutes, seed, folder, arguments.precision
        )
    row = {
        "contender": name,
        "data": data.name,
        "minutes": minutes,
        "seed": seed,
        "images_seen": images,
        **segm,
    }
    row |= {
        "precision": "32-true" if name.startswith("torchvision") else arguments.precision,
        "curve": curve,
    }
    (folder / "cell.json").write_text(json.dumps(row, indent=1), encoding="utf-8")


def fit_command(
    data: Path, pretrained: str, minutes: float, seed: int, folder: Path, precision: str
) -> list[str]:
    """Return the arguments of `cohdc fit`: README's command, and what an experiment fixes."""
    readme = [str(data), f"--minutes={minutes:g}", f"--out={folder / 'fit'}"]
    fixed = [
        f"--seed_everything={seed}",
        f"--trainer.precision={precision}",
        f"--pretrained={pretrained}",
    ]
    return [*readme, *fixed, "--data.workers=0", "--trainer.enable_progress_bar=false"]


def train_ours(
    data: Path, pretrained: str, minutes: float, seed: int, folder: Path, precision: str
) -> tuple[list[tuple[float, float]], int, dict[str, float]]:
    """Run `cohdc fit` and score its last.ckpt.

    Returns the curve (minutes, AP), images seen, and scores.
    """
    from cohdc_train.train.cli import fit
    from cohdc_train.train.module import MaskRCNNModule

    trainer = fit(fit_command(data, pretrained, minutes, seed, folder, precision))
    steps = trainer.global_step
    (log,) = (folder / "fit" / "logs").glob("version_0/metrics.csv")
    with log.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    curve = [
        (minutes * (int(row["step"]) + 1) / steps, float(row["val/segm_AP"]))
        for row in rows
        if row.get("val/segm_AP")
    ]
    module = MaskRCNNModule.load(folder / "fit" / "last.ckpt")
    return curve, steps * BATCH_SIZE, score_ours(module, data)


def score_ours(module: Any, data: Path) -> dict[str, float]:
    """Score a network on the validation split by pycocotools."""
    import torch
    from reference_loops import Images, coco_scores

    from cohdc_train.data.annotations import read_image
    from cohdc_train.data.datamodule import CocoDataModule
    from cohdc_train.metrics.detection_rows import encode_detections
    from cohdc_train.models import detect, fuse_conv_bn

    split = CocoDataModule(data, module.class_names).folder.val
    network = fuse_conv_bn(module.network)
    images = Images(split, flip=0.0)
    rows: list[dict[str, Any]] = []
    for image in split.images:
        pixels = torch.from_numpy(read_image(image)).permute(2, 0, 1)
        (detections,) = detect(network, [pixels])
        for row in encode_detections(image.id, (image.height, image.width), detections):
            label = row["category_id"]
            wanted = {key: row[key] for key in ("image_id", "bbox", "segmentation")}
            rows.append(
                {
                    **wanted,
                    "category_id": images.category[label],
                    "score": row["score"] * row["quality"],
                }
            )
    return coco_scores(images, [image.id for image in split.images], rows)


def train_torchvision(
    data: Path, imagenet: Path, minutes: float, seed: int, rate: float, has_short_warmup: bool
) -> tuple[list[tuple[float, float]], int, dict[str, float]]:
    """Train torchvision's Mask R-CNN of the same parts by its recipe, for some minutes.

    Returns as train_ours.
    """
    import reference_loops
    import torch
    import yaml
    from torch.utils.data import DataLoader

    from cohdc_train.data.datamodule import CocoDataModule
    from cohdc_train.models import NetworkConfig
    from cohdc_train.presets import config_path
    from cohdc_train.train.module import MaskRCNNModule

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    folder = CocoDataModule(data)
    shape = yaml.safe_load(config_path("networks/hdc_net_n.yaml").read_text(encoding="utf-8"))[
        "model"
    ]["network"]
    config = NetworkConfig(**{**shape, "weights": str(imagenet), "canvas": folder.canvas})
    network = reference_loops.same_network(MaskRCNNModule(folder.class_names, config)).train()

    images = reference_loops.Images(folder.folder.train[0], flip=0.5)
    validation = folder.folder.val
    val_images = reference_loops.Images(validation, flip=0.0)
    loader = DataLoader(
        images, BATCH_SIZE, shuffle=True, collate_fn=lambda batch: tuple(zip(*batch, strict=True))
    )
    optimizer = torch.optim.SGD(
        [p for p in network.parameters() if p.requires_grad], rate, 0.9, weight_decay=1e-4
    )
    warmup_steps = min(1000, len(loader) - 1)

    budget, elapsed, step, curve = 60 * minutes, 0.0, 0, []
    scores: dict[str, float] = {}
    while True:
        for batch, targets in loader:
            started = time.monotonic()
            for group in optimizer.param_groups:
                warmup = (
                    elapsed / budget / SHORT_WARMUP
                    if has_short_warmup
                    else step / max(1, warmup_steps)
                )
                group["lr"] = rate * recipe_factor(warmup, elapsed / budget)
            losses = sum(network(list(batch), [dict(target) for target in targets]).values())
            if not torch.isfinite(losses):
                return (
                    [*curve, (elapsed / 60, 0.0)],
                    step * BATCH_SIZE,
                    {"AP": 0.0, "AP50": 0.0, "box_AP": 0.0},
                )
            optimizer.zero_grad()
            losses.backward()
            optimizer.step()
            step += 1
            elapsed += time.monotonic() - started
            if elapsed >= budget * (len(curve) + 1) / POINTS or elapsed >= budget:
                scores = score_torchvision(
                    network, val_images, [image.id for image in validation.images]
                )
                curve.append((elapsed / 60, scores["AP"]))
                network.train()
            if elapsed >= budget:
                return curve, step * BATCH_SIZE, scores


def recipe_factor(warmup: float, progress: float) -> float:
    """Return the share of the rate: linear warm-up, and drops at epochs 16 and 22 of 26.

    warmup: share of the warm-up that is over; progress: share of the budget that is used.
    """
    warmup_factor = 1e-3 + (1 - 1e-3) * min(1.0, warmup)
    return warmup_factor * math.prod(0.1 for drop in (16 / 26, 22 / 26) if progress >= drop)


def score_torchvision(network: Any, images: Any, image_ids: list[int]) -> dict[str, float]:
    """Score torchvision's network by pycocotools."""
    import reference_loops
    import torch

    network.eval()
    rows: list[dict[str, Any]] = []
    for image_id in image_ids:
        image, _ = images[images.coco.ids.index(image_id)]
        with torch.inference_mode():
            (found,) = network([image])
        rows += reference_loops.result_rows(image_id, found, images.category)
    return reference_loops.coco_scores(images, image_ids, rows)


def as_table(cells: list[dict[str, Any]]) -> str:
    """Format one row per set and budget: mask AP / AP50 of each contender, mean over seeds."""
    import numpy as np

    names = [name for name in contenders() if any(cell["contender"] == name for cell in cells)]
    lines = [f"| set, minutes, seeds | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for data, minutes in sorted({(cell["data"], cell["minutes"]) for cell in cells}):
        here = [cell for cell in cells if (cell["data"], cell["minutes"]) == (data, minutes)]
        columns = []
        for name in names:
            own = [cell for cell in here if cell["contender"] == name]
            mean = (
                [float(np.mean([cell[key] for cell in own])) for key in ("AP", "AP50")]
                if own
                else []
            )
            columns.append(f"{mean[0]:.3f} / {mean[1]:.3f} ({len(own)})" if mean else "")
        seeds = sorted({cell["seed"] for cell in here})
        lines.append(f"| {data}, {minutes:g}, {seeds} | {' | '.join(columns)} |")
    return "\n".join(lines) + "\n"


def plot_curves(cells: list[dict[str, Any]], path: Path) -> None:
    """Plot mask AP over minutes, one panel per set and budget."""
    from matplotlib.figure import Figure

    panels = sorted({(cell["data"], cell["minutes"]) for cell in cells})
    figure = Figure(figsize=(5 * max(1, len(panels)), 4), layout="constrained")
    colors = {name: f"C{i}" for i, name in enumerate(contenders())}
    for axes, panel in zip(
        figure.subplots(1, max(1, len(panels)), squeeze=False)[0], panels, strict=True
    ):
        labeled: set[str] = set()
        for cell in cells:
            name = cell["contender"]
            if (cell["data"], cell["minutes"]) == panel and cell["curve"]:
                times, scores = zip(*[(0.0, 0.0), *cell["curve"]], strict=True)
                axes.plot(
                    times, scores, "o-", color=colors[name], label=None if name in labeled else name
                )
                labeled.add(name)
        axes.set(
            title=f"{panel[0]}, {panel[1]:g} min", xlabel="minutes, one core", ylabel="mask AP"
        )
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    raise SystemExit(main())
