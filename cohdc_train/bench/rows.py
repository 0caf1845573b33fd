"""Networks of Table 4's rows: trained or finished, exported and scored once."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pycocotools import mask as rle

from cohdc_train.bench.networks import NetworkBenchOptions
from cohdc_train.bench.speed import MIN_SCORE
from cohdc_train.bench.training import train
from cohdc_train.contour import count_vertices, simplify, trace
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.exporter.export import export
from cohdc_train.files import sha256, write_json
from cohdc_train.metrics.coco_metrics import Results
from cohdc_train.presets import config_path, model_path
from cohdc_train.validation import score_file

ROWS = {  # the paper's, as shipped configurations
    "HDC-Net": "networks/hdc_net_m.yaml",
    "ResNet50": "networks/resnet50.yaml",
    "ResNet101": "networks/resnet101.yaml",
    "MobileNetV1": "networks/mobilenet_v1.yaml",
}
SCORES = {  # column of table4.json -> score of `cohdc validate`
    "ap": "segm_AP",
    "boundary_ap": "boundary_AP",
    "s90_matched": "S90_matched",
    "s90_all": "S90_all",
}
_MIN_POLYGON_IOU = 0.95  # of the polygons whose vertices are counted


@dataclass(frozen=True)
class ScoredNetwork:
    """One network of a row, with its files and scores.

    Attributes:
        name: name of the row.
        seed: seed of its training; None for a finished model.
        checkpoint: None for an ONNX file.
        files: "fps_ort" -> its ONNX file, and "fps_ort_int8" -> the quantized one where there is
            one.
        train_seconds: None for a finished model.
        scores: ap, boundary_ap, s90_matched, s90_all, vertices, and ap_int8 where there is an int8
            file.
    """

    name: str
    seed: int | None
    checkpoint: Path | None
    files: Mapping[str, Path]
    train_seconds: float | None
    scores: Mapping[str, float]


def train_row(
    row: str, seed: int, data: Path, folder: Path, options: NetworkBenchOptions
) -> ScoredNetwork:
    """Train, export and score a row with one seed; finished steps in the folder are not repeated.

    Args:
        row: a name of ROWS, or the YAML file of another network.
        seed: seed of the training.
        data: COCO-format folder.
        folder: where everything goes.
        options: of the comparison.

    Raises:
        CohdcError: there is no such row, or a step failed.
    """
    weights = (options.weights or {}).get(row)
    start = "--pretrained=none" if weights is None else f"--model.network.weights={weights}"
    own = [f"--config={row_config(row)}", f"--seed_everything={seed}", start]
    run = train(folder, [data.resolve()], (*options.fit_arguments(), *own), options.threads)
    files = _export_once(run.checkpoint, data, folder, options.int8)
    scores = _score_once(files, data, folder / "scores.json", options.threads)
    return ScoredNetwork(Path(row).stem, seed, run.checkpoint, files, run.seconds, scores)


def row_config(row: str) -> Path:
    """Return the configuration file of a row.

    Raises:
        CohdcError: there is no such row.
    """
    try:
        return config_path(ROWS.get(row, row))
    except CohdcError as error:
        rows = ", ".join(ROWS)
        raise CohdcError(f"no row {row!r}; there are {rows}, and YAML files of networks") from error


def score_model(model: Path, data: Path, out: Path, options: NetworkBenchOptions) -> ScoredNetwork:
    """Score a finished model: an ONNX file, or a checkpoint, which is exported below `out`.

    Raises:
        CohdcError: there is no such file, or a step failed.
    """
    model = model_path(model)
    if not model.is_file():
        raise CohdcError(f"{model}: no such file")
    # Most checkpoints are called best.ckpt, so the content is part of the name.
    folder = out / f"model_{model.stem}_{sha256(model)[:8]}"
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint = None if model.suffix == ".onnx" else model
    files = {"fps_ort": model}
    if checkpoint is not None:
        files = _export_once(checkpoint, data, folder, options.int8)
    scores = _score_once(files, data, folder / "scores.json", options.threads)
    return ScoredNetwork(model.name, None, checkpoint, files, None, scores)


def _export_once(checkpoint: Path, data: Path, folder: Path, int8: bool) -> dict[str, Path]:
    """Export a checkpoint into a folder, unless its files lie there; returns them by column."""
    file, int8_file = folder / "model.onnx", folder / "model.int8.onnx"
    cache_file = folder / "exported.json"
    request = {"checkpoint": sha256(checkpoint), "int8": int8}
    needed = [cache_file, file, *([int8_file] if int8 else [])]
    is_cached = all(path.is_file() for path in needed)
    if not is_cached or json.loads(cache_file.read_text()) != request:
        images = CocoDataModule(data).folder.train[0].images[0].path.parent
        calibration = images if int8 else None
        export(checkpoint, file, images=images, int8=calibration, allow_drop=True)
        write_json(cache_file, request)
    files = {"fps_ort": file}
    if int8:
        files["fps_ort_int8"] = int8_file
    return files


def _score_once(
    files: Mapping[str, Path], data: Path, cache_file: Path, threads: int
) -> dict[str, float]:
    """Score the files, unless the cache holds the scores of the same files and data."""
    made_from = {name: sha256(path) for name, path in files.items()} | {"data": str(data.resolve())}
    if cache_file.is_file():
        cached = json.loads(cache_file.read_text())
        if cached["made_from"] == made_from:
            return dict(cached["scores"])

    results = score_file(files["fps_ort"], data, threads=threads)
    scores = {column: results.scores[score] for column, score in SCORES.items()}
    scores["vertices"] = mean_vertices(results)
    if "fps_ort_int8" in files:
        int8_results = score_file(files["fps_ort_int8"], data, threads=threads)
        scores["ap_int8"] = int8_results.scores["segm_AP"]
    write_json(cache_file, {"made_from": made_from, "scores": scores})
    return scores


def mean_vertices(results: Results) -> float:
    """Count the vertices of likely detections' BAS-DP polygons at an IoU of 0.95.

    Returns:
        The mean over the detections; nan without a detection.
    """
    likely = [row for row in results.rows if row["score"] >= MIN_SCORE]
    masks = [rle.decode(row["segmentation"]).astype(np.bool_) for row in likely]
    polygons = [simplify(trace(mask), _MIN_POLYGON_IOU, "bas_dp") for mask in masks if mask.any()]
    counts = [count_vertices(polygon) for polygon in polygons]
    return float(np.mean(counts)) if counts else float("nan")
