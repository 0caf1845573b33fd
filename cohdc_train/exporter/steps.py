"""The steps of `cohdc export`: write, prove, name; then the same for int8."""

import json
import os
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cohdc_train import __version__, signature
from cohdc_train.errors import CohdcError, ExportError
from cohdc_train.exporter.graph import OPSET, count_flops, write_graph
from cohdc_train.exporter.interleaved_timing import time_interleaved
from cohdc_train.exporter.parity import TOLERANCES, compare
from cohdc_train.exporter.quantization import CALIBRATION_IMAGES, quantize
from cohdc_train.exporter.sample_images import drawn_images, read_images
from cohdc_train.exporter.scoring import SCORES, Scorer
from cohdc_train.files import sha256, write_json
from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.types import Image

_PARITY_IMAGES = 4
_MOST_DROP = 0.01  # of mask AP by int8
_MOST_CHANGE = 0.001  # of mask AP between torch and float32 ONNX


def run(
    checkpoint: Path,
    out: Path | None,
    images: Path | None,
    canvas: tuple[int, int] | None,
    data: Path | None,
    int8: Path | None,
    allow_drop: bool,
    verify_only: bool,
) -> Path:
    """`cohdc_train.exporter.export.export`."""
    if int8 is not None and data is None and not allow_drop:
        raise CohdcError(
            f"{int8}: int8 needs --data, whose AP tells what it loses, or --allow-drop"
        )
    if verify_only and checkpoint.suffix == ".onnx":
        checkpoint, out = _checkpoint_of(checkpoint), checkpoint
    target = out if out is not None else checkpoint.parent / "model.onnx"
    if verify_only and not target.is_file():
        raise CohdcError(f"{target}: no such file")
    if not verify_only:
        _check_target(target, int8 is not None)
    module = MaskRCNNModule.load(checkpoint, Segmenter(target).canvas if verify_only else canvas)
    pictures = (
        list(read_images(images, _PARITY_IMAGES))
        if images is not None
        else drawn_images(_PARITY_IMAGES)
    )
    scorer = Scorer(module, data, checkpoint) if data is not None else None
    if verify_only:
        print(_describe(target, _prove(module, target, target, pictures, scorer)))
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    with _draft(target) as temporary:
        nodes = write_graph(
            module.network.float().cpu().eval(), list(module.class_names), temporary
        )
        proof = _prove(module, temporary, target, pictures, scorer)
        report = _facts(module, target, temporary, checkpoint) | {"nodes": nodes} | proof
        report["seconds"] = round(time.monotonic() - started, 1)
    write_json(_report_path(target), report)
    print(_describe(target, report))
    if int8 is not None:
        _write_int8(target, int8, report, scorer, allow_drop)
    return target


def _prove(
    module: MaskRCNNModule, file: Path, name: Path, pictures: list[Image], scorer: Scorer | None
) -> dict[str, Any]:
    """Parity and, with a scorer, APs of a file that will be called `name`. Raises ExportError."""
    parity = compare(module.network, file, pictures)
    parity.require(name)
    report = parity.report()
    if scorer is not None:
        report["scores"] = {"torch": scorer.network(), "onnx": scorer.file(file)}
        change = report["scores"]["onnx"]["segm_AP"] - report["scores"]["torch"]["segm_AP"]
        if not abs(change) <= _MOST_CHANGE:
            raise ExportError(
                f"{name}: mask AP differs from torch's by {change:+.4f}, allowed {_MOST_CHANGE}"
            )
    return report


