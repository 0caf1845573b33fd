"""Reports that lie next to exported files, and what they say about those files."""

import json
import os
from pathlib import Path
from typing import Any

from cohdc_train import __version__, signature
from cohdc_train.errors import CohdcError
from cohdc_train.exporter.graph import OPSET, count_flops
from cohdc_train.exporter.parity import TOLERANCES
from cohdc_train.exporter.scoring import SCORES
from cohdc_train.files import sha256
from cohdc_train.train.module import MaskRCNNModule


def report_path(file: Path) -> Path:
    """Return the path of a file's report."""
    return file.with_name(file.name + ".json")


def int8_path(target: Path) -> Path:
    """Return the path of a file's int8 form."""
    return target.with_name(f"{target.stem}.int8.onnx")


def describe_file(
    module: MaskRCNNModule, target: Path, file: Path, checkpoint: Path
) -> dict[str, Any]:
    """Collect the values of the report that are known without a comparison.

    Args:
        module: the network.
        target: name that the file will get.
        file: the file as it is now.
        checkpoint: where the network comes from.
    """
    cost = count_flops(module.network)
    return {
        "file": target.name,
        "checkpoint": os.path.relpath(checkpoint, target.parent),
        "checkpoint_sha256": sha256(checkpoint),
        "bytes": file.stat().st_size,
        "gflops_image": round(cost.image, 3),
        "gflops_per_detection": round(cost.detection, 4),
        "canvas": list(module.network_config.canvas),
        "opset": OPSET,
        "contract": signature.CONTRACT_VERSION,
        "version": __version__,
        "classes": list(module.class_names),
    }


def format_report(target: Path, report: dict[str, Any]) -> str:
    """Format a report as the lines that `cohdc export` prints."""
    differences = report["max_difference"]
    largest = ", ".join(f"{name} {differences[name]:.1e}" for name in TOLERANCES)
    text = (
        f"{target}: equals torch on {len(report['cases'])} cases with "
        f"{report['detections_compared']} detections, {report['most_detections']} in one image "
        f"(largest difference: {largest}; mask IoU {report['mask_iou_min']:.4f})"
    )
    if report["images_undecided"]:
        count = f"{report['images_undecided']} of {report['images']} images"
        text += f"; {count} depend on rounding in torch, too"
    if "nodes" in report:
        size = f"{report['bytes'] / 1e6:.1f} MB, {report['nodes']} nodes, opset {report['opset']}"
        image, detection = report["gflops_image"], report["gflops_per_detection"]
        text += f"\n{size}, {image:.2f} GFLOPs an image and {detection:.3f} a detection"
    for name, scores in report.get("scores", {}).items():
        text += f"\n{name}: " + ", ".join(f"{key} {scores[key]:.4f}" for key in SCORES)
    return text


def find_checkpoint(file: Path) -> Path:
    """Return the checkpoint that an ONNX file's report names.

    Raises:
        CohdcError: there is no report, or the checkpoint is gone or has changed.
    """
    path = report_path(file)
    try:
        report = json.loads(path.read_text())
        is_int8 = "quantised_operators" in report
        if not is_int8:
            checkpoint = file.parent / str(report["checkpoint"])
            digest = report["checkpoint_sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        fix = f"cohdc export CHECKPOINT --out {file} --verify-only"
        raise CohdcError(f"{path}: names no checkpoint; {fix}") from error
    if is_int8:
        raise CohdcError(f"{file}: is int8, which differs from torch; {path} has its scores")
    if not checkpoint.is_file():
        raise CohdcError(f"{path}: its checkpoint {checkpoint} is gone")
    if sha256(checkpoint) != digest:
        raise CohdcError(f"{path}: {checkpoint} has changed since the export")
    return checkpoint


def check_target(target: Path, int8: bool) -> None:
    """Raise CohdcError when an export would replace files that no former export wrote.

    An exported file is known by its report, which names it.

    Args:
        target: the file.
        int8: check its int8 form too.
    """
    for file in (target, int8_path(target)) if int8 else (target,):
        report = report_path(file)
        if not (file.exists() or report.exists()):
            continue
        try:
            is_own = json.loads(report.read_text())["file"] == file.name
        except (OSError, ValueError, KeyError, TypeError):
            is_own = False
        if not is_own:
            fix = "give another --out, or move them"
            raise CohdcError(f"{file}: it or {report.name} is not of a former cohdc export; {fix}")
