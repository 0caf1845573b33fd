"""Steps of `cohdc export`: write, compare, keep; then the same for int8."""

import os
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cohdc_train.errors import CohdcError, ExportError
from cohdc_train.exporter.export import ExportOptions
from cohdc_train.exporter.graph import write_graph
from cohdc_train.exporter.interleaved_timing import time_interleaved
from cohdc_train.exporter.parity import compare
from cohdc_train.exporter.quantization import CALIBRATION_IMAGES, quantize
from cohdc_train.exporter.report_files import (
    check_target,
    describe_file,
    find_checkpoint,
    format_report,
    int8_path,
    report_path,
)
from cohdc_train.exporter.sample_images import draw_samples, read_samples
from cohdc_train.exporter.scoring import SCORES, ValidationScorer
from cohdc_train.files import write_json
from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.types import Image

_PARITY_IMAGES = 4
_TIMED_IMAGES = 8
_MAX_INT8_DROP = 0.01  # of mask AP by int8
_MAX_AP_CHANGE = 0.001  # of mask AP between torch and float32 ONNX
_COPIED_KEYS = ("checkpoint", "checkpoint_sha256", "opset", "contract", "classes")


def export_checkpoint(checkpoint: Path, out: Path | None, options: ExportOptions) -> Path:
    """Run `cohdc_train.exporter.export.export`."""
    if options.verify_only and checkpoint.suffix == ".onnx":
        checkpoint, out = find_checkpoint(checkpoint), checkpoint
    target = checkpoint.parent / "model.onnx" if out is None else out
    canvas = options.canvas
    if options.verify_only:
        if not target.is_file():
            raise CohdcError(f"{target}: no such file")
        canvas = Segmenter(target).canvas
    else:
        check_target(target, options.int8 is not None)

    module = MaskRCNNModule.load(checkpoint, canvas)
    images = _parity_images(options.images)
    scorer = None
    if options.data is not None:
        scorer = ValidationScorer(module, options.data, checkpoint)
    if options.verify_only:
        print(format_report(target, _verify(module, target, target, images, scorer)))
        return target

    target.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    with _draft(target) as draft:
        network = module.network.float().cpu().eval()
        num_nodes = write_graph(network, list(module.class_names), draft)
        result = _verify(module, draft, target, images, scorer)
        report = describe_file(module, target, draft, checkpoint) | {"nodes": num_nodes} | result
        report["seconds"] = round(time.monotonic() - start, 1)
    write_json(report_path(target), report)
    print(format_report(target, report))
    if options.int8 is not None:
        _write_int8(target, options.int8, report, scorer, options.allow_drop)
    return target


def _parity_images(folder: Path | None) -> list[Image]:
    if folder is None:
        return draw_samples(_PARITY_IMAGES)
    return list(read_samples(folder, _PARITY_IMAGES))


def _verify(
    module: MaskRCNNModule,
    file: Path,
    target: Path,
    images: list[Image],
    scorer: ValidationScorer | None,
) -> dict[str, Any]:
    """Compare a file with its network, and with a scorer their APs.

    Args:
        module: the network.
        file: the file as it is now.
        target: name that it will get, for messages.
        images: to compare on.
        scorer: None skips the APs.

    Returns:
        Values for the report.

    Raises:
        ExportError: they differ too much.
    """
    parity = compare(module.network, file, images)
    parity.require(target)
    report = parity.report()
    if scorer is not None:
        scores = {"torch": scorer.score_network(), "onnx": scorer.score_file(file)}
        change = scores["onnx"]["segm_AP"] - scores["torch"]["segm_AP"]
        if not abs(change) <= _MAX_AP_CHANGE:
            raise ExportError(
                f"{target}: mask AP differs from torch's by {change:+.4f}, allowed {_MAX_AP_CHANGE}"
            )
        report["scores"] = scores
    return report


def _write_int8(
    target: Path,
    calibration: Path,
    report: dict[str, Any],
    scorer: ValidationScorer | None,
    allow_drop: bool,
) -> None:
    """Write the int8 form of a verified file, with its own report.

    Args:
        target: the float32 file.
        calibration: folder of images.
        report: of the float32 file.
        scorer: None skips the APs.
        allow_drop: keep a file that loses too much.

    Raises:
        ExportError: it loses too much.
    """
    name = int8_path(target)
    with _draft(name) as draft:
        num_operators = quantize(target, draft, read_samples(calibration, CALIBRATION_IMAGES))
        size = draft.stat().st_size
        int8_report = {key: report[key] for key in _COPIED_KEYS}
        int8_report |= {"file": name.name, "bytes": size, "quantised_operators": num_operators}
        seconds = _time_both(target, draft, calibration)
        int8_report["seconds_per_image"] = seconds
        ratio = seconds["int8"] / seconds["float32"]
        line = f"{name}: {size / 1e6:.1f} MB, {ratio:.2f} of float32's time on one thread"
        if scorer is not None:
            scores = {"float32": report["scores"]["onnx"], "int8": scorer.score_file(draft)}
            int8_report["scores"] = scores
            _check_drop(name, scores, allow_drop)
            line += "; " + _format_change(scores)
    write_json(report_path(name), int8_report)
    print(line)


def _time_both(float_file: Path, int8_file: Path, folder: Path) -> dict[str, float]:
    """Measure the median time per image of both files on one thread, s."""
    files = {"float32": float_file, "int8": int8_file}
    segmenters = {name: Segmenter(file, num_threads=1) for name, file in files.items()}
    times = time_interleaved(segmenters, list(read_samples(folder, _TIMED_IMAGES)))
    return {name: statistics.median(seconds) for name, seconds in times.items()}


def _check_drop(file: Path, scores: dict[str, dict[str, float]], allow_drop: bool) -> None:
    drop = scores["float32"]["segm_AP"] - scores["int8"]["segm_AP"]
    if not drop <= _MAX_INT8_DROP and not allow_drop:
        loss = f"mask AP falls by {drop:.3f} in int8, allowed {_MAX_INT8_DROP}"
        raise ExportError(f"{file}: {loss}; --allow-drop")


def _format_change(scores: dict[str, dict[str, float]]) -> str:
    before, after = scores["float32"], scores["int8"]
    return ", ".join(f"{key} {before[key]:.3f} -> {after[key]:.3f}" for key in SCORES)


@contextmanager
def _draft(target: Path) -> Iterator[Path]:
    """Give a name to write to; it becomes `target` when the block succeeds, else it is removed."""
    draft = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        yield draft
        os.replace(draft, target)
    finally:
        draft.unlink(missing_ok=True)
