"""`cohdc fit`: Lightning's command line with this project's defaults."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_info

from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.presets import config_path, model_path
from cohdc_train.train.allocator import keep_freed_memory
from cohdc_train.train.batch_size import largest_batch
from cohdc_train.train.ema import ema
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.pictures import ValidationPictures

_USAGE = "cohdc fit --data.root DIR [--config FILE.yaml] [--out DIR] [--print_config] [--OPTION VALUE ...]"
_DESCRIPTION = "Train an HDC Mask R-CNN with CQE on COCO-format data."
_BEST = "val/segm_AP"
# Lightning's advice that does not apply here, and what its own code is told off for by newer packages.
_ADVICE = (
    ".*does not have many workers.*",
    ".*is smaller than the logging interval.*",
    ".*Checkpoint directory.*",
    ".*args parameter is intended to run from within Python.*",
    r".*isinstance\(treespec, LeafSpec\).*",
    r"(?s).*(JSONARGPARSE_DEPRECATION_WARNINGS|was\s+deprecated\s+in\s+v4).*",
)


def fit(args: list[str]) -> Trainer:
    """Train: `cohdc fit --data.root DIR [--config FILE.yaml] [--out DIR]`; writes below `--out`:

    `best.ckpt` (by val/segm_AP), `last.ckpt`, `config.yaml` (resolved), `logs/version_N/` (CSV, TensorBoard),
    `pictures/` (of best.ckpt; `pictures/last/` of the last validation; none with `--pictures false`).
    Raises CohdcError in one line for whatever the user can mend; a wrong key ends the program with code 2.
    """
    keep_freed_memory()
    with told_in_one_line():
        command = FitCommand(
            MaskRCNNModule,
            CocoDataModule,
            args=_resolve_configs(args),
            run=False,
            seed_everything_default=0,
            save_config_callback=_SaveConfig,
            save_config_kwargs={"overwrite": True, "save_to_log_dir": False},
            trainer_defaults={"max_epochs": 12, "gradient_clip_val": 5.0, "log_every_n_steps": 10},
            parser_kwargs={"prog": "cohdc fit", "usage": _USAGE, "description": _DESCRIPTION},
            auto_configure_optimizers=False,
        )
        command.run()
    return command.trainer


class FitCommand(LightningCLI):
    """Lightning's command line with this project's defaults; `run` trains."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """`--out`, `--ckpt_path`, `--pretrained`, the checkpoints, and what the network takes over from the data."""
        parser.add_argument("--out", type=Path, default=Path("runs/fit"), help="folder for everything that is written")
        parser.add_argument("--ckpt_path", type=Path | None, default=None, help="checkpoint of a training to resume")
        parser.add_argument(
            "--pretrained",
            type=Path | None,
            default=None,
            help="checkpoint, exported file or shipped network (person, person_s) to start from, of other classes too",
        )
        parser.add_argument(
            "--ema", type=float, default=0.0, help="decay of the weights' moving average, such as .999; 0: none"
        )
        parser.add_argument("--pictures", type=bool, default=True, help="draw every validation, in OUT/pictures")
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
        parser.link_arguments("data.canvas", "model.network.canvas")
        parser.link_arguments("data.class_names", "model.class_names", apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        """No ImageNet weights are fetched where all weights come from another training."""
        if self.config["pretrained"] is not None:
            self.config["model"]["network"]["weights"] = None

    def instantiate_classes(self) -> None:
        """Data, network and trainer; a value that one of them refuses is the user's error."""
        try:
            super().instantiate_classes()
        except (ValueError, TypeError, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """The trainer with CSV and TensorBoard logs, a progress bar and `last.ckpt`, unless told otherwise."""
        config = self.config["trainer"]
        if config["logger"] in (None, True):
            root = Path(self.config["out"])
            csv = CSVLogger(root, name="logs")
            kwargs["logger"] = [csv, TensorBoardLogger(root, name="logs", version=csv.version)]
        given = self.config_init["trainer"]["callbacks"] or []
        bar = [] if config["enable_progress_bar"] is False else [RichProgressBar(leave=True)]
        last = _keep_last(Path(self.config["out"]))
        averaged = [ema(self.config["ema"])] if self.config["ema"] else []
        wanted = self.config["pictures"] and not config["fast_dev_run"]
        pictures = [ValidationPictures(Path(self.config["out"]) / "pictures")] if wanted else []
        kwargs["callbacks"] = [*bar, last, *averaged, *pictures, *(given if isinstance(given, list) else [given])]
        return super().instantiate_trainer(**kwargs)

    def run(self) -> None:
        """Train, from the beginning, from the weights of `--pretrained`, or where `--ckpt_path` ended."""
        checkpoint: Path | None = self.config["ckpt_path"]
        if checkpoint is not None and not checkpoint.is_file():
            raise CohdcError(f"{checkpoint}: no such file")
        if self.config["pretrained"] is not None and checkpoint is None:
            left = self.model.take_over(model_path(self.config["pretrained"]))
            rank_zero_info(f"{self.config['pretrained']}: all weights but {', '.join(left) or 'none'}")
        if self.datamodule.batch_size == "auto":
            self._choose_batch_size()
        body = self.model.network.backbone.body
        rank_zero_info(f"HDC rates {body.rates()}, receptive field {body.receptive_field()} px")
        self.trainer.fit(self.model, datamodule=self.datamodule, ckpt_path=checkpoint)

    def _choose_batch_size(self) -> None:
        if self.trainer.world_size > 1:
            raise CohdcError("batch_size auto: works on one device; give the number it finds there to several")
        self.datamodule.batch_size = largest_batch(self.model, self.datamodule, self.trainer.strategy.root_device)
        print(f"batch size: {self.datamodule.batch_size}")


def _keep_last(folder: Path) -> ModelCheckpoint:
    """`last.ckpt` after every epoch. ModelCheckpoint's own `save_last` writes it only when the best one changes."""
    return ModelCheckpoint(folder, "last", save_top_k=1, save_on_train_epoch_end=True, enable_version_counter=False)


class _SaveConfig(SaveConfigCallback):
    """Keeps the resolved configuration beside the checkpoints instead of in a logger's folder."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        root = Path(trainer.default_root_dir)
        root.mkdir(parents=True, exist_ok=True)
        self.parser.save(self.config, root / "config.yaml", skip_none=False, overwrite=True, multifile=False)


def _resolve_configs(args: list[str]) -> list[str]:
    """Arguments with the files behind `--config` looked up among the shipped ones."""
    resolved: list[str] = []
    for arg in args:
        name, separator, value = arg.partition("=")
        if resolved and resolved[-1] in ("--config", "-c"):
            arg = str(config_path(arg))
        elif name == "--config" and separator:
            arg = f"{name}={config_path(value)}"
        resolved.append(arg)
    return resolved


@contextmanager
def told_in_one_line() -> Iterator[None]:
    """Turn what a user can cause (bad values, files, a reader's error in a worker process) into a CohdcError."""
    with warnings.catch_warnings():
        for message in _ADVICE:
            warnings.filterwarnings("ignore", message)
        try:
            yield
        except CohdcError as error:
            lines = str(error).strip().splitlines()
            raise CohdcError(lines[-1].partition("Error: ")[2] if len(lines) > 1 else str(error)) from error
        except (MisconfigurationException, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error
