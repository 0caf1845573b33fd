"""Callback for the tests of distributed training, which writes down what each rank saw."""

from pathlib import Path
from typing import Any

import coco_toys
import lightning.pytorch as pl
import torch
from torch import Tensor

from cohdc_train.train import module


class Probe(pl.Callback):
    """Writes `rankN.pt`: the losses of every step, the validation scores and the trained weights.

    Validation is on detections made of the toy images' colors: a network of a few steps would not
    give any.
    apart: a fault on purpose, every rank keeps its own gradients.
    """

    def __init__(self, folder: Path, apart: bool = False) -> None:
        self.folder = folder
        self.apart = apart
        self.losses: list[float] = []
        self.scores: dict[str, float] = {}
        module.detect = see

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        if self.apart:
            trainer.strategy.model.register_comm_hook(None, _keep_own_gradients)

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.losses.append(float(outputs["loss"]))

    def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
        self.scores = {
            k: float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/")
        }

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        seen = {
            "losses": self.losses,
            "scores": self.scores,
            "weights": pl_module.network.state_dict(),
        }
        torch.save(seen, self.folder / f"rank{trainer.global_rank}.pt")


def see(network: Any, images: list[Tensor]) -> list[dict[str, Tensor]]:
    """Return one detection per color of the toy images, off by what their pixels determine."""
    found = []
    for image in images:
        boxes, labels = [], []
        for label, color in enumerate(coco_toys.COLORS.values()):
            inside = (image == torch.tensor(color)[:, None, None]).all(dim=0)
            rows, columns = inside.any(dim=1).nonzero()[:, 0], inside.any(dim=0).nonzero()[:, 0]
            if len(rows):
                boxes.append(
                    [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]
                )
                labels.append(label)
        drawn = torch.Generator().manual_seed(int(image.sum()))
        n = len(labels)
        off = torch.randint(-3, 4, (n, 4), generator=drawn)
        found.append(
            {
                "boxes": torch.tensor(boxes).reshape(n, 4) + off.float(),
                "labels": torch.tensor(labels),
                "scores": torch.rand(n, generator=drawn),
                "quality": torch.rand(n, generator=drawn),
                "masks": torch.ones(n, 28, 28),
            }
        )
    return found


def _keep_own_gradients(
    state: Any, bucket: torch.distributed.GradBucket
) -> torch.futures.Future[Tensor]:
    """Replace the communication of gradients by none."""
    kept: torch.futures.Future[Tensor] = torch.futures.Future()
    kept.set_result(bucket.buffer())
    return kept
