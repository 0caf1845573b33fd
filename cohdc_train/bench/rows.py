"""What stands in a row of Table 4: a trained network or a finished model, exported and scored once."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pycocotools import mask as rle

from cohdc_train.bench.speed import LIKELY
from cohdc_train.bench.training import Trained, train
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
SCORES = {
    "ap": "segm_AP",
    "boundary_ap": "boundary_AP",
    "s90_matched": "S90_matched",
    "s90_all": "S90_all",
}
_IOU_FLOOR = 0.95  # of the polygons whose vertices are counted


@dataclass(frozen=True)
class Entry:
    """One network of a row.

    Attributes:
        name: of the row.
        seed: of its training; None of a finished model.
        checkpoint: None of an ONNX file.
        files: "fps_ort" -> its ONNX file, "fps_ort_int8" -> the quantised one where there is one.
        train_seconds: None of a finished model.
        scores: ap, boundary_ap, s90_matched, s90_all, vertices, and ap_int8 where there is an int8
            file.
    """

    name: str
    seed: int | None
    checkpoint: Path | None
    files: Mapping[str, Path]
    train_seconds: float | None
    scores: Mapping[str, float]


def trained_entry(
    row: str,
    seed: int,
    data: Path,
    folder: Path,
    options: Sequence[str],
    weights: str | None,
    threads: int,
    int8: bool,
) -> Entry:
    """Train a row with a seed in a folder, or take what lies there.

    row: a name of ROWS or the YAML file of another network. Raises CohdcError when it is neither.
    """
    own = [f"--config={row_config(row)}", f"--seed_everything={seed}"]
    own.append("--pretrained=none" if weights is None else f"--model.network.weights={weights}")
    trained = train(folder, [data.resolve()], (*options, *own), threads)
    return _exported(Path(row).stem, seed, trained, data, folder, threads, int8)


def row_config(row: str) -> Path:
    """The configuration of a row. Raises CohdcError naming a row that there is not."""
    try:
        return config_path(ROWS.get(row, row))
    except CohdcError as error:
        raise CohdcError(
            f"no row {row!r}; there are {', '.join(ROWS)}, and YAML files of networks"
        ) from error


def finished_entry(model: Path, data: Path, out: Path, threads: int, int8: bool) -> Entry:
    """A checkpoint, exported into a folder below `out`, or an ONNX file as it is."""
    model = model_path(model)
    if not model.is_file():
        raise CohdcError(f"{model}: no such file")
    folder = (
        out / f"model_{model.stem}_{sha256(model)[:8]}"
    )  # most checkpoints are called best.ckpt
    if model.suffix == ".onnx":
        folder.mkdir(parents=True, exist_ok=True)
        files = {"fps_ort": model}
        return Entry(
            model.name,
            None,
            None,
            files,
            None,
            _scores(files, data, folder / "scores.json", threads),
        )
    return _exported(model.name, None, Trained(model, 0.0), data, folder, threads, int8)


def _exported(
    name: str,
    seed: int | None,
    trained: Trained,
    data: Path,
    folder: Path,
    threads: int,
    int8: bool,
) -> Entry:
    file = folder / "model.onnx"
    small = file.with_name("model.int8.onnx")
    digest, kept = sha256(trained.checkpoint), folder / "exported.json"
    there = all(path.is_file() for path in (kept, file, *([small] if int8 else [])))
    if not (there and json.loads(kept.read_text()) == {"checkpoint": digest, "int8": int8}):
        images = CocoDataModule(data).folder.train[0].images[0].path.parent
        export(
            trained.checkpoint, file, images=images, int8=images if int8 else None, allow_drop=True
        )
        write_json(kept, {"checkpoint": digest, "int8": int8})
    files = {"fps_ort": file} | ({"fps_ort_int8": small} if int8 else {})
    seconds = None if seed is None else trained.seconds
    scores = _scores(files, data, folder / "scores.json", threads)
    return Entry(name, seed, trained.checkpoint, files, seconds, scores)


def _scores(files: Mapping[str, Path], data: Path, kept: Path, threads: int) -> dict[str, float]:
    """Scores of the files, kept with what they were made from."""
    made_from = {name: sha256(path) for name, path in files.items()} | {"data": str(data.resolve())}
    if kept.is_file():
        known = json.loads(kept.read_text())
        if known["made_from"] == made_from:
            scores: dict[str, float] = known["scores"]
            return scores
    results = score_file(files["fps_ort"], data, threads=threads)
    scores = {column: results.scores[score] for column, score in SCORES.items()}
    scores["vertices"] = mean_vertices(results)
    if "fps_ort_int8" in files:
        scores["ap_int8"] = score_file(files["fps_ort_int8"], data, threads=threads).scores[
            "segm_AP"
        ]
    write_json(kept, {"made_from": made_from, "scores": scores})
    return scores


def mean_vertices(results: Results) -> float:
    """Vertices of a likely detection's outline behind BAS-DP at an IoU of .95; nan without a
    detection.
    """
    masks = [
        rle.decode(row["segmentation"]).astype(np.bool_)
        for row in results.rows
        if row["score"] >= LIKELY
    ]
    counts = [
        count_vertices(simplify(trace(mask), _IOU_FLOOR, "bas_dp")) for mask in masks if mask.any()
    ]
    return float(np.mean(counts)) if counts else float("nan")
