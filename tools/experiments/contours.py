#!/usr/bin/env python3
"""Ways to simplify outlines, on real masks: vertices, IoU, Boundary IoU, time and file size.

    tools/experiments/contours.py --out DIR [--data NAME=COCO_FOLDER ...]
        [--model FILE --photos FOLDER] [--count 300] [--seed 0]

Sources: people that `cohdc synth` renders, the annotated objects of every COCO folder, and the
masks that a model detects in a folder's images. `count` of each are drawn by the seed among those
of at least 400 px. `dp` has one tolerance per source and floor, at which its mean IoU is that of
bas_dp. Writes contours.json, contours.md and contours.png to DIR.
"""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from cohdc_train.contour import Polygon, count_vertices, rasterize, simplify, trace
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.files import write_bytes, write_json, write_text
from cohdc_train.models.cqe_targets import band_of, boundary_iou
from cohdc_train.prediction.image_sources import read_images
from cohdc_train.segmenter import Segmenter
from cohdc_train.synth.coco import coco

FLOORS = (0.9, 0.95, 0.97, 0.99)
METHODS = ("bisection", "visvalingam", "bas_dp")
LEAST_AREA = 400  # px


def main() -> None:
    """Draw masks, simplify them, write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", nargs="*", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if (arguments.model is None) != (arguments.photos is None):
        parser.error("--model and --photos go together")
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = []
    for source, masks in sources(arguments):
        if not masks:
            continue
        outlines = [trace(mask) for mask in masks]
        vertices = np.mean([count_vertices(outline) for outline in outlines])
        print(f"{source}: {len(masks)} contours, {vertices:.0f} vertices", flush=True)
        rows.append(measured("trace", source, 1.0, masks, outlines, [0.0]))
        for floor in FLOORS:
            for method in METHODS:
                simpler, taken = simplified(outlines, floor, method)
                rows.append(measured(method, source, floor, masks, simpler, taken))
            rows.append(fixed_tolerance(source, floor, masks, outlines, rows[-1]["iou_mean"]))
    write_json(arguments.out / "contours.json", rows)
    write_text(arguments.out / "contours.md", table(rows))
    write_bytes(arguments.out / "contours.png", plot(rows))
    print(table(rows))


def sources(arguments: argparse.Namespace) -> Iterator[tuple[str, list[np.ndarray]]]:
    """List (name, masks) of each source; crowds are skipped."""
    rng = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        coco(
            Path(folder) / "synth",
            train=arguments.count,
            val=1,
            size=(480, 640),
            seed=arguments.seed,
        )
        yield "synthetic", annotated(Path(folder) / "synth", arguments.count, rng)
    for entry in arguments.data:
        name, _, root = entry.partition("=")
        yield name, annotated(Path(root), arguments.count, rng)
    if arguments.model is not None:
        network = Segmenter(arguments.model, num_threads=1)
        masks: list[np.ndarray] = []
        for image in read_images(arguments.photos):
            found = network(image.rgb)
            masks += [
                mask
                for mask in found.select(found.scores >= 0.5).masks()
                if mask.sum() >= LEAST_AREA
            ]
            if len(masks) >= arguments.count:
                break
        yield "segmenter", masks[: arguments.count]


def annotated(root: Path, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Draw the masks of some training objects."""
    images = CocoDataModule(root).folder.train[0].images
    objects = [(image, o) for image in images for o in image.objects if not o.crowd]
    masks = []
    for index in rng.permutation(len(objects)):
        image, one = objects[index]
        mask = one.mask(image.height, image.width).astype(bool)
        if mask.sum() >= LEAST_AREA:
            masks.append(mask)
        if len(masks) == count:
            break
    return masks


def simplified(
    outlines: list[list[Polygon]], floor: float, method: str, epsilon: float = 2.0
) -> tuple[list[list[Polygon]], list[float]]:
    """Simplify outlines; returns them and the CPU seconds of each."""
    simpler, taken = [], []
    for outline in outlines:
        started = time.process_time()
        simpler.append(simplify(outline, floor, method, epsilon))
        taken.append(time.process_time() - started)
    return simpler, taken


