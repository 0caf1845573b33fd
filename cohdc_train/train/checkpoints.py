"""Checkpoints of a training: best.ckpt and last.ckpt, and the configuration next to them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import SaveConfigCallback

from cohdc_train.errors import CohdcError
from cohdc_train.train.messages import say

BEST, LAST = "best.ckpt", "last.ckpt"
BEST_DEFAULTS = {
    "checkpoint.monitor": "val/segm_AP",
    "checkpoint.mode": "max",
    "checkpoint.filename": "best",
    "checkpoint.enable_version_counter": False,
}
_FIXED = {"filename": "best", "save_top_k": 1, "enable_version_counter": False}
_FIXED_OFF = ("save_last", "save_weights_only")


def check_checkpoint_options(config: Mapping[str, Any]) -> None:
    """Refuse options of `--checkpoint` under which best.ckpt or last.ckpt would be missing.

    Raises:
        CohdcError: one line names the option.
    """
    wrong = [name for name, value in _FIXED.items() if config[name] != value]
    wrong += [name for name in _FIXED_OFF if config[name]]
    if wrong:
        name = wrong[0]
        raise CohdcError(
            f"--checkpoint.{name} {config[name]}: cohdc fit keeps {BEST} and {LAST}, whole and "
            "under these names; --trainer.callbacks adds a ModelCheckpoint of your own"
        )


class LastCheckpoint(ModelCheckpoint):
    """Writes `last.ckpt` after each epoch, and when Ctrl-C or an error ends the training.

    ModelCheckpoint's own `save_last` writes it only when the best one changes.
    """

    def __init__(self, folder: Path) -> None:
        """Write to folder/last.ckpt."""
        super().__init__(
            folder, "last", save_top_k=1, save_on_train_epoch_end=True, enable_version_counter=False
        )

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Save where the training is, and say how it continues."""
        if self.dirpath is None or isinstance(exception, CohdcError):
            return
        if trainer.global_step == 0:
            say("interrupted before the first step; nothing was saved")
            return
        path = Path(self.dirpath) / LAST
        trainer.save_checkpoint(path)
        say(f"interrupted at step {trainer.global_step}; --ckpt_path {path} continues from there")


def best_checkpoint(trainer: Trainer) -> ModelCheckpoint:
    """Return the callback that keeps best.ckpt."""
    return next(
        callback
        for callback in trainer.checkpoint_callbacks
        if isinstance(callback, ModelCheckpoint) and callback.filename == _FIXED["filename"]
    )


class ConfigSaver(SaveConfigCallback):
    """Saves the resolved configuration next to the checkpoints instead of in a logger's folder."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write config.yaml, which repeats the training; it does not resume one."""
        root = Path(trainer.default_root_dir)
        root.mkdir(parents=True, exist_ok=True)
        config = self.config.clone()
        config["ckpt_path"] = None
        self.parser.save(
            config, root / "config.yaml", skip_none=False, overwrite=True, multifile=False
        )