def _write_int8(
    target: Path, calibration: Path, report: dict[str, Any], scorer: Scorer | None, allow_drop: bool
) -> None:
    """The int8 form of a proven file, with its own report. Raises ExportError when it loses too
    much.
    """
    name = _int8_path(target)
    with _draft(name) as temporary:
        operators = quantize(target, temporary, read_images(calibration, CALIBRATION_IMAGES))
        facts = {
            key: report[key]
            for key in ("checkpoint", "checkpoint_sha256", "opset", "contract", "classes")
        }
        facts |= {
            "file": name.name,
            "bytes": temporary.stat().st_size,
            "quantised_operators": operators,
        }
        runners = {"float32": Segmenter(target, threads=1), "int8": Segmenter(temporary, threads=1)}
        taken = time_interleaved(runners, list(read_images(calibration, 8)))
        seconds = {kind: statistics.median(times) for kind, times in taken.items()}
        facts["seconds_per_image"] = seconds
        share = seconds["int8"] / seconds["float32"]
        said = f"{name}: {facts['bytes'] / 1e6:.1f} MB, {share:.2f} of float32's time on one thread"
        if scorer is not None:
            scores = {"float32": report["scores"]["onnx"], "int8": scorer.file(temporary)}
            facts["scores"] = scores
            drop = scores["float32"]["segm_AP"] - scores["int8"]["segm_AP"]
            if not drop <= _MOST_DROP and not allow_drop:
                raise ExportError(
                    f"{name}: mask AP falls by {drop:.3f} in int8, allowed {_MOST_DROP}; --allow-drop"
                )
            said += "; " + ", ".join(
                f"{key} {scores['float32'][key]:.3f} -> {scores['int8'][key]:.3f}" for key in SCORES
            )
    write_json(_report_path(name), facts)
    print(said)


def _facts(module: MaskRCNNModule, target: Path, file: Path, checkpoint: Path) -> dict[str, Any]:
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


def _describe(target: Path, report: dict[str, Any]) -> str:
    worst = ", ".join(f"{name} {report['max_difference'][name]:.1e}" for name in TOLERANCES)
    text = (
        f"{target}: equals torch on {len(report['cases'])} cases with {report['detections_compared']} detections, "
        f"{report['most_detections']} in one image (largest difference: {worst}; mask IoU {report['mask_iou_min']:.4f})"
    )
    if report["images_undecided"]:
        text += f"; {report['images_undecided']} of {report['images']} images hinge on rounding in torch, too"
    if "nodes" in report:
        text += (
            f"\n{report['bytes'] / 1e6:.1f} MB, {report['nodes']} nodes, opset {report['opset']}, "
            f"{report['gflops_image']:.2f} GFLOPs an image and {report['gflops_per_detection']:.3f} a detection"
        )
    for name, scores in report.get("scores", {}).items():
        text += f"\n{name}: " + ", ".join(f"{key} {scores[key]:.4f}" for key in SCORES)
    return text


def _checkpoint_of(file: Path) -> Path:
    """The checkpoint that an ONNX file's report names. Raises CohdcError when it is gone or has
    changed.
    """
    path = _report_path(file)
    try:
        report = json.loads(path.read_text())
        if "quantised_operators" in report:
            raise CohdcError(
                f"{file}: is int8, which differs from torch; what it scores is in {path}"
            )
        checkpoint, digest = file.parent / str(report["checkpoint"]), report["checkpoint_sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CohdcError(
            f"{path}: names no checkpoint; cohdc export CHECKPOINT --out {file} --verify-only"
        ) from error
    if not checkpoint.is_file():
        raise CohdcError(f"{path}: its checkpoint {checkpoint} is gone")
    if sha256(checkpoint) != digest:
        raise CohdcError(f"{path}: {checkpoint} has changed since the export")
    return checkpoint


def _check_target(target: Path, int8: bool) -> None:
    """Raise CohdcError when an export would replace files that no former export wrote.

    An exported file is known by the report beside it, which names it.
    """
    for file in (target, _int8_path(target)) if int8 else (target,):
        report = _report_path(file)
        if not (file.exists() or report.exists()):
            continue
        try:
            is_own = json.loads(report.read_text())["file"] == file.name
        except (OSError, ValueError, KeyError, TypeError):
            is_own = False
        if not is_own:
            fix = "give another --out, or move them"
            raise CohdcError(f"{file}: it or {report.name} is not of a former cohdc export; {fix}")


def _int8_path(target: Path) -> Path:
    return target.with_name(f"{target.stem}.int8.onnx")


def _report_path(file: Path) -> Path:
    return file.with_name(file.name + ".json")


@contextmanager
def _draft(target: Path) -> Iterator[Path]:
    """A name to write to, which becomes `target` when the block ends well and is gone when it does
    not.
    """
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
