"""Figures of a validation: image grids, precision-recall, calibration, confusion, losses."""

import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.utilities import rank_zero_warn

from cohdc_train.data.annotations import CocoImage
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.files import write_bytes
from cohdc_train.metrics.average_precision import category_names
from cohdc_train.metrics.coco_metrics import Results
from cohdc_train.metrics.matching import best_and_worst, confusion_matrix, match_images
from cohdc_train.train.image_grid import draw_tiles
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.training_plots import plot_log
from cohdc_train.train.validation_plots import (
    class_names,
    plot_calibration,
    plot_confusion,
    plot_precision_recall,
)

VALIDATION_FILES = ("best.jpg", "worst.jpg", "pr_curves.png", "calibration.png", "confusion.png")
_NUM_IMAGES = 6  # in a grid
_SCORE = "score = sum of mask IoU of the objects found / (objects + false detections)"


def draw_validation(results: Results, images: Iterable[CocoImage]) -> dict[str, bytes]:
    """Draw the figures of a validation.

    Args:
        results: of the validation.
        images: of the validation split.

    Returns:
        Content by file name: best.jpg and worst.jpg with the images predicted best and worst, by
        `ImageMatch.score`; pr_curves.png, calibration.png, confusion.png.

    Raises:
        DataError: an image cannot be read; the message names it.
    """
    matches = match_images(results)
    by_id = {image.id: image for image in images}
    names = category_names(results.truth)
    best, worst = best_and_worst(matches, _NUM_IMAGES)
    files = {}
    for which, chosen in (("best", best), ("worst", worst)):
        title = f"{which} of {len(matches)} validation images; {_SCORE}"
        files[f"{which}.jpg"] = draw_tiles(title, chosen, by_id, names)
    counts = confusion_matrix(matches, len(names))
    return files | {
        "pr_curves.png": plot_precision_recall(results),
        "calibration.png": plot_calibration(results),
        "confusion.png": plot_confusion(counts, class_names(results.truth)),
    }


def write_figures(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, which is made where it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_bytes(folder / name, content)


class ValidationFigures(Callback):
    """Draws figures during a training.

    `folder` holds those of the validation that best.ckpt is from and the losses so far,
    `folder/last` those of the last validation. A figure that cannot be drawn is a warning with its
    traceback, never the end of a training.
    """

    def __init__(self, folder: Path) -> None:
        """Draw into a folder."""
        self.folder = folder

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw in the first process, but not in Lightning's trial before the training."""
        if trainer.is_global_zero and not trainer.sanity_checking:
            _attempt(lambda: self._draw(trainer, pl_module))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the losses up to the last step."""
        if trainer.is_global_zero:
            _attempt(lambda: self._draw_log(trainer))

    def _draw(self, trainer: Trainer, module: LightningModule) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(module, MaskRCNNModule) or not isinstance(data, CocoDataModule):
            raise TypeError("figures are drawn of a MaskRCNNModule on a CocoDataModule only")
        if module.results is None:
            raise ValueError("the validation has no results")
        files = draw_validation(module.results, data.folder.val.images)
        write_figures(self.folder / "last", files)
        if _is_best(trainer):
            write_figures(self.folder, files)
        self._draw_log(trainer)

    def _draw_log(self, trainer: Trainer) -> None:
        for logger in trainer.loggers:
            if isinstance(logger, CSVLogger):
                logger.save()  # it holds back up to a hundred rows
                log = Path(logger.log_dir) / "metrics.csv"
                if log.is_file():
                    write_figures(self.folder, {"losses.png": plot_log(log)})


def _is_best(trainer: Trainer) -> bool:
    """Return whether the checkpoint that watches a score will choose this validation.

    The checkpoint is written after the figures. Without one, every validation is the best.
    """
    for checkpoint in trainer.checkpoint_callbacks:
        if isinstance(checkpoint, ModelCheckpoint) and checkpoint.monitor is not None:
            best = checkpoint.best_model_score
            score = trainer.callback_metrics.get(checkpoint.monitor)
            if best is not None and score is not None:
                return bool(score > best if checkpoint.mode == "max" else score < best)
    return True


def _attempt(draw: Callable[[], None]) -> None:
    """Draw, and turn an error into a warning."""
    try:
        draw()
    except Exception:
        rank_zero_warn(
            "the figures of this validation could not be drawn; the training continues\n"
            f"{traceback.format_exc()}"
        )