def ious(masks: list[np.ndarray], outlines: list[list[Polygon]]) -> list[float]:
    """Compute the IoU of each outline with its mask."""
    values = []
    for mask, outline in zip(masks, outlines, strict=True):
        filled = rasterize(outline, mask.shape)
        values.append(np.count_nonzero(filled & mask) / np.count_nonzero(filled | mask))
    return values


def measured(
    method: str,
    source: str,
    floor: float,
    masks: list[np.ndarray],
    outlines: list[list[Polygon]],
    taken: list[float],
) -> dict[str, object]:
    """Make a row of contours.json: means over the contours, and the median time."""
    overlap = ious(masks, outlines)
    edges = []
    for mask, outline in zip(masks, outlines, strict=True):
        filled = rasterize(outline, mask.shape)
        edges.append(
            float(
                boundary_iou(torch.from_numpy(filled), torch.from_numpy(mask), band_of(*mask.shape))
            )
        )
    texts = [
        json.dumps([p.keyhole().ravel().round(1).tolist() for p in o], separators=(",", ":"))
        for o in outlines
    ]
    return {
        "method": method,
        "source": source,
        "iou_floor": floor,
        "contours": len(masks),
        "vertices": statistics.fmean(count_vertices(outline) for outline in outlines),
        "iou_mean": statistics.fmean(overlap),
        "iou_min": min(overlap),
        "boundary_iou": statistics.fmean(edges),
        "ms": 1e3 * statistics.median(taken),
        "ms_p95": 1e3 * float(np.percentile(taken, 95)),
        "bytes": statistics.fmean(len(text) for text in texts),
    }


def fixed_tolerance(
    source: str, floor: float, masks: list[np.ndarray], outlines: list[list[Polygon]], mean: float
) -> dict[str, object]:
    """Simplify by Douglas-Peucker with the one tolerance whose mean IoU is `mean`."""
    low, high = 0.1, 20.0
    for _ in range(9):
        middle = (low * high) ** 0.5
        simpler, taken = simplified(outlines, floor, "dp", middle)
        low, high = (
            (middle, high) if statistics.fmean(ious(masks, simpler)) >= mean else (low, middle)
        )
    simpler, taken = simplified(outlines, floor, "dp", low)
    return measured("dp", source, floor, masks, simpler, taken) | {"epsilon": low}


def table(rows: list[dict]) -> str:
    """Format a Markdown table, relative to bisection and to fixed Douglas-Peucker."""
    text = "| source | floor | method | vertices | of bisection | of dp | IoU mean | IoU least "
    text += "| Boundary IoU | ms median | ms p95 | bytes |\n" + "|---" * 12 + "|\n"
    for row in rows:
        rest = {
            r["method"]: r
            for r in rows
            if (r["source"], r["iou_floor"]) == (row["source"], row["iou_floor"])
        }
        shares = [
            f"{row['vertices'] / rest[m]['vertices']:.2f}" if m in rest else ""
            for m in ("bisection", "dp")
        ]
        cells = [
            row["source"],
            f"{row['iou_floor']:.2f}",
            row["method"],
            f"{row['vertices']:.1f}",
            *shares,
        ]
        cells += [f"{row[key]:.3f}" for key in ("iou_mean", "iou_min", "boundary_iou")]
        cells += [f"{row[key]:.2f}" for key in ("ms", "ms_p95")] + [f"{row['bytes']:.0f}"]
        text += "| " + " | ".join(cells) + " |\n"
    return text


def plot(rows: list[dict]) -> bytes:
    """Plot vertices over mean IoU as a PNG, one panel per source."""
    import io

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row["source"] for row in rows))
    figure = Figure(figsize=(4 * len(names), 3.6), layout="constrained")
    for axes, name in zip(np.ravel(figure.subplots(1, len(names))), names, strict=True):
        for method in ("dp", *METHODS):
            points = [
                (r["iou_mean"], r["vertices"])
                for r in rows
                if (r["source"], r["method"]) == (name, method)
            ]
            axes.plot(*zip(*points, strict=True), "o-", label=method)
        axes.set(title=name, xlabel="mean IoU", ylabel="vertices", yscale="log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.grid(alpha=0.3)
        axes.legend()
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)
    return stream.getvalue()


if __name__ == "__main__":
    main()
