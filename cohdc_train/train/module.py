"""Lightning around the network: losses, optimizer and schedule, validation scores, checkpoints."""

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from cohdc_train.data.datamodule import CocoDataModule, TrainBatch, ValSample
from cohdc_train.errors import CohdcError
from cohdc_train.metrics.coco_metrics import Results, SegmentationMetrics
from cohdc_train.models import MaskRCNN, NetworkConfig, detect, fused
from cohdc_train.train.initial_weights import SHAPE_FIELDS
from cohdc_train.train.onnx_weights import load_exported, read_exported
from cohdc_train.train.optimizer import (
    OptimizerConfig,
    Progress,
    build_optimizer,
    training_progress,
)

_OF_CLASSES = (
    "roi_heads.box_predictor.",
    "roi_heads.mask_predictor.mask_fcn_logits.",
    "cqe.quality.",
)
MIN_CANVAS = 32  # px: one cell of the coarsest level that RoIs are pooled from
_NETWORK = NetworkConfig()
_OPTIMIZER = OptimizerConfig()


class MaskRCNNModule(pl.LightningModule):
    """Trains and scores an HDC Mask R-CNN with CQE.

    Args:
        class_names: name of label i + 1 at index i; the command line takes them from the data.
        network: the network's shape.
        optimizer: optimizer and schedule.
        rescore: mask AP ranks by score * quality instead of by score.
    """

    def __init__(
        self,
        class_names: list[str],
        network: NetworkConfig = _NETWORK,
        optimizer: OptimizerConfig = _OPTIMIZER,
        rescore: bool = True,
    ) -> None:
        super().__init__()
        self.class_names = list(class_names)
        config: NetworkConfig = _rebuild(NetworkConfig, network)
        self.network_config = config.resolved(pretrained=config.weights is not None)
        schedule: OptimizerConfig = _rebuild(OptimizerConfig, optimizer)
        self.optimizer_config = schedule.resolved(pretrained=config.weights is not None)
        self.rescore = rescore
        self.min_quality = 0.0  # of the detections that validation scores
        # Plain values only, so that a checkpoint loads under torch.load(weights_only=True).
        self.save_hyperparameters(
            {
                "class_names": self.class_names,
                "network": dataclasses.asdict(self.network_config),
                "optimizer": dataclasses.asdict(self.optimizer_config),
                "rescore": rescore,
            }
        )
        self.network = MaskRCNN(len(self.class_names), self.network_config)
        self._metrics: SegmentationMetrics | None = None
        self._fused: list[
            MaskRCNN
        ] = []  # while validation lasts; in a list it is no part of the module
        self.results: Results | None = None  # of the last validation
        self.validated_step = -1  # optimizer steps made before it
        self.progress: Progress | None = None  # of the training, from the first step on

    @classmethod
    def load(cls, path: Path, canvas: tuple[int, int] | None = None) -> "MaskRCNNModule":
        """A trained module in evaluation mode on the CPU, without fetching the weights its training
        started from.

        canvas: (height, width) px to fit images into instead of the training's. Raises CohdcError
        naming the file when it is no checkpoint of this class.
        """
        if canvas is not None and min(canvas) < MIN_CANVAS:
            raise CohdcError(
                f"canvas {canvas[0]} x {canvas[1]} px: height and width are at least {MIN_CANVAS}"
            )
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            values, state = checkpoint["hyper_parameters"], checkpoint["state_dict"]
            changed = {"weights": None} | ({} if canvas is None else {"canvas": canvas})
            network = NetworkConfig(**{**values["network"], **changed})
            module = cls(
                values["class_names"],
                network,
                OptimizerConfig(**values["optimizer"]),
                values["rescore"],
            )
            module.load_state_dict(state)
        except FileNotFoundError as error:
            raise CohdcError(f"{path}: no such file") from error
        except (
            OSError,
            EOFError,
            KeyError,
            TypeError,
            ValueError,
            RuntimeError,
            pickle.UnpicklingError,
        ) as error:
            reason = str(error).partition("\n")[0]
            raise CohdcError(
                f"{path}: not a checkpoint of cohdc fit: {type(error).__name__}: {reason}"
            ) from error
        return module.eval()

    def take_over(self, path: Path) -> list[str]:
        """Start from the weights of another training: all of those that have the same name and
        shape here.

        path: a checkpoint, or an ONNX file that was exported of one; then the network must be the
        same but for the classes. What decides between classes is taken over only with the same
        classes. Returns the names of what was not. Raises CohdcError naming the file when it is
        neither, or none of its weights fits.
        """
        other = self._of_file(path) if path.suffix == ".onnx" else MaskRCNNModule.load(path)
        theirs, own = other.network.state_dict(), self.network.state_dict()
        specific = () if other.class_names == self.class_names else _OF_CLASSES
        fitting = {
            name: weights
            for name, weights in theirs.items()
            if name in own and own[name].shape == weights.shape and not name.startswith(specific)
        }
        if not any(name.startswith("backbone.body.") for name in fitting):
            raise CohdcError(
                f"{path}: none of the weights of its backbone fits this network; give --config of its own"
            )
        self.network.load_state_dict(fitting, strict=False)
        return [name for name in own if name not in fitting]

    def _of_file(self, path: Path) -> "MaskRCNNModule":
        try:
            model, class_names = read_exported(path)
            other = MaskRCNNModule(
                class_names, dataclasses.replace(self.network_config, weights=None)
            )
            load_exported(other.network, model)
        except FileNotFoundError as error:
            raise CohdcError(f"{path}: no such file") from error
        except ValueError as error:
            raise CohdcError(
                f"{path}: {error}; --pretrained imagenet or none starts without it"
            ) from error
        return other

    def training_step(self, batch: TrainBatch, batch_idx: int) -> Tensor:
        """The sum of the losses. Raises CohdcError naming step and images when it is not finite."""
        losses = self.network.losses(batch.images, batch.targets)
        total = torch.stack([loss.float() for loss in losses.values()]).sum()
        if not torch.isfinite(total):
            ids = ", ".join(str(target["image_id"]) for target in batch.targets)
            values = ", ".join(f"{name} {loss.item():.3g}" for name, loss in losses.items())
            raise CohdcError(
                f"step {self.global_step}: the loss is not finite on images {ids}: {values}; lower the lr"
            )
        size = len(batch.targets)
        self.log_dict(
            {f"train/{name}": loss.detach() for name, loss in losses.items()}, batch_size=size
        )
        self.log("train/loss", total.detach(), prog_bar=True, batch_size=size)
        return total

    def on_validation_epoch_start(self) -> None:
        """Begin new scores, of the weights as they are (the averaged ones, where they are scored)."""
        self._fused = [
            fused(self.network, torch.bfloat16 if self.trainer.precision == "bf16-mixed" else None)
        ]
        truth = self._data().val_ground_truth
        if self._metrics is None or self._metrics.ground_truth is not truth:
            self._metrics = SegmentationMetrics(truth)
        self._metrics.rescore, self._metrics.min_quality = self.rescore, self.min_quality
        self._metrics.reset()

    def validation_step(self, batch: list[ValSample], batch_idx: int) -> None:
        """Collect the detections of the batch's images."""
        assert self._metrics is not None
        found = detect(self._fused[0], [image for image, _ in batch])
        for (_, image_id), detections in zip(batch, found, strict=True):
            self._metrics.update(int(image_id), detections)

    def on_validation_epoch_end(self) -> None:
        """Log the scores under `val/`."""
        assert self._metrics is not None
        self.results = self._metrics.results()
        if not self.trainer.sanity_checking:
            self.validated_step = self.trainer.global_step
        for name, value in self.results.scores.items():
            self.log(f"val/{name}", value, prog_bar=name == "segm_AP50", sync_dist=True)
        self._fused = []

    def configure_optimizers(self) -> Any:
        """Optimizer over what is trained, and its schedule over the trainer's steps."""
        progress = training_progress(self.trainer, self.trainer.estimated_stepping_batches)
        if progress is None:
            raise CohdcError(
                "the schedule needs an end: give --epochs, --minutes or --trainer.max_steps"
            )
        self.progress = progress
        # Fused saves a tenth of a step on a CPU; in mixed precision Lightning cannot clip its
        # gradients.
        optimizer, schedule = build_optimizer(
            self.optimizer_config, self.network, progress, fused=self.trainer.precision == "32-true"
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another class map, before its weights are looked at."""
        theirs = list(checkpoint.get("hyper_parameters", {}).get("class_names", []))
        if theirs != self.class_names:
            ours = ", ".join(self.class_names)
            raise CohdcError(
                f"the checkpoint's classes are {', '.join(theirs)}; the data's are {ours}"
            )
        network = checkpoint.get("hyper_parameters", {}).get("network", {})
        for name in SHAPE_FIELDS:
            own = getattr(self.network_config, name)
            if network.get(name, own) != own:
                raise CohdcError(
                    f"the checkpoint's network has {name} {network[name]}, this one {own}; "
                    "give --config of its training, the config.yaml next to it"
                )

    def _data(self) -> CocoDataModule:
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, CocoDataModule):
            raise TypeError("MaskRCNNModule validates on a CocoDataModule only")
        return data


def _rebuild(kind: Any, value: Any) -> Any:
    """A configuration from itself or from the plain dict a checkpoint holds."""
    return kind(**value) if isinstance(value, dict) else value
