"""Lightning around the network: losses, optimizer and schedule, validation scores, checkpoints."""

import dataclasses
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from cohdc_train.data.datamodule import CocoDataModule, TrainBatch, ValSample
from cohdc_train.errors import CohdcError
from cohdc_train.metrics.coco_metrics import Results, SegmentationMetrics
from cohdc_train.models import MaskRCNN, NetworkConfig, detect, fuse_conv_bn
from cohdc_train.train.onnx_weights import load_onnx_weights, read_onnx_weights
from cohdc_train.train.optimizer import (
    ElapsedFraction,
    OptimizerConfig,
    build_optimizer,
    elapsed_fraction,
)
from cohdc_train.train.resume import check_resumable

MIN_CANVAS = 32  # px: one cell of the coarsest level that RoIs are pooled from
_CLASS_LAYERS = (
    "roi_heads.box_predictor.",
    "roi_heads.mask_predictor.mask_fcn_logits.",
    "cqe.quality.",
)
_NETWORK = NetworkConfig()
_OPTIMIZER = OptimizerConfig()


@dataclass(frozen=True)
class _Validation:
    """A validation that runs: the network made faster for it, and the scores so far."""

    network: MaskRCNN
    metrics: SegmentationMetrics


class MaskRCNNModule(pl.LightningModule):
    """HDC Mask R-CNN with CQE that Lightning trains and scores.

    Args:
        class_names: name of label i + 1 at index i; the command line takes them from the data.
        network: the network's shape.
        optimizer: optimizer and schedule.
        rescore: mask AP ranks by score * quality instead of by score.

    Attributes:
        min_quality: detections of a lower quality are not scored by a validation.
        results: detections and scores of the last validation; None before.
        validated_step: optimizer steps made before the last validation; -1 before.
        elapsed: share of the training budget that is used at a step, from the first step on.
    """

    def __init__(
        self,
        class_names: list[str],
        network: NetworkConfig = _NETWORK,
        optimizer: OptimizerConfig = _OPTIMIZER,
        rescore: bool = True,
    ) -> None:
        """Build the network."""
        super().__init__()
        self.class_names = list(class_names)
        if isinstance(network, dict):  # Lightning's load_from_checkpoint passes the stored values
            network = NetworkConfig(**network)
        if isinstance(optimizer, dict):
            optimizer = OptimizerConfig.from_stored(optimizer)
        self.network_config = network.resolved(pretrained=network.weights is not None)
        self.optimizer_config = optimizer.resolved(pretrained=network.weights is not None)
        self.rescore = rescore
        # Plain values only, so that a checkpoint loads under torch.load(weights_only=True).
        self.save_hyperparameters(
            {
                "class_names": self.class_names,
                "network": dataclasses.asdict(self.network_config),
                "optimizer": self.optimizer_config.stored(),
                "rescore": rescore,
            }
        )
        self.network = MaskRCNN(len(self.class_names), self.network_config)
        self.min_quality = 0.0
        self.results: Results | None = None
        self.validated_step = -1
        self.elapsed: ElapsedFraction | None = None
        self._metrics: SegmentationMetrics | None = None  # keeps the boundaries of the objects
        self._validation: _Validation | None = None

    @classmethod
    def load(cls, path: Path, canvas: tuple[int, int] | None = None) -> "MaskRCNNModule":
        """Load a trained module in evaluation mode on the CPU.

        The weights that its training started from are not needed.

        Args:
            path: a checkpoint of `cohdc fit`.
            canvas: (height, width) px to fit images into instead of the training's.

        Raises:
            CohdcError: the file is no checkpoint of this class, or the canvas is too small.
        """
        if canvas is not None and min(canvas) < MIN_CANVAS:
            raise CohdcError(
                f"canvas {canvas[0]} x {canvas[1]} px: height and width are at least {MIN_CANVAS}"
            )
        changed = {"weights": None} | ({} if canvas is None else {"canvas": canvas})
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            values = checkpoint["hyper_parameters"]
            module = cls(
                values["class_names"],
                NetworkConfig(**{**values["network"], **changed}),
                OptimizerConfig.from_stored(values["optimizer"]),
                values["rescore"],
            )
            module.load_state_dict(checkpoint["state_dict"])
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

    def load_pretrained(self, path: Path) -> list[str]:
        """Load the weights of another training that have the same name and shape here.

        Layers that decide between classes are loaded only with the same classes.

        Args:
            path: a checkpoint, or an ONNX file that was exported from one; then the network must be
                the same but for the classes.

        Returns:
            Names of the weights that were not loaded.

        Raises:
            CohdcError: the file is neither, or none of its weights fits.
        """
        other = self._from_onnx(path) if path.suffix == ".onnx" else MaskRCNNModule.load(path)
        theirs, own = other.network.state_dict(), self.network.state_dict()
        skipped = () if other.class_names == self.class_names else _CLASS_LAYERS
        matching = {
            name: weights
            for name, weights in theirs.items()
            if name in own and own[name].shape == weights.shape and not name.startswith(skipped)
        }
        if not any(name.startswith("backbone.body.") for name in matching):
            raise CohdcError(
                f"{path}: none of the weights of its backbone fits this network; "
                "give --config of its own"
            )
        self.network.load_state_dict(matching, strict=False)
        return [name for name in own if name not in matching]

    def _from_onnx(self, path: Path) -> "MaskRCNNModule":
        """Return a module of this network's shape with the classes and weights of an ONNX file."""
        try:
            model, class_names = read_onnx_weights(path)
            network = dataclasses.replace(self.network_config, weights=None)
            other = MaskRCNNModule(class_names, network)
            load_onnx_weights(other.network, model)
        except FileNotFoundError as error:
            raise CohdcError(f"{path}: no such file") from error
        except ValueError as error:
            raise CohdcError(
                f"{path}: {error}; --pretrained imagenet or none starts without it"
            ) from error
        return other

    def training_step(self, batch: TrainBatch, batch_idx: int) -> Tensor:
        """Return the sum of the losses.

        Raises:
            CohdcError: the sum is not finite; the message names step and images.
        """
        losses = self.network.losses(batch.images, batch.targets)
        total = torch.stack([loss.float() for loss in losses.values()]).sum()
        if not torch.isfinite(total):
            ids = ", ".join(str(target["image_id"]) for target in batch.targets)
            values = ", ".join(f"{name} {loss.item():.3g}" for name, loss in losses.items())
            raise CohdcError(
                f"step {self.global_step}: the loss is not finite on images {ids}: {values}; "
                "lower the lr"
            )
        size = len(batch.targets)
        logged = {f"train/{name}": loss.detach() for name, loss in losses.items()}
        self.log_dict(logged, batch_size=size)
        self.log("train/loss", total.detach(), prog_bar=True, batch_size=size)
        return total

    def on_validation_epoch_start(self) -> None:
        """Begin new scores of the present weights, or of the averaged ones where they are kept."""
        truth = self._data().val_ground_truth
        if self._metrics is None or self._metrics.ground_truth is not truth:
            self._metrics = SegmentationMetrics(truth)
        self._metrics.rescore = self.rescore
        self._metrics.min_quality = self.min_quality
        self._metrics.reset()
        dtype = torch.bfloat16 if self.trainer.precision == "bf16-mixed" else None
        self._validation = _Validation(fuse_conv_bn(self.network, dtype), self._metrics)

    def validation_step(self, batch: list[ValSample], batch_idx: int) -> None:
        """Collect the detections of the batch's images."""
        validation = self._running_validation()
        results = detect(validation.network, [image for image, _ in batch])
        for (_, image_id), detections in zip(batch, results, strict=True):
            validation.metrics.update(int(image_id), detections)

    def on_validation_epoch_end(self) -> None:
        """Log the scores under `val/`."""
        results = self._running_validation().metrics.results()
        for name, value in results.scores.items():
            self.log(f"val/{name}", value, prog_bar=name == "segm_AP50", sync_dist=True)
        if not self.trainer.sanity_checking:
            self.validated_step = self.trainer.global_step
        self.results = results
        self._validation = None

    def configure_optimizers(self) -> Any:
        """Build the optimizer of the trainable weights, and its schedule over the budget."""
        elapsed = elapsed_fraction(self.trainer, self.trainer.estimated_stepping_batches)
        if elapsed is None:
            raise CohdcError(
                "the schedule needs an end: give --epochs, --minutes or --trainer.max_steps"
            )
        self.elapsed = elapsed
        # Fused saves a tenth of a step on a CPU; in mixed precision Lightning cannot clip its
        # gradients.
        is_fused = self.trainer.precision == "32-true"
        optimizer, schedule = build_optimizer(
            self.optimizer_config, self.network, elapsed, is_fused
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of other classes or another network before its weights are loaded."""
        check_resumable(checkpoint.get("hyper_parameters", {}), dict(self.hparams))

    def _data(self) -> CocoDataModule:
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, CocoDataModule):
            raise TypeError("MaskRCNNModule validates on a CocoDataModule only")
        return data

    def _running_validation(self) -> _Validation:
        if self._validation is None:
            raise RuntimeError("no validation is running")
        return self._validation
