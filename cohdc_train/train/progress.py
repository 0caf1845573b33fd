"""Progress of a training: images per second, time left, learning rates, and a line now and then."""

import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from cohdc_train.train.messages import say
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.optimizer import ElapsedFraction

_WINDOW = 30  # steps over which speed and loss are averaged
_MAX_CLASSES = 5  # with their AP in the line
_FIGURE = "worst.jpg"  # validation figure that goes to TensorBoard
_LINE_INTERVAL_S = 60.0  # between lines on the steps, where there is no progress bar


class ProgressReporter(pl.Callback):
    """Logs learning rates, speed and time left, and prints a line after each validation.

    Args:
        figures: folder of validation figures, of which one is logged to TensorBoard; None without.
        prints_steps: print a line each minute, for a training without a progress bar.

    Attributes:
        losses: total loss of every step so far, over all sessions.
        images_seen: training images so far, over all processes and sessions.
        history: scores of every validation of this session.
    """

    def __init__(self, figures: Path | None = None, prints_steps: bool = False) -> None:
        """Start without steps."""
        self.losses: list[float] = []
        self.images_seen = 0
        self.history: list[dict[str, float]] = []
        self._figures = figures
        self._prints_steps = prints_steps
        self._counts: deque[tuple[float, int]] = deque(maxlen=_WINDOW)  # time s, images seen
        self._started = 0.0
        self._elapsed: ElapsedFraction | None = None
        self._elapsed_before = 0.0  # share of the budget that earlier sessions used
        self._validation_started = 0.0
        self._printed = 0.0  # time of the last line

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self._started = self._printed = time.monotonic()
        self._elapsed = pl_module.elapsed if isinstance(pl_module, MaskRCNNModule) else None
        if self._elapsed is not None:
            self._elapsed_before = self._elapsed(trainer.global_step)
        self._counts.append((self._started, self.images_seen))

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
        now = time.monotonic()
        self.images_seen += size * trainer.world_size
        self._counts.append((now, self.images_seen))
        self.losses.append(float(outputs["loss"]))

        pl_module.log("speed/images_per_s", self.images_per_s(), prog_bar=True, batch_size=size)
        for name, rate in learning_rates(trainer).items():
            pl_module.log(name, rate, prog_bar=name == "lr/heads", batch_size=size)
        remaining = self.minutes_left(trainer)
        if remaining is not None:
            pl_module.log("speed/minutes_left", remaining, prog_bar=True, batch_size=size)
        if self._prints_steps and now - self._printed >= _LINE_INTERVAL_S:
            self._say(self.line(trainer))

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the start, for a validation does not count in the speed."""
        self._validation_started = time.monotonic()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Print where the training is, with the scores."""
        pause = time.monotonic() - self._validation_started
        self._counts = deque(((at + pause, seen) for at, seen in self._counts), maxlen=_WINDOW)
        if trainer.sanity_checking or not isinstance(pl_module, MaskRCNNModule):
            return
        if pl_module.results is not None:
            self.history.append(pl_module.results.scores)
            self._say(self.line(trainer, pl_module.results.scores))
            self._log_figure(trainer)

    def state_dict(self) -> dict[str, Any]:
        """Return the counts with which a resumed training continues."""
        return {"losses": self.losses, "images_seen": self.images_seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the counts of an earlier session."""
        self.losses = list(state_dict["losses"])
        self.images_seen = int(state_dict["images_seen"])

    def images_per_s(self) -> float:
        """Return training images per second over the last steps; 0 before the first."""
        (first, before), (last, after) = self._counts[0], self._counts[-1]
        return (after - before) / (last - first) if last > first else 0.0

    def minutes_left(self, trainer: pl.Trainer) -> float | None:
        """Return the estimated rest of the training, min; None where it is unknown."""
        used = None if self._elapsed is None else self._elapsed(trainer.global_step)
        if used is None or used <= self._elapsed_before:
            return None
        elapsed_s = time.monotonic() - self._started
        return elapsed_s * (1 - min(1.0, used)) / (used - self._elapsed_before) / 60

    def line(self, trainer: pl.Trainer, scores: dict[str, float] | None = None) -> str:
        """Return one line on the training so far; scores: of a validation."""
        minutes = (time.monotonic() - self._started) / 60 if self._started else 0.0
        left = self.minutes_left(trainer)
        recent = self.losses[-_WINDOW:]
        parts = [f"step {trainer.global_step}"]
        if self._counts:
            parts.append(f"{self.images_seen} images, {self.images_per_s():.1f}/s")
        if recent:
            parts.append(f"loss {np.mean(recent):.3f}")
        parts.append(f"lr {learning_rates(trainer).get('lr/heads', 0.0):.1e}")
        if scores is not None:
            overall = f"mask AP {scores['segm_AP']:.3f}, AP50 {scores['segm_AP50']:.3f}"
            parts.append(overall + _per_class(scores))
        parts.append(f"{minutes:.1f} min" + ("" if left is None else f", {left:.1f} left"))
        return "; ".join(parts)

    def _say(self, line: str) -> None:
        self._printed = time.monotonic()
        say(line)

    @rank_zero_only
    def _log_figure(self, trainer: pl.Trainer) -> None:
        if self._figures is None or not (path := self._figures / "last" / _FIGURE).is_file():
            return
        image = cv2.imread(str(path))
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger) and image is not None:
                rgb = np.ascontiguousarray(image[:, :, ::-1])
                step = trainer.global_step
                logger.experiment.add_image("val/worst", rgb, step, dataformats="HWC")


def _per_class(scores: dict[str, float]) -> str:
    """Return mask AP of the first few classes in brackets; nothing for a single class."""
    prefix = "segm_AP/"
    classes = [
        (name.removeprefix(prefix), ap) for name, ap in scores.items() if name.startswith(prefix)
    ]
    shown = ", ".join(f"{name} {ap:.3f}" for name, ap in classes[:_MAX_CLASSES])
    rest = ", ..." if len(classes) > _MAX_CLASSES else ""
    return f" ({shown}{rest})" if classes else ""


def learning_rates(trainer: pl.Trainer) -> dict[str, float]:
    """Return the present rates: lr/heads, and lr/backbone where the backbone is trained."""
    rates: dict[str, float] = {}
    for optimizer in trainer.optimizers:
        for group in optimizer.param_groups:
            is_backbone = str(group.get("name", "")).startswith("backbone")
            rates.setdefault("lr/backbone" if is_backbone else "lr/heads", float(group["lr"]))
    return rates
