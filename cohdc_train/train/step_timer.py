"""Time to the first step of a training, and between its epochs."""

import time
from typing import Any

import lightning.pytorch as pl


class StepTimer(pl.Callback):
    """Measures the time to the first step, and between epochs without their validation.

    Attributes:
        first_step_s: from the start of `cohdc fit` to the end of the first step, s; None before.
        epoch_gaps_s: from the last step of an epoch to the first of the next, s.
    """

    def __init__(self, started: float) -> None:
        """Start at a time of `time.monotonic`."""
        self.first_step_s: float | None = None
        self.epoch_gaps_s: list[float] = []
        self._started = started
        self._last_step = started  # end of the last step
        self._validation_started = started

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Measure the gap before the first step of an epoch."""
        if self.first_step_s is not None and batch_idx == 0:
            self.epoch_gaps_s.append(time.monotonic() - self._last_step)

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Note the end of a step."""
        self._last_step = time.monotonic()
        if self.first_step_s is None:
            self.first_step_s = self._last_step - self._started

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the start of a validation."""
        self._validation_started = time.monotonic()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Take the validation out of the gap."""
        self._last_step += time.monotonic() - self._validation_started

    def line(self) -> str:
        """Return one line on both times; empty without a step."""
        if self.first_step_s is None:
            return ""
        first = f"time: {self.first_step_s:.1f} s to the first step"
        if not self.epoch_gaps_s:
            return first
        mean = sum(self.epoch_gaps_s) / len(self.epoch_gaps_s)
        return f"{first}, {mean:.1f} s between epochs (without validation)"
