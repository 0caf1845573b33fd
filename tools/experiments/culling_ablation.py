#!/usr/bin/env python3
"""Compare masks dilated by CQE quality, dilated alike, and filtered at 0.9 as in the paper.

    tools/experiments/culling_ablation.py --sequences DIR [DIR ...] --out OUT [--model person]
        [--seeds 0 1 2] [--settings OPTION=VALUE ...]

The model segments every frame once; the masks that each way of culling makes of that are written as
PNGs, and `cohdc slam` runs on them. The bands that are alike are as wide as those by quality are on
average. A sequence has true masks in `masks/`: "covered" is the share of the people's pixels that a
way culls, "lost" that of all others. Every row goes into OUT/culling.json as soon as it is there,
the medians and worst of the seeds into OUT/culling.md.
"""

import argparse
import statistics
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from slam_settings import add_settings_option

from cohdc_train.files import write_json, write_text
from cohdc_train.presets import model_path
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.slam.config import MaskConfig, SlamConfig
from cohdc_train.slam.dynamics.mask_sources import dilation_for, dynamic_mask, select_dynamic
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import RecordedSequence, rgbd_format
from cohdc_train.slam.io.tum import read_mask
from cohdc_train.slam.run import run_slam

Row = dict[str, Any]
BY_QUALITY = MaskConfig(quality_dilation=1.0)


def main() -> None:
    """Segment, cull in every way, run, write."""
    arguments = parse()
    segmenter = Segmenter(model_path(arguments.model), 1)
    labels = frozenset(range(len(segmenter.class_names)))
    rows: list[Row] = []
    for sequence in arguments.sequences:
        camera, _ = choose_camera(sequence, None)
        source = RecordedSequence(sequence, camera, rgbd_format(camera))
        found = {view.name: segmenter(view.rgb) for view in source}
        truth = {name: read_mask(sequence / "masks" / f"{name}.png", camera) for name in found}
        for way, config in ways(found.values(), labels).items():
            folder = arguments.out / sequence.name / way.replace(" ", "_")
            row = {"sequence": sequence.name, "way": way}
            row |= write_masks(folder / "masks", found, truth, labels, config)
            for seed in arguments.seeds:
                options = {"seed": seed, "masks.dilation_px": 0, **arguments.settings}
                metrics = run_slam(
                    sequence,
                    folder / f"seed{seed}",
                    masks=folder / "masks",
                    settings=SlamConfig().override(options),
                )
                ate = metrics.get("ate_m", {}).get("rmse")
                rows.append(row | {"seed": seed, "ate_m": ate, "coverage": metrics["coverage"]})
                write_json(arguments.out / "culling.json", rows)
                write_text(arguments.out / "culling.md", table(rows))
    print(table(rows))


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--sequences", type=Path, nargs="+", required=True, help="TUM-format folders with masks/"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--model", type=Path, default=Path("person"), help="ONNX or a shipped network's name"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    add_settings_option(parser)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    return arguments


def ways(found: Iterable[Detections], labels: frozenset[int]) -> dict[str, MaskConfig]:
    """Return the mask options that are compared, for the detections of a sequence."""
    qualities = [q for one in found for q in select_dynamic(one, labels, BY_QUALITY).quality]
    alike = round(dilation_for(BY_QUALITY, float(np.mean(qualities or [1.0]))))
    return {
        "by quality": BY_QUALITY,
        "alike": replace(BY_QUALITY, quality_dilation=0.0, dilation_px=alike),
        "alike, 10 px": replace(BY_QUALITY, quality_dilation=0.0),
        "no band": replace(BY_QUALITY, dilation_px=0),
        "filter .9": replace(BY_QUALITY, min_quality=0.9),
    }


def write_masks(
    folder: Path,
    found: dict[str, Detections],
    truth: dict[str, np.ndarray],
    labels: frozenset[int],
    config: MaskConfig,
) -> Row:
    """PNGs of what is culled, and how well that covers the true masks."""
    folder.mkdir(parents=True, exist_ok=True)
    covered, lost, people, others = 0, 0, 0, 0
    for name, detections in found.items():
        mask = dynamic_mask(detections, labels, config)
        cv2.imwrite(str(folder / f"{name}.png"), mask.astype(np.uint8) * 255)
        covered, people = covered + int((mask & truth[name]).sum()), people + int(truth[name].sum())
        lost, others = lost + int((mask & ~truth[name]).sum()), others + int((~truth[name]).sum())
    return {
        "covered": covered / max(people, 1),
        "lost": lost / max(others, 1),
        "dilate": config.dilation_px,
    }


def table(rows: list[Row]) -> str:
    """Return a table of ATE RMSE in m, coverage, and the pixels that masks cover and lose.

    The errors are the median and the worst over the seeds, the coverage is the least.
    """
    lines = [
        "| sequence | culling | people covered | others lost | ATE RMSE, m | frames |",
        "|---|---|---|---|---|---|",
    ]
    for sequence, way in dict.fromkeys((row["sequence"], row["way"]) for row in rows):
        ours = [row for row in rows if (row["sequence"], row["way"]) == (sequence, way)]
        known = [row["ate_m"] for row in ours if row["ate_m"] is not None]
        error = f"{statistics.median(known):.4f} ({max(known):.4f})" if known else "lost"
        share = f"{100 * ours[0]['covered']:.1f} % | {100 * ours[0]['lost']:.1f} %"
        least = f"{100 * min(row['coverage'] for row in ours):.0f} %"
        lines.append(f"| {sequence} | {way} | {share} | {error} | {least} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
