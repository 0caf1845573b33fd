"""`cohdc fit`: Lightning's command line with this project's defaults."""

import time
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Callback, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from rich.console import Console

from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.train.arguments import (
    DEFAULT_NETWORK,
    DESCRIPTION,
    USAGE,
    add_fit_arguments,
    names_network,
    resolve_arguments,
)
from cohdc_train.train.budget import (
    default_epochs,
    is_bounded,
    training_limits,
    validation_interval,
)
from cohdc_train.train.checkpoints import ConfigSaver, LastCheckpoint, check_checkpoint_options
from cohdc_train.train.initial_weights import (
    InitialWeights,
    choose_initial_weights,
    resolve_backbone_lr,
    resolve_network,
)
from cohdc_train.train.malloc import keep_freed_memory
from cohdc_train.train.messages import say, user_errors
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.out_folder import check_out
from cohdc_train.train.progress import ProgressReporter
from cohdc_train.train.progress_bar import FitProgressBar
from cohdc_train.train.resume import keep_restored_options
from cohdc_train.train.session import TrainingSession, num_train_images
from cohdc_train.train.step_timer import StepTimer
from cohdc_train.train.trainer import FitTrainer, default_loggers
from cohdc_train.train.validation_figures import ValidationFigures
from cohdc_train.train.weight_average import weight_average

_OVERFIT_STEPS = 300
_TRAINER_DEFAULTS = {
    "gradient_clip_val": 5.0,
    "log_every_n_steps": 10,
    "check_val_every_n_epoch": None,
    "enable_model_summary": False,
}


def fit(args: list[str]) -> Trainer:
    """Train: `cohdc fit DATA [--config FILE.yaml] [--minutes N | --epochs N] [--out DIR]`.

    Writes below `--out`: `best.ckpt` (by val/segm_AP), `last.ckpt`, `config.yaml` (resolved),
    `logs/version_N/` (CSV, TensorBoard), `figures/` (of best.ckpt; `figures/last/` of the last
    validation; none with `--figures false`).

    Raises:
        CohdcError: in one line, for whatever the user can fix; a wrong key ends the program with
            code 2.
    """
    keep_freed_memory()
    with user_errors():
        command = FitCommand(
            MaskRCNNModule,
            CocoDataModule,
            args=resolve_arguments(args),
            run=False,
            trainer_class=FitTrainer,
            seed_everything_default=0,
            save_config_callback=ConfigSaver,
            save_config_kwargs={"overwrite": True, "save_to_log_dir": False},
            trainer_defaults=_TRAINER_DEFAULTS,
            parser_kwargs={"prog": "cohdc fit", "usage": USAGE, "description": DESCRIPTION},
            auto_configure_optimizers=False,
        )
        if not names_network(args):
            say(f"network: {DEFAULT_NETWORK}")
        command.run()
    return command.trainer


class FitCommand(LightningCLI):
    """Lightning's command line with this project's defaults; `run` trains.

    Attributes:
        initial: where the first weights come from.
        notes: lines on options that follow from the checkpoint that is resumed.
        reporter: callback that counts and prints how the training goes.
        timer: callback that measures the time to the first step and between epochs.
    """

    initial: InitialWeights
    notes: list[str]
    reporter: ProgressReporter
    timer: StepTimer

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Parse the command line and build data, network and trainer."""
        self.timer = StepTimer(time.monotonic())
        super().__init__(*args, **kwargs)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add this command's own options."""
        add_fit_arguments(parser)

    def before_instantiate_classes(self) -> None:
        """Choose the initial weights, and what of network and optimizer follows from them."""
        checkpoint: Path | None = self.config["ckpt_path"]
        if checkpoint is not None and not checkpoint.is_file():
            raise CohdcError(f"{checkpoint}: no such file")
        check_out(self.config)
        check_checkpoint_options(self.config["checkpoint"])
        network = self.config["model"]["network"]
        self.initial = choose_initial_weights(self.config["pretrained"], network, checkpoint)
        for name, value in resolve_network(self.initial, network).items():
            network[name] = value
        optimizer = self.config["model"]["optimizer"]
        optimizer["backbone_lr"] = resolve_backbone_lr(self.initial, optimizer["backbone_lr"])
        self.notes = keep_restored_options(self.initial.stored, optimizer)

    def instantiate_classes(self) -> None:
        """Build data, network and trainer; a value that one of them refuses is the user's error."""
        try:
            super().instantiate_classes()
        except (ValueError, TypeError, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error
        self.config["data"]["canvas"] = self.datamodule.canvas

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer; what the user left open of its arguments is decided here."""
        config = self.config["trainer"]
        kwargs |= self._limits(config)
        if config["check_val_every_n_epoch"] is None:
            interval = config["val_check_interval"]
            if interval is None:
                kwargs |= validation_interval(kwargs)
            elif isinstance(interval, float):
                kwargs["check_val_every_n_epoch"] = 1  # a share of an epoch
        if config["logger"] in (None, True):
            kwargs["logger"] = default_loggers(Path(self.config["out"]))
        kwargs["enable_progress_bar"] = self._shows_bar(config)
        kwargs["callbacks"] = self._callbacks(config)
        return super().instantiate_trainer(**kwargs)

    def _limits(self, config: Any) -> dict[str, Any]:
        """Return max_epochs, max_steps and max_time; images decide on epochs without a budget."""
        limits = training_limits(config, self.config["epochs"], self.config["minutes"])
        if self.config["overfit"] and not is_bounded(limits):
            return {**limits, "max_steps": _OVERFIT_STEPS, "max_epochs": -1}
        if limits["max_epochs"] is None:
            num_images = num_train_images(self.datamodule)
            limits["max_epochs"] = default_epochs(num_images)
            say(
                f"budget: {limits['max_epochs']} epochs of {num_images} images; "
                "--minutes or --epochs set it"
            )
        return limits

    def _callbacks(self, config: Any) -> list[Callback]:
        """Return the callbacks of this command, then the user's own."""
        out = Path(self.config["out"])
        figures = out / "figures"
        draws_figures = self.config["figures"] and not config["fast_dev_run"]
        own = self.config_init["trainer"]["callbacks"] or []
        own = own if isinstance(own, list) else [own]
        shows_bar = self._shows_bar(config)
        self.reporter = ProgressReporter(
            figures if draws_figures else None, prints_steps=not shows_bar
        )

        callbacks: list[Callback] = [LastCheckpoint(out)]
        if shows_bar and not any(isinstance(callback, ProgressBar) for callback in own):
            callbacks.append(FitProgressBar())
        if self.config["ema"]:
            callbacks.append(weight_average(self.config["ema"]))
        if draws_figures:
            callbacks.append(ValidationFigures(figures))
        return [*callbacks, self.reporter, self.timer, *own]

    def _shows_bar(self, config: Any) -> bool:
        """Return whether a progress bar is shown: as the user says, else on a terminal."""
        wanted = config["enable_progress_bar"]
        return Console().is_terminal if wanted is None else bool(wanted)

    def run(self) -> None:
        """Train, from the initial weights or where `--ckpt_path` ended, and say how it went."""
        session = TrainingSession(
            self.trainer,
            self.model,
            self.datamodule,
            self.config,
            self.initial,
            self.notes,
            self.reporter,
            self.timer,
        )
        session.run()
