"""The progress bar of `cohdc fit`: one line with loss, speed, learning rate and time left."""

from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.callbacks.progress.rich_progress import (
    BatchesProcessedColumn,
    CustomBarColumn,
)
from rich.progress import TextColumn

# Logged name -> name and format in the bar.
_SHOWN = {
    "train/loss": ("loss", ".3f"),
    "val/segm_AP50": ("AP50", ".3f"),
    "lr/heads": ("lr", ".1e"),
    "speed/images_per_s": ("images/s", ".1f"),
    "speed/minutes_left": ("min left", ".1f"),
}


class FitProgressBar(RichProgressBar):
    """Lightning's rich progress bar in one line, with epochs counted from 1."""

    def __init__(self) -> None:
        """Keep the bar of each epoch on the screen."""
        super().__init__(leave=True)

    def get_metrics(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, Any]:
        """Return the metrics that the bar shows, with short names."""
        logged = super().get_metrics(trainer, pl_module)
        return {
            name: f"{logged[key]:{form}}" for key, (name, form) in _SHOWN.items() if key in logged
        }

    def configure_columns(self, trainer: pl.Trainer) -> list[Any]:
        """Return epoch, bar and steps; the metrics tell speed and time."""
        return [
            TextColumn("[progress.description]{task.description}"),
            CustomBarColumn(
                complete_style=self.theme.progress_bar,
                finished_style=self.theme.progress_bar_finished,
                pulse_style=self.theme.progress_bar_pulse,
                bar_width=12,
            ),
            BatchesProcessedColumn(style=self.theme.batch_progress),
        ]

    def _get_train_description(self, current_epoch: int) -> str:
        """Return the epoch, and of how many where epochs end the training."""
        return epoch_text(current_epoch, self.trainer.max_epochs)


def epoch_text(epoch: int, max_epochs: int | None) -> str:
    """Return "epoch 3 of 12", or "epoch 3" where steps or minutes end the training.

    epoch: from 0; max_epochs: None or -1 without a limit.
    """
    if max_epochs is None or max_epochs < 0:
        return f"epoch {epoch + 1}"
    return f"epoch {epoch + 1} of {max_epochs}"
