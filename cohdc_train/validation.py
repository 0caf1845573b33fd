"""`cohdc validate`: scores of a checkpoint or an ONNX file on COCO-format data."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Trainer

from cohdc_train.data.annotations import read_image
from cohdc_train.data.coco import CocoSplit, read_split
from cohdc_train.data.datamodule import CocoDataModule, check_images
from cohdc_train.data.layout import find_split
from cohdc_train.errors import CohdcError
from cohdc_train.files import check_folder, claim_folder, write_json
from cohdc_train.metrics.coco_metrics import Results, SegmentationMetrics
from cohdc_train.presets import model_path
from cohdc_train.segmenter import Segmenter
from cohdc_train.train.cli import told_in_one_line
from cohdc_train.train.malloc import keep_freed_memory
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.validation_figures import VALIDATION_FILES, draw_validation, write_files

RENAMED_OPTIONS = {"--pictures": "--figures"}


@dataclass(frozen=True)
class ValidationOptions:
    """Options of `cohdc validate`.

    Attributes:
        rescore: rank masks by score * quality; the training's choice when not given, yes for an
            ONNX file.
        min_quality: skip detections of a lower quality, as the paper does below 0.9.
        batch_size: images per batch; an ONNX file takes one at a time.
        workers: number of processes that read images for a checkpoint.
        precision: Lightning's precision for a checkpoint, such as bf16-mixed.
        canvas: height and width in px to fit images into; the training's when not given. An ONNX
            file has its own.
        threads: number of threads of onnxruntime; 0 lets onnxruntime choose.
    """

    rescore: bool | None = None
    min_quality: float = 0.0
    batch_size: int = 2
    workers: int = 1
    precision: str = "32-true"
    canvas: tuple[int, int] | None = None
    threads: int = 0


def validate(
    model: Path | str,
    data: Path | str,
    *,
    out: Path | str | None = None,
    figures: Path | str | None = None,
    **options: Any,
) -> dict[str, float]:
    """Score a model on the validation split of a COCO-format folder, and print the scores.

    Args:
        model: best.ckpt or last.ckpt of a training, an ONNX file, or a shipped network's name:
            person, person_s.
        data: COCO-format folder; its other classes are skipped. Of an ONNX file, the classes that
            both have are scored.
        out: JSON file for the scores.
        figures: folder for best.jpg, worst.jpg, pr_curves.png, calibration.png and confusion.png.
        **options: fields of `ValidationOptions`.

    Returns:
        Score name -> value.

    Raises:
        CohdcError: the model, the folder or their classes cannot be used.
    """
    settings = ValidationOptions(**options)
    keep_freed_memory()
    out = None if out is None else Path(out)
    figures = None if figures is None else Path(figures)
    if figures is not None:
        check_folder(figures, "validate", VALIDATION_FILES, "--figures")
    results, split = _score(model_path(model), Path(data), settings)
    for name, value in results.scores.items():
        print(f"{name:<24}{value:.4f}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, results.scores)
    if figures is not None:
        claim_folder(figures, "validate", VALIDATION_FILES, "--figures")
        write_files(figures, draw_validation(results, split.images))
    return results.scores


def _score(model: Path, root: Path, options: ValidationOptions) -> tuple[Results, CocoSplit]:
    """Score a checkpoint or an ONNX file. Returns the results and the split they are of."""
    if model.suffix == ".onnx":
        if options.canvas is not None:
            raise CohdcError(f"{model}: its canvas was fixed by cohdc export --canvas")
        segmenter = Segmenter(model, options.threads)
        split = common_split(root, model, segmenter.class_names)
        rescore = options.rescore is not False
        return score_segmenter(segmenter, split, rescore, options.min_quality), split

    module = MaskRCNNModule.load(model, options.canvas)
    names = module.class_names
    data = validation_data(root, model, names, options.batch_size, options.workers)
    results = score_module(module, data, options)
    return results, data.folder.val


def validation_data(
    root: Path, model: Path, class_names: list[str], batch_size: int = 2, workers: int = 0
) -> CocoDataModule:
    """Open a folder with the classes of a model.

    Args:
        root: COCO-format folder.
        model: for messages.
        class_names: classes of the model, in its order.
        batch_size: images per batch.
        workers: number of processes that read images.

    Raises:
        CohdcError: the classes have another order in the folder.
    """
    data = CocoDataModule(root, class_names, batch_size=batch_size, workers=workers)
    if data.class_names != class_names:
        raise CohdcError(
            f"{root}: class order {data.class_names} is not that of {model}: {class_names}"
        )
    return data


def common_split(root: Path, model: Path, class_names: Sequence[str]) -> CocoSplit:
    """Read a folder's validation split, with the classes that an ONNX file has too.

    Args:
        root: COCO-format folder.
        model: for messages.
        class_names: classes of the ONNX file.

    Raises:
        CohdcError: there is no such class.
        DataError: an annotation or an image cannot be used.
    """
    whole = read_split("val", find_split(root, "val"))
    common = [name for name in whole.class_names if name in class_names]
    if not common:
        known = ", ".join(whole.class_names)
        count = len(class_names)
        raise CohdcError(f"{model}: none of its {count} classes is one of {root}: {known}")
    split = whole.with_classes(common)
    check_images(split)
    return split


def score_module(
    module: MaskRCNNModule,
    data: CocoDataModule,
    options: ValidationOptions = ValidationOptions(),
) -> Results:
    """Run a network on the validation split, and score its detections.

    Args:
        module: the network; rescore None in the options keeps its own choice.
        data: the folder.
        options: rescore, min_quality and precision are used.
    """
    if options.rescore is not None:
        module.rescore = options.rescore
    module.min_quality = options.min_quality
    precision: Any = options.precision
    with told_in_one_line():
        trainer = Trainer(
            logger=False,
            enable_checkpointing=False,
            precision=precision,
            enable_model_summary=False,
        )
        trainer.validate(module, datamodule=data, verbose=False)
    if module.results is None:
        raise RuntimeError("validation left no results")
    return module.results


def score_file(
    model: Path, root: Path, rescore: bool = True, min_quality: float = 0.0, threads: int = 0
) -> Results:
    """Run an ONNX file on a folder's validation split, and score the classes that both have.

    Args:
        model: the ONNX file.
        root: COCO-format folder.
        rescore: rank masks by score * quality.
        min_quality: skip detections of a lower quality.
        threads: number of threads of onnxruntime.

    Raises:
        CohdcError: there is no such class, or file or folder cannot be used.
    """
    segmenter = Segmenter(model, threads)
    split = common_split(root, model, segmenter.class_names)
    return score_segmenter(segmenter, split, rescore, min_quality)


def score_segmenter(
    segmenter: Segmenter, split: CocoSplit, rescore: bool = True, min_quality: float = 0.0
) -> Results:
    """Run a segmenter on a split, and score the split's classes.

    Args:
        segmenter: it has all classes of the split.
        split: validation split.
        rescore: rank masks by score * quality.
        min_quality: skip detections of a lower quality.
    """
    metrics = SegmentationMetrics(split.ground_truth(), rescore, min_quality)
    names = segmenter.class_names
    labels = {names.index(name): label for label, name in enumerate(split.class_names)}
    for image in split.images:
        detections = segmenter(read_image(image))
        detections = detections.select(np.isin(detections.labels, list(labels)))
        fields = {
            "boxes": detections.boxes,
            "scores": detections.scores,
            "quality": detections.quality,
            "labels": np.array([labels[label] for label in detections.labels], np.int64),
            "masks": detections.roi_masks,
        }
        metrics.update(image.id, {name: torch.from_numpy(value) for name, value in fields.items()})
    return metrics.results()
