"""Checks of minutes before a training of hours: a learning-rate range test, and overfitting."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.tuner.tuning import Tuner

from cohdc_train.files import write_bytes
from cohdc_train.train.messages import say
from cohdc_train.train.training_plots import plot_lr_find

LEARNED_AP50 = 0.5
_STEPS = 100
_RANGE = (1e-6, 3e-2)  # beyond it AdamW diverges
_BEGINNING = 10  # steps
_CLEAR_FALL = 0.9  # of the loss at the beginning


def find_learning_rate(
    trainer: pl.Trainer, module: pl.LightningModule, data: pl.LightningDataModule, out: Path
) -> None:
    """Train with a rate that grows from step to step, print a suggestion, and plot it.

    Writes out/lr_find.png. The weights are restored afterwards.
    """
    lowest, highest = _RANGE
    finder = Tuner(trainer).lr_find(
        module,
        datamodule=data,
        min_lr=lowest,
        max_lr=highest,
        num_training=_STEPS,
        update_attr=False,
    )
    rates, losses = ([], []) if finder is None else (finder.results["lr"], finder.results["loss"])
    suggestion = suggest_rate(rates, losses)
    if suggestion is None:
        say(
            "lr find: the loss hardly falls at any rate; keep the default, or check the labels "
            "with --overfit 8"
        )
        return
    out.mkdir(parents=True, exist_ok=True)
    plot = out / "lr_find.png"
    write_bytes(plot, plot_lr_find(rates, losses, suggestion))
    say(
        f"lr find: --model.optimizer.lr {suggestion:.1e}, a tenth of the rate of the lowest loss "
        f"({plot})"
    )


def suggest_rate(rates: Sequence[float], losses: Sequence[float]) -> float | None:
    """Return a tenth of the rate at which the loss was lowest; None where it hardly fell.

    rates, losses: of a range test whose rate grows from step to step.
    """
    if len(losses) < 2 * _BEGINNING:
        return None
    beginning = float(np.mean(losses[:_BEGINNING]))
    lowest = int(np.argmin(losses))
    return rates[lowest] / 10 if losses[lowest] < _CLEAR_FALL * beginning else None


def overfit_verdict(scores: Mapping[str, float], num_images: int) -> str:
    """Return one line: whether the network has learned the images that it was trained on.

    scores: of the validation on the training images.
    """
    ap50 = scores["segm_AP50"]
    trained = f"overfit: AP50 {ap50:.2f} on its own {num_images} images"
    if ap50 >= LEARNED_AP50:
        return f"{trained}: labels and network agree"
    return (
        f"{trained}, {LEARNED_AP50} is normal: look at the labels (cohdc data doctor), at "
        "figures/worst.jpg, or train longer (--trainer.max_steps)"
    )
