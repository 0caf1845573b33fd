"""`cohdc validate`: the scores of a checkpoint or an ONNX file on COCO-format data."""

from collections.abc import Sequence
from pathlib import Path

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


def validate(
    model: Path,
    root: Path,
    out: Path | None = None,
    rescore: bool | None = None,
    min_quality: float = 0.0,
    batch_size: int = 2,
    workers: int = 1,
    precision: str = "32-true",
    canvas: tuple[int, int] | None = None,
    pictures: Path | None = None,
    threads: int = 0,
) -> dict[str, float]:
    """Print a model's scores on the validation split of a COCO-format folder.

    Args:
        model: best.ckpt or last.ckpt of a training, an ONNX file, or a shipped network's name:
            person, person_s.
        root: the COCO-format folder; its other classes are left out. Of an ONNX file, those that
            both have are scored.
        out: JSON file for the scores.
        rescore: rank masks by score * quality; the training's choice when not given, yes for an
            ONNX file.
        min_quality: leave out detections of a lower quality, as the paper does below 0.9.
        batch_size: images per batch; an ONNX file takes one at a time.
        workers: processes that read images for a checkpoint.
        precision: Lightning's precision for a checkpoint, such as bf16-mixed.
        canvas: height and width in px to fit images into; the training's when not given. An ONNX
            file has its own.
        pictures: folder for best.jpg, worst.jpg, pr_curves.png, calibration.png and confusion.png.
        threads: onnxruntime's threads; 0 leaves it to onnxruntime.

    Raises:
        CohdcError: the model, the folder or their classes cannot be used.
    """
    keep_freed_memory()
    if pictures is not None:
        check_folder(pictures, "validate", VALIDATION_FILES, "--pictures")
    model = model_path(model)
    if model.suffix == ".onnx":
        if canvas is not None:
            raise CohdcError(f"{model}: its canvas was fixed by cohdc export --canvas")
        segmenter = Segmenter(model, threads)
        split = _common_split(root, model, segmenter.class_names)
        results = score_segmenter(segmenter, split, rescore is not False, min_quality)
    else:
        module = MaskRCNNModule.load(model, canvas)
        data = validation_data(root, model, module.class_names, batch_size, workers)
        results = score_module(module, data, rescore, min_quality, precision)
        split = data.folder.val
    for name, value in results.scores.items():
        print(f"{name:<24}{value:.4f}")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_json(out, results.scores)
    if pictures is not None:
        claim_folder(pictures, "validate", VALIDATION_FILES, "--pictures")
        write_files(pictures, draw_validation(results, split.images))
    return results.scores


def validation_data(
    root: Path, model: Path, class_names: list[str], batch_size: int = 2, workers: int = 0
) -> CocoDataModule:
    """A folder's data with the classes of a model. Raises CohdcError when they stand in another
    order there.
    """
    data = CocoDataModule(root, class_names, batch_size=batch_size, workers=workers)
    if data.class_names != class_names:
        raise CohdcError(
            f"{root}: class order {data.class_names} is not that of {model}: {class_names}"
        )
    return data


def _common_split(root: Path, model: Path, names: Sequence[str]) -> CocoSplit:
    """Read the validation split, with the classes that an ONNX file knows, too.

    Raises:
        CohdcError: there is no such class.
        DataError: an annotation or an image cannot be used.
    """
    whole = read_split("val", find_split(root, "val"))
    common = [name for name in whole.class_names if name in names]
    if not common:
        known = ", ".join(whole.class_names)
        raise CohdcError(f"{model}: none of its {len(names)} classes is one of {root}: {known}")
    split = whole.with_classes(common)
    check_images(split)
    return split


def score_module(
    module: MaskRCNNModule,
    data: CocoDataModule,
    rescore: bool | None = None,
    min_quality: float = 0.0,
    precision: str = "32-true",
) -> Results:
    """What a network finds on the validation split, and its scores. rescore: None is the training's
    choice.
    """
    module.rescore = module.rescore if rescore is None else rescore
    module.min_quality = min_quality
    with told_in_one_line():
        trainer = Trainer(
            logger=False,
            enable_checkpointing=False,
            precision=precision,
            enable_model_summary=False,
        )  # type: ignore[arg-type]
        trainer.validate(module, datamodule=data, verbose=False)
    if module.results is None:
        raise RuntimeError("validation left no results")
    return module.results


def score_file(
    model: Path, root: Path, rescore: bool = True, min_quality: float = 0.0, threads: int = 0
) -> Results:
    """What an ONNX file finds of the classes that it and a folder's validation split have in
    common, and its scores.

    Raises CohdcError when there is no such class, ContractError and DataError for file and folder.
    """
    segmenter = Segmenter(model, threads)
    split = _common_split(root, model, segmenter.class_names)
    return score_segmenter(segmenter, split, rescore, min_quality)


def score_segmenter(
    segmenter: Segmenter, split: CocoSplit, rescore: bool = True, min_quality: float = 0.0
) -> Results:
    """What an ONNX file finds of a split's classes, and its scores. Every class of the split is one
    of the file's.
    """
    metrics = SegmentationMetrics(split.ground_truth(), rescore, min_quality)
    labels = {
        segmenter.class_names.index(name): label for label, name in enumerate(split.class_names)
    }
    for image in split.images:
        found = segmenter(read_image(image))
        found = found.select(np.isin(found.labels, list(labels)))
        fields = {name: getattr(found, name) for name in ("boxes", "scores", "quality")}
        fields |= {
            "labels": np.array([labels[label] for label in found.labels], np.int64),
            "masks": found.roi_masks,
        }
        metrics.update(image.id, {name: torch.from_numpy(value) for name, value in fields.items()})
    return metrics.results()
