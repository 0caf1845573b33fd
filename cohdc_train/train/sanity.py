"""Checks of minutes before a training of hours: a learning-rate range test, and a few images learned by heart."""

from collections.abc import Mapping
from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.tuner.tuning import Tuner

from cohdc_train.files import write_bytes
from cohdc_train.train.validation_plots import plot_lr_find

_STEPS = 100
_RANGE = (1e-6, 3e-2)  # beyond it AdamW diverges
LEARNED_AP50 = 0.5


def find_learning_rate(
    trainer: pl.Trainer, module: pl.LightningModule, data: pl.LightningDataModule, out: Path
) -> None:
    """Train with a rate that grows from step to step, print the one at which the loss falls fastest, and plot it.

    Writes out/lr_find.png. The weights are restored afterwards.
    """
    lowest, highest = _RANGE
    finder = Tuner(trainer).lr_find(
        module, datamodule=data, min_lr=lowest, max_lr=highest, num_training=_STEPS, update_attr=False
    )
    suggestion = None if finder is None else finder.suggestion()
    if finder is None or suggestion is None:
        print("lr find: no suggestion; the loss never fell. Check the labels with cohdc data doctor and --overfit 8")
        return
    out.mkdir(parents=True, exist_ok=True)
    plot = out / "lr_find.png"
    write_bytes(plot, plot_lr_find(finder.results["lr"], finder.results["loss"], suggestion))
    print(
        f"lr find: the loss falls fastest at {suggestion:.1e} ({plot}); "
        f"train with --model.optimizer.lr {suggestion:.1e}"
    )


def overfit_verdict(scores: Mapping[str, float], num_images: int) -> str:
    """Return one line: whether the network learned its few images by heart.

    scores: of the validation on the training images.
    """
    ap50 = scores["segm_AP50"]
    if ap50 >= LEARNED_AP50:
        return f"overfit: AP50 {ap50:.2f} on its own {num_images} images: labels and network agree"
    return (
        f"overfit: AP50 {ap50:.2f} on its own {num_images} images, {LEARNED_AP50} is normal: look at the labels "
        "(cohdc data doctor), at pictures/worst.jpg, or train longer (--trainer.max_steps)"
    )
