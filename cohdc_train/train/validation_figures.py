"""Pictures of a validation: image grids, precision-recall, calibration, confusion; and of a
training's log.
"""

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
from cohdc_train.metrics.coco_metrics import Results, category_names
from cohdc_train.metrics.matching import confusion_matrix, match_images, ranked
from cohdc_train.train.image_grid import draw_tiles
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.validation_plots import (
    class_names,
    plot_calibration,
    plot_confusion,
    plot_log,
    plot_precision_recall,
)

VALIDATION_FILES = ("best.jpg", "worst.jpg", "pr_curves.png", "calibration.png", "confusion.png")
_IMAGES = 6  # in a grid
_SCORE = "score = sum of mask IoU of the objects found / (objects + false detections)"


def draw_validation(results: Results, images: Iterable[CocoImage]) -> dict[str, bytes]:
    """File name -> content of a validation's pictures.

    best.jpg, worst.jpg: the images predicted best and worst, by `ImageMatch.score`; pr_curves.png,
    calibration.png, confusion.png. images: of the validation split. Raises DataError naming an
    image that cannot be read.
    """
    matches = match_images(results)
    by_id = {image.id: image for image in images}
    names = category_names(results.truth)
    best, worst = ranked(matches, _IMAGES)
    files = {
        f"{which}.jpg": draw_tiles(
            f"{which} of {len(matches)} validation images; {_SCORE}", chosen, by_id, names
        )
        for which, chosen in (("best", best), ("worst", worst))
    }
    counts = confusion_matrix(matches, len(names))
    return files | {
        "pr_curves.png": plot_precision_recall(results),
        "calibration.png": plot_calibration(results),
        "confusion.png": plot_confusion(counts, class_names(results.truth)),
    }


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, which is made when it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_bytes(folder / name, content)


class ValidationPictures(Callback):
    """Draws during a training: `folder` holds pictures of the validation that best.ckpt is from and
    the losses so far, `folder/last` those of the last validation.

    A picture that cannot be drawn is a warning with its traceback, never the end of a training.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw, in the first process, unless it was Lightning's trial before the training."""
        if trainer.is_global_zero and not trainer.sanity_checking:
            _attempt(lambda: self._draw(trainer, pl_module))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the losses up to the last step."""
        if trainer.is_global_zero:
            _attempt(lambda: self._draw_log(trainer))

    def _draw(self, trainer: Trainer, module: LightningModule) -> None:
        data = trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(module, MaskRCNNModule)
        assert isinstance(data, CocoDataModule)
        assert module.results is not None
        files = draw_validation(module.results, data.folder.val.images)
        write_files(self.folder / "last", files)
        if _is_best(trainer):
            write_files(self.folder, files)
        self._draw_log(trainer)

    def _draw_log(self, trainer: Trainer) -> None:
        for logger in trainer.loggers:
            if isinstance(logger, CSVLogger):
                logger.save()  # it holds back up to a hundred rows
                log = Path(logger.log_dir) / "metrics.csv"
                if log.is_file():
                    write_files(self.folder, {"losses.png": plot_log(log)})


def _is_best(trainer: Trainer) -> bool:
    """Whether the checkpoint that watches a score, and is written after this, will take this
    validation for the best; without one every validation is."""
    for checkpoint in trainer.checkpoint_callbacks:
        if isinstance(checkpoint, ModelCheckpoint) and checkpoint.monitor is not None:
            best = checkpoint.best_model_score
            score = trainer.callback_metrics.get(checkpoint.monitor)
            if best is not None and score is not None:
                return bool(score > best if checkpoint.mode == "max" else score < best)
    return True


def _attempt(draw: Callable[[], None]) -> None:
    try:
        draw()
    except Exception:
        rank_zero_warn(
            f"no pictures of this validation; the training goes on\n{traceback.format_exc()}"
        )
