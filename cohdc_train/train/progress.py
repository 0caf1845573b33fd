"""How a training goes: images per second, time left, learning rates, and one line after each
validation.
"""

import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.optimizer import Progress

_WINDOW = 30  # steps over which the speed is averaged
_CLASSES = 5  # whose AP stands in the line
_SHOWN = "worst.jpg"  # validation image that goes to TensorBoard


class ProgressReporter(pl.Callback):
    """Logs learning rates, images per second and time left, and prints a line after each
    validation.

    Attributes:
        losses: total loss of every step so far.
        images_seen: training images so far, over all processes.
        history: scores of every validation.
    """

    def __init__(self, figures: Path | None = None) -> None:
        """figures: folder of validation figures, of which one is logged to TensorBoard."""
        self.losses: list[float] = []
        self.images_seen = 0
        self.history: list[dict[str, float]] = []
        self._figures = figures
        self._stamps: deque[tuple[float, int]] = deque(maxlen=_WINDOW)
        self._started = 0.0
        self._progress: Progress | None = None
        self._progress_before = 0.0  # share of the budget that earlier sessions used
        self._paused = 0.0  # start of a validation, s

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self._started = time.monotonic()
        self._progress = pl_module.progress if isinstance(pl_module, MaskRCNNModule) else None
        self._progress_before = (
            0.0 if self._progress is None else self._progress(trainer.global_step)
        )
        self._stamps.append((self._started, self.images_seen))

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Log speed, time left and learning rates."""
        size = len(batch.targets)
        self.images_seen += size * trainer.world_size
        self._stamps.append((time.monotonic(), self.images_seen))
        self.losses.append(float(outputs["loss"]))

        pl_module.log("speed/images_per_s", self.images_per_s(), prog_bar=True, batch_size=size)
        for name, rate in learning_rates(trainer).items():
            pl_module.log(name, rate, prog_bar=name == "lr/heads", batch_size=size)
        remaining = self.minutes_left(trainer)
        if remaining is not None:
            pl_module.log("speed/minutes_left", remaining, prog_bar=True, batch_size=size)

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop the clock of the speed: a validation is no training."""
        self._paused = time.monotonic()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print where the training is."""
        lost = time.monotonic() - self._paused
        self._stamps = deque(((stamp + lost, seen) for stamp, seen in self._stamps), maxlen=_WINDOW)
        if (
            trainer.sanity_checking
            or not isinstance(pl_module, MaskRCNNModule)
            or pl_module.results is None
        ):
            return
        self.history.append(pl_module.results.scores)
        self._print(self.line(trainer, pl_module.results.scores))
        self._log_figure(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed training goes on counting from."""
        return {"losses": self.losses, "images_seen": self.images_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the counts of an earlier session."""
        self.losses = list(state_dict["losses"])
        self.images_seen = int(state_dict["images_seen"])

    def images_per_s(self) -> float:
        """Return training images per second over the last steps; 0 before the first."""
        (first, before), (last, after) = self._stamps[0], self._stamps[-1]
        return (after - before) / (last - first) if last > first else 0.0

    def minutes_left(self, trainer: pl.Trainer) -> float | None:
        """Return the estimated rest of the training, min; None where it is unknown."""
        used = None if self._progress is None else self._progress(trainer.global_step)
        if used is None or used <= self._progress_before:
            return None
        elapsed = time.monotonic() - self._started
        return elapsed * (1 - min(1.0, used)) / (used - self._progress_before) / 60

    def line(self, trainer: pl.Trainer, scores: dict[str, float]) -> str:
        """Return one line on the training so far."""
        minutes = (time.monotonic() - self._started) / 60 if self._started else 0.0
        left = self.minutes_left(trainer)
        recent = self.losses[-_WINDOW:]
        parts = [
            f"step {trainer.global_step}",
            f"{self.images_seen} images, {self.images_per_s():.1f}/s" if self._stamps else "",
            f"loss {np.mean(recent):.3f}" if recent else "",
            f"lr {learning_rates(trainer).get('lr/heads', 0.0):.1e}",
            f"mask AP {scores['segm_AP']:.3f}, AP50 {scores['segm_AP50']:.3f}{_per_class(scores)}",
            f"{minutes:.1f} min" + ("" if left is None else f", {left:.1f} left"),
        ]
        return "; ".join(part for part in parts if part)

    @rank_zero_only
    def _print(self, line: str) -> None:
        print(line, flush=True)

    @rank_zero_only
    def _log_figure(self, trainer: pl.Trainer) -> None:
        if self._figures is None or not (path := self._figures / "last" / _SHOWN).is_file():
            return
        image = cv2.imread(str(path))
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger) and image is not None:
                rgb = np.ascontiguousarray(image[:, :, ::-1])
                logger.experiment.add_image(
                    "val/worst", rgb, trainer.global_step, dataformats="HWC"
                )


def _per_class(scores: dict[str, float]) -> str:
    """Return mask AP of the first few classes in brackets; nothing for a single class."""
    prefix = "segm_AP/"
    classes = [
        (name.removeprefix(prefix), ap) for name, ap in scores.items() if name.startswith(prefix)
    ]
    shown = ", ".join(f"{name} {ap:.3f}" for name, ap in classes[:_CLASSES])
    rest = ", ..." if len(classes) > _CLASSES else ""
    return f" ({shown}{rest})" if classes else ""


def learning_rates(trainer: pl.Trainer) -> dict[str, float]:
    """Return the present learning rates: lr/heads of the heads, lr/backbone where the backbone is
    trained.
    """
    rates: dict[str, float] = {}
    for optimizer in trainer.optimizers:
        for group in optimizer.param_groups:
            is_backbone = str(group.get("name", "")).startswith("backbone")
            rates.setdefault("lr/backbone" if is_backbone else "lr/heads", float(group["lr"]))
    return rates
