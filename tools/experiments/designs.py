#!/usr/bin/env python3
"""Size and speed of network designs before training: random weights, image to masks.

    tools/experiments/designs.py --out DIR [--designs R50 n ...] [--canvas 480 640]
        [--threads 1] [--images 6]

Every design is written as ONNX, in float32 and int8, and all files take turns on the same images.
A random network detects as many objects as its padding holds, so that the time is that of a full
image. Times are shares of the first design's in float32. Writes designs.md and designs.json to
DIR.
"""

import argparse
from pathlib import Path
from typing import Any

import torch
import yaml

from cohdc_train.bench.speed import frame_rates, make_runners
from cohdc_train.exporter.graph import count_flops, write_graph
from cohdc_train.exporter.quantization import quantize
from cohdc_train.exporter.sample_images import draw_samples
from cohdc_train.files import write_json, write_text
from cohdc_train.models import MaskRCNN, NetworkConfig
from cohdc_train.presets import config_path

PLAIN, HDC = ((1,),) * 4, ((1, 2, 3),) * 4
DEEP = ((1,), (1,), (1, 2), (1, 2, 3))  # dilated where the map is coarse
SLIM = {"proposals": (300, 100), "detections": 20}
COARSE = {"finest_stride": 8, "anchor_scales": (32, 64, 128, 256)}


def shape_of(size: str) -> dict[str, Any]:
    """Read the network of the family's shipped configuration."""
    whole = yaml.safe_load(config_path(f"networks/hdc_net_{size}.yaml").read_text(encoding="utf-8"))
    return dict(whole["model"]["network"])


DESIGNS = {
    "R50": {"rates": PLAIN},
    "R50 HDC": {"rates": HDC},
    "R34 HDC": {"depth": 34, "rates": HDC},
    "R50 slim": {"rates": PLAIN, **SLIM},
    "R34 HDC FPN128 slim": {"depth": 34, "rates": HDC, "fpn_channels": 128, "fc": 512, **SLIM},
    "R18 HDC FPN128 slim coarse": {
        "depth": 18,
        "rates": HDC,
        "fpn_channels": 128,
        "fc": 512,
        **SLIM,
        **COARSE,
    },
    "R18 HDC FPN64 slim coarse": {
        "depth": 18,
        "rates": HDC,
        "fpn_channels": 64,
        "fc": 256,
        **SLIM,
        **COARSE,
    },
    "MobileNetV1 FPN64 slim coarse": {
        **{"backbone": "mobilenet_v1", "rates": PLAIN, "fpn_channels": 64, "fc": 256},
        **SLIM,
        **COARSE,
    },
    "MobileNetV2 HDC FPN64 slim coarse": {
        **{"backbone": "mobilenet_v2", "rates": DEEP, "fpn_channels": 64, "fc": 256},
        **SLIM,
        **COARSE,
    },
    "MobileNetV2 HDC FPN32 slim coarse": {
        **{"backbone": "mobilenet_v2", "rates": DEEP, "fpn_channels": 32, "fc": 128},
        **SLIM,
        **COARSE,
    },
    "HDC-Net n": {**shape_of("n"), "canvas": (480, 640)},
    "HDC-Net s": {**shape_of("s"), "canvas": (640, 864)},
}


def main() -> None:
    """Write, quantize, time, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--designs", nargs="+", choices=DESIGNS, default=list(DESIGNS))
    parser.add_argument("--canvas", type=int, nargs=2, default=(480, 640))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--images", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(arguments.threads)
    images, runners, costs = draw_samples(arguments.images), {}, {}
    for name in arguments.designs:
        torch.manual_seed(arguments.seed)
        config = NetworkConfig(**{"canvas": tuple(arguments.canvas), **DESIGNS[name]})
        network = MaskRCNN(1, config).eval()
        file = arguments.out / f"{name.replace(' ', '_')}.onnx"
        small = file.with_suffix(".int8.onnx")
        write_graph(network, ["person"], file)
        quantize(file, small, images[:2])
        costs[name] = count_flops(network)
        files = {"float32": file, "int8": small}
        runners |= {
            (name, kind): run for kind, run in make_runners(None, files, arguments.threads).items()
        }
        print(f"{name}: {file.stat().st_size / 1e6:.1f} MB", flush=True)
    rates = frame_rates(runners, images)
    base = rates[arguments.designs[0], "float32"].median
    rows = []
    for name in arguments.designs:
        file = arguments.out / f"{name.replace(' ', '_')}.onnx"
        rows.append(
            {
                "design": name,
                "mb": file.stat().st_size / 1e6,
                "mb_int8": file.with_suffix(".int8.onnx").stat().st_size / 1e6,
                "gflops_image": costs[name].image,
                "gflops_detection": costs[name].detection,
                **{kind: base / rates[name, kind].median for kind in ("float32", "int8")},
                "float32_ms": 1e3 / rates[name, "float32"].median,
            }
        )
    write_json(arguments.out / "designs.json", rows)
    head = (
        "| design | MB | MB int8 | GFLOPs | time float32 | time int8 |\n|---|---|---|---|---|---|\n"
    )
    lines = [
        f"| {r['design']} | {r['mb']:.1f} | {r['mb_int8']:.1f} | {r['gflops_image']:.1f} "
        f"| {r['float32']:.3f} | {r['int8']:.3f} |"
        for r in rows
    ]
    write_text(arguments.out / "designs.md", head + "\n".join(lines) + "\n")
    print((arguments.out / "designs.md").read_text())


if __name__ == "__main__":
    main()
