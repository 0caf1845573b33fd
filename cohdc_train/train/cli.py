"""`cohdc fit`: Lightning's command line with this project's defaults."""

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_info

from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.presets import config_path, model_path
from cohdc_train.train.batch_size import largest_batch
from cohdc_train.train.budget import (
    FitTrainer,
    default_epochs,
    is_bounded,
    training_limits,
    validation_interval,
)
from cohdc_train.train.ema import ema
from cohdc_train.train.initial_weights import (
    InitialWeights,
    choose_initial_weights,
    resolve_backbone_lr,
    resolve_network,
)
from cohdc_train.train.malloc import keep_freed_memory
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.out_folder import check_out, claim_out
from cohdc_train.train.progress import ProgressReporter
from cohdc_train.train.sanity import find_learning_rate, overfit_verdict
from cohdc_train.train.summary import summary_lines, training_facts
from cohdc_train.train.validation_figures import ValidationPictures

_USAGE = "cohdc fit DATA [--config FILE.yaml] [--minutes N | --epochs N] [--out DIR] [--OPTION VALUE ...]"
_DESCRIPTION = (
    "Train an HDC Mask R-CNN with CQE on COCO-format data. Without --config the network is networks/hdc_net_n.yaml, "
    "which starts from the shipped weights."
)
_DEFAULT_NETWORK = "networks/hdc_net_n.yaml"
_NETWORK_NAMES = ("backbone", "depth")  # fields that say which network is meant
_BEST = "val/segm_AP"
_OVERFIT_STEPS = 300
# Lightning's advice that does not apply here, and what its own code is told off for by newer
# packages.
_ADVICE = (
    ".*does not have many workers.*",
    ".*is smaller than the logging interval.*",
    ".*Checkpoint directory.*",
    ".*args parameter is intended to run from within Python.*",
    r".*isinstance\(treespec, LeafSpec\).*",
    r"(?s).*(JSONARGPARSE_DEPRECATION_WARNINGS|was\s+deprecated\s+in\s+v4).*",
)


def fit(args: list[str]) -> Trainer:
    """Train: `cohdc fit DATA [--config FILE.yaml] [--minutes N | --epochs N] [--out DIR]`.

    Writes below `--out`: `best.ckpt` (by val/segm_AP), `last.ckpt`, `config.yaml` (resolved),
    `logs/version_N/` (CSV, TensorBoard), `pictures/` (of best.ckpt; `pictures/last/` of the last
    validation; none with `--pictures false`).

    Raises:
        CohdcError: in one line, for whatever the user can fix; a wrong key ends the program with
            code 2.
    """
    keep_freed_memory()
    with told_in_one_line():
        command = FitCommand(
            MaskRCNNModule,
            CocoDataModule,
            args=_resolve_arguments(args),
            run=False,
            trainer_class=FitTrainer,
            seed_everything_default=0,
            save_config_callback=_SaveConfig,
            save_config_kwargs={"overwrite": True, "save_to_log_dir": False},
            trainer_defaults={
                "gradient_clip_val": 5.0,
                "log_every_n_steps": 10,
                "check_val_every_n_epoch": None,
            },
            parser_kwargs={"prog": "cohdc fit", "usage": _USAGE, "description": _DESCRIPTION},
            auto_configure_optimizers=False,
        )
        command.run()
    return command.trainer


