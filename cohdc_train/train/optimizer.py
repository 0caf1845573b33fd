"""The optimizer, its schedule, and how much of it the backbone gets."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from cohdc_train.models import MaskRCNN

Spent = Callable[[int], float]  # step -> share of the training's time that is over


@dataclass(frozen=True)
class OptimizerConfig:
    """The optimizer and its learning rate, per step: a linear warm-up, then half a cosine until the last step, or until
    the training's time is up where that comes first.

    Attributes:
        name: "sgd" or "adamw".
        lr: learning rate behind the warm-up.
        weight_decay: of weights; biases and norms have none.
        momentum: of SGD.
        warmup_steps: steps from 0 to lr, at most a tenth of the training.
        final_fraction: share of lr left at the last step; 1 keeps it constant.
        backbone_lr: the backbone's learning rate as a share of lr.
        frozen_steps: steps at the beginning in which the backbone rests, while what is new around it settles.
    """

    name: Literal["sgd", "adamw"] = "adamw"
    lr: float = 2e-4
    weight_decay: float = 0.05
    momentum: float = 0.9
    warmup_steps: int = 200
    final_fraction: float = 0.01
    backbone_lr: float = 1.0
    frozen_steps: int = 0

    def __post_init__(self) -> None:
        if self.lr <= 0 or not 0 <= self.final_fraction <= 1:
            raise ValueError(f"lr {self.lr} must be above 0 and final_fraction {self.final_fraction} in 0..1")
        if self.backbone_lr < 0 or self.frozen_steps < 0:
            raise ValueError(f"backbone_lr {self.backbone_lr} or frozen_steps {self.frozen_steps} is negative")

    def factor(self, step: int, total: int, spent: float = 0.0) -> float:
        """Share of lr at a step of `total`, when a share `spent` of the training's time is over."""
        warmup = min(self.warmup_steps, total // 10)
        if step < warmup:
            return (step + 1) / (warmup + 1)
        done = min(1.0, max(spent, (step - warmup) / max(1, total - warmup)))
        return self.final_fraction + (1 - self.final_fraction) * 0.5 * (1 + math.cos(math.pi * done))


def build_optimizer(
    config: OptimizerConfig, network: MaskRCNN, total: int, fused: bool, spent: Spent | None = None
) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """Optimizer over what is trained of a network, and its schedule over `total` steps.

    spent: share of the training's time that is over at a step, where it has an end in time.
    Weights and the rest (biases, norms) of the backbone and of what stands around it are four groups. A resting
    backbone's learning rate is 0: its gradients are still made, so that every rank of a distributed run has them.
    """
    groups: list[dict[str, object]] = []
    shares: list[tuple[float, int]] = []
    for share, rest, parameters in (
        (1.0, 0, [p for name, p in network.named_parameters() if not name.startswith("backbone.body.")]),
        (config.backbone_lr, config.frozen_steps, list(network.backbone.body.parameters())),
    ):
        for weights in (True, False):
            chosen: list[Tensor] = [p for p in parameters if p.requires_grad and (p.ndim > 1) == weights]
            if chosen:
                groups.append({"params": chosen, "weight_decay": config.weight_decay if weights else 0.0})
                shares.append((share, rest))
    optimizer: torch.optim.Optimizer
    if config.name == "sgd":
        optimizer = torch.optim.SGD(groups, lr=config.lr, momentum=config.momentum)
    else:
        optimizer = torch.optim.AdamW(groups, lr=config.lr, fused=fused)
    return optimizer, LambdaLR(optimizer, [_factor(config, total, spent, *share) for share in shares])


def _factor(
    config: OptimizerConfig, total: int, spent: Spent | None, share: float, rest: int
) -> Callable[[int], float]:
    """Share of lr of a group at a step: `share` of the schedule, nothing in the first `rest` steps."""
    return lambda step: share * config.factor(step, total, spent(step) if spent else 0.0) if step >= rest else 0.0


def time_spent(trainer: Trainer) -> Spent | None:
    """Share of `max_time` that is over at a step, the same on all devices; None for a trainer without one."""
    timers = [callback for callback in trainer.callbacks if isinstance(callback, Timer)]  # type: ignore[attr-defined]
    if not timers or (whole := timers[0].time_remaining()) is None:
        return None
    whole += timers[0].time_elapsed()

    @lru_cache(maxsize=1)  # the groups ask in turn
    def spent(step: int) -> float:
        return min(1.0, float(trainer.strategy.broadcast(timers[0].time_elapsed() / whole)))

    return spent