class FitCommand(LightningCLI):
    """Lightning's command line with this project's defaults; `run` trains."""

    initial: InitialWeights
    reporter: ProgressReporter

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add this command's own options, the checkpoints, and what the network takes over from the
        data.
        """
        parser.add_argument(
            "--out",
            type=Path,
            default=Path("runs/fit"),
            help="folder for everything that is written",
        )
        parser.add_argument(
            "--ckpt_path", type=Path | None, default=None, help="checkpoint of a training to resume"
        )
        parser.add_argument(
            "--pretrained",
            type=str,
            default="auto",
            help="weights to start from: auto (the shipped network where its layers fit, else published ImageNet "
            "weights), none, imagenet, a shipped network (person, person_s), or a file: checkpoint, exported ONNX, "
            "state dict of the backbone",
        )
        parser.add_argument(
            "--epochs", type=int | None, default=None, help="length of the training in epochs"
        )
        parser.add_argument(
            "--minutes", type=float | None, default=None, help="length of the training in minutes"
        )
        parser.add_argument(
            "--ema",
            type=float,
            default=0.0,
            help="decay of the weights' moving average, such as .999; 0: none",
        )
        parser.add_argument(
            "--pictures", type=bool, default=True, help="draw every validation, in OUT/pictures"
        )
        parser.add_argument(
            "--lr_find",
            type=bool,
            default=False,
            help="try learning rates for 100 steps, suggest one, and stop",
        )
        parser.add_argument(
            "--overfit",
            type=int,
            default=0,
            help="train and validate on N images alone, to check the labels; 0: no",
        )
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults(
            {
                "checkpoint.monitor": _BEST,
                "checkpoint.mode": "max",
                "checkpoint.filename": "best",
                "checkpoint.enable_version_counter": False,
            }
        )
        parser.link_arguments("out", "checkpoint.dirpath")
        parser.link_arguments("out", "trainer.default_root_dir")
        parser.link_arguments("overfit", "data.overfit")
        parser.link_arguments("data.canvas", "model.network.canvas", apply_on="instantiate")
        parser.link_arguments("data.class_names", "model.class_names", apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        """Choose the initial weights, and what of the network follows from them."""
        checkpoint: Path | None = self.config["ckpt_path"]
        if checkpoint is not None and not checkpoint.is_file():
            raise CohdcError(f"{checkpoint}: no such file")
        check_out(self.config)
        network = self.config["model"]["network"]
        self.initial = choose_initial_weights(self.config["pretrained"], network, checkpoint)
        for name, value in resolve_network(self.initial, network).items():
            network[name] = value
        optimizer = self.config["model"]["optimizer"]
        optimizer["backbone_lr"] = resolve_backbone_lr(self.initial, optimizer["backbone_lr"])

    def instantiate_classes(self) -> None:
        """Build data, network and trainer; a value that one of them refuses is the user's error."""
        try:
            super().instantiate_classes()
        except (ValueError, TypeError, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error
        self.config["data"]["canvas"] = self.datamodule.canvas

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Build the trainer with limits, validations, loggers and callbacks, unless told otherwise."""
        config = self.config["trainer"]
        kwargs |= self._limits(config)
        if config["check_val_every_n_epoch"] is None and config["val_check_interval"] is None:
            kwargs |= validation_interval(kwargs)
        elif config["check_val_every_n_epoch"] is None and isinstance(
            config["val_check_interval"], float
        ):
            kwargs["check_val_every_n_epoch"] = 1  # a share of an epoch
        if config["logger"] in (None, True):
            root = Path(self.config["out"])
            csv = CSVLogger(root, name="logs")
            kwargs["logger"] = [csv, TensorBoardLogger(root, name="logs", version=csv.version)]
        kwargs["callbacks"] = self._callbacks(config)
        return super().instantiate_trainer(**kwargs)

    def _limits(self, config: Any) -> dict[str, Any]:
        """Return max_epochs, max_steps and max_time; without a budget, epochs by the number of
        images.
        """
        limits = training_limits(config, self.config["epochs"], self.config["minutes"])
        if self.config["overfit"] and not is_bounded(limits):
            return {**limits, "max_steps": _OVERFIT_STEPS, "max_epochs": -1}
        if limits["max_epochs"] is None:
            num_images = _num_images(self.datamodule)
            limits["max_epochs"] = default_epochs(num_images)
            rank_zero_info(
                f"budget: {limits['max_epochs']} epochs of {num_images} images; --minutes or --epochs set it"
            )
        return limits

    def _callbacks(self, config: Any) -> list[Callback]:
        """Return the callbacks: progress bar, last.ckpt, moving average, figures, reports, and the
        user's own.
        """
        out = Path(self.config["out"])
        given = self.config_init["trainer"]["callbacks"] or []
        bar = [] if config["enable_progress_bar"] is False else [RichProgressBar(leave=True)]
        averaged = [ema(self.config["ema"])] if self.config["ema"] else []
        draws = self.config["pictures"] and not config["fast_dev_run"]
        figures = [ValidationPictures(out / "pictures")] if draws else []
        self.reporter = ProgressReporter(out / "pictures" if draws else None)
        own = given if isinstance(given, list) else [given]
        return [*bar, _keep_last(out), *averaged, *figures, self.reporter, *own]

    def run(self) -> None:
        """Train, from the initial weights or where `--ckpt_path` ended, and say how it went."""
        claim_out(self.config)
        rank_zero_info(self.initial.describe(_num_images(self.datamodule)))
        if self.initial.kind == "network":
            left = self.model.take_over(model_path(self.initial.source))
            if left:
                rank_zero_info(
                    f"not taken over, for other classes or another shape: {', '.join(left)}"
                )
        if self.datamodule.batch_size == "auto":
            self._choose_batch_size()
        body = self.model.network.backbone.body
        rank_zero_info(f"HDC rates {body.rates()}, receptive field {body.receptive_field()} px")
        rank_zero_info(f"canvas {self.datamodule.canvas[0]} x {self.datamodule.canvas[1]} px")
        if self.config["lr_find"]:
            find_learning_rate(self.trainer, self.model, self.datamodule, Path(self.config["out"]))
            return
        checkpoint = self.config["ckpt_path"]
        self.trainer.fit(self.model, datamodule=self.datamodule, ckpt_path=checkpoint)
        self._validate_last_step()
        self._summarize()

    def _validate_last_step(self) -> None:
        """Score the last weights where no validation has, so that best.ckpt exists however the
        training ended.
        """
        trainer, module = self.trainer, self.model
        if (
            self.config["trainer"]["fast_dev_run"]
            or trainer.limit_val_batches == 0
            or module.validated_step == trainer.global_step
        ):
            return
        trainer.validate(module, datamodule=self.datamodule, verbose=False)
        best = self._best_checkpoint()
        score = module.results.scores["segm_AP"]
        if best.best_model_score is None or score > best.best_model_score:
            trainer.save_checkpoint(Path(self.config["out"]) / "best.ckpt")

    def _summarize(self) -> None:
        """Print scores, hints, files and the next command."""
        if not self.trainer.is_global_zero or not self.reporter.history:
            return
        facts = training_facts(
            self.model, self.datamodule, self.reporter, self.initial.kind == "random"
        )
        if self.config["overfit"]:
            print(overfit_verdict(facts.scores, self.config["overfit"]))
            return
        best = self._best_checkpoint().best_model_score
        for line in summary_lines(
            facts, Path(self.config["out"]), None if best is None else float(best)
        ):
            print(line)

    def _best_checkpoint(self) -> ModelCheckpoint:
        """Return the callback that keeps best.ckpt."""
        return next(
            c
            for c in self.trainer.checkpoint_callbacks
            if isinstance(c, ModelCheckpoint) and c.monitor
        )

    def _choose_batch_size(self) -> None:
        if self.trainer.world_size > 1:
            raise CohdcError(
                "batch_size auto: works on one device; give the number it finds there to several"
            )
        self.datamodule.batch_size = largest_batch(
            self.model, self.datamodule, self.trainer.strategy.root_device
        )
        print(f"batch size: {self.datamodule.batch_size}")


def _num_images(data: CocoDataModule) -> int:
    return sum(len(split.images) for split in data.folder.train)


def _keep_last(folder: Path) -> ModelCheckpoint:
    """Write `last.ckpt` after every epoch, and when the training is interrupted.

    ModelCheckpoint's own `save_last` writes it only when the best one changes.
    """
    return LastCheckpoint(
        folder, "last", save_top_k=1, save_on_train_epoch_end=True, enable_version_counter=False
    )


class LastCheckpoint(ModelCheckpoint):
    """`last.ckpt`, also of a training that Ctrl-C or an error ended."""

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Save where the training is, and say how it goes on."""
        if trainer.global_step == 0 or self.dirpath is None or isinstance(exception, CohdcError):
            return
        path = Path(self.dirpath) / "last.ckpt"
        trainer.save_checkpoint(path)
        rank_zero_info(
            f"interrupted at step {trainer.global_step}; --ckpt_path {path} goes on from there"
        )


class _SaveConfig(SaveConfigCallback):
    """Keeps the resolved configuration beside the checkpoints instead of in a logger's folder."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        root = Path(trainer.default_root_dir)
        root.mkdir(parents=True, exist_ok=True)
        config = self.config.clone()
        config["ckpt_path"] = None  # the file repeats a training, and does not resume one
        self.parser.save(
            config, root / "config.yaml", skip_none=False, overwrite=True, multifile=False
        )


def _resolve_arguments(args: list[str]) -> list[str]:
    """Return the arguments with leading folders as `--data.root` and shipped configs as files.

    Where neither a config nor an option names a network, the default network comes first.
    """
    roots: list[str] = []
    while args and not args[0].startswith("-"):
        roots, args = [*roots, args[0]], args[1:]
    resolved: list[str] = []
    if not _names_network(args):
        rank_zero_info(f"network: {_DEFAULT_NETWORK}")
        resolved += ["--config", str(config_path(_DEFAULT_NETWORK))]
    if roots:
        resolved.append(f"--data.root={roots[0] if len(roots) == 1 else json.dumps(roots)}")
    for arg in args:
        name, separator, value = arg.partition("=")
        if resolved and resolved[-1] in ("--config", "-c"):
            arg = str(config_path(arg))
        elif name == "--config" and separator:
            arg = f"{name}={config_path(value)}"
        resolved.append(arg)
    return resolved


def _names_network(args: list[str]) -> bool:
    """Return whether an option, or a config behind `--config`, says which backbone the network has."""
    if any(
        arg.startswith(tuple(f"--model.network.{name}" for name in _NETWORK_NAMES)) for arg in args
    ):
        return True
    paths = [following for arg, following in pairwise(args) if arg in ("--config", "-c")]
    paths += [arg.partition("=")[2] for arg in args if arg.startswith("--config=")]
    for path in paths:
        content = yaml.safe_load(config_path(path).read_text(encoding="utf-8")) or {}
        network = (content.get("model") or {}).get("network") or {}
        if any(name in network for name in _NETWORK_NAMES):
            return True
    return False


@contextmanager
def told_in_one_line() -> Iterator[None]:
    """Turn what a user can cause (bad values, files, a reader's error in a worker process) into a
    CohdcError.
    """
    with warnings.catch_warnings():
        for message in _ADVICE:
            warnings.filterwarnings("ignore", message)
        try:
            yield
        except CohdcError as error:
            lines = str(error).strip().splitlines()
            last = lines[-1] if lines else "no message"
            # A worker process sends a traceback, whose last line is the error's name and message.
            raise CohdcError(
                (last.partition("Error: ")[2] or last) if len(lines) > 1 else last
            ) from error
        except (MisconfigurationException, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error
