"""Optimizer, learning-rate schedule, and the backbone's share of the learning rate."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from cohdc_train.models import MaskRCNN

PRETRAINED_BACKBONE_LR = 0.2
_STORED_NAMES = {"backbone_freeze_steps": "frozen_steps"}  # field -> its key in checkpoints
ElapsedFraction = Callable[[int], float]  # step -> share of the training budget that is used, 0..1


@dataclass(frozen=True)
class OptimizerConfig:
    """Optimizer and learning rate: linear warm-up times half a cosine over the training budget.

    The budget is what ends the training: epochs, steps or minutes. The rate is a continuous
    function of the share of it that is used, so it neither jumps at the end of the warm-up nor when
    the clock becomes the limit instead of the steps.

    Attributes:
        name: "sgd" or "adamw".
        lr: peak learning rate.
        weight_decay: of weights; biases and norms have none.
        momentum: of SGD.
        warmup_ratio: share of the budget over which the rate rises from 0.
        warmup_steps: length of the warm-up in steps instead; None takes warmup_ratio.
        final_fraction: share of lr that is left at the end; 1 keeps it constant after the warm-up.
        backbone_lr: learning rate of the backbone as a share of lr; None is 0.2 with trained
            initial weights, and 1 without.
        backbone_freeze_steps: steps at the beginning in which the backbone is not trained.
    """

    name: Literal["sgd", "adamw"] = "adamw"
    lr: float = 1.2e-3
    weight_decay: float = 0.05
    momentum: float = 0.9
    warmup_ratio: float = 0.05
    warmup_steps: int | None = None
    final_fraction: float = 0.01
    backbone_lr: float | None = None
    backbone_freeze_steps: int = 0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: a value is out of range.
        """
        if self.lr <= 0 or not 0 <= self.final_fraction <= 1:
            raise ValueError(
                f"lr {self.lr} must be above 0 and final_fraction {self.final_fraction} in 0..1"
            )
        if not 0 <= self.warmup_ratio < 1 or (self.warmup_steps or 0) < 0:
            raise ValueError(
                f"warmup_ratio {self.warmup_ratio} must be in 0..1 "
                f"and warmup_steps {self.warmup_steps} not negative"
            )
        if (self.backbone_lr or 0) < 0 or self.backbone_freeze_steps < 0:
            raise ValueError(
                f"backbone_lr {self.backbone_lr} or "
                f"backbone_freeze_steps {self.backbone_freeze_steps} is negative"
            )

    @classmethod
    def from_stored(cls, values: Mapping[str, Any]) -> "OptimizerConfig":
        """Build the config from the values that a checkpoint holds, see `stored`."""
        return cls(**{option_name(key): value for key, value in values.items()})

    def stored(self) -> dict[str, Any]:
        """Return plain values for a checkpoint, whose keys are those of the first release."""
        return {_STORED_NAMES.get(name, name): value for name, value in asdict(self).items()}

    def resolved(self, pretrained: bool) -> "OptimizerConfig":
        """Return a copy in which backbone_lr is decided.

        pretrained: whether the backbone's initial weights are trained.
        """
        if self.backbone_lr is not None:
            return self
        return replace(self, backbone_lr=PRETRAINED_BACKBONE_LR if pretrained else 1.0)

    def factor(self, step: int, elapsed: float) -> float:
        """Return the share of lr at a step.

        Args:
            step: optimizer steps already made.
            elapsed: share of the budget that is used, 0..1.
        """
        elapsed = min(1.0, max(0.0, elapsed))
        cosine = 0.5 * (1 + math.cos(math.pi * elapsed))
        decayed = self.final_fraction + (1 - self.final_fraction) * cosine
        return self._warmup(step, elapsed) * decayed

    def _warmup(self, step: int, elapsed: float) -> float:
        """Return the share of the warm-up that is over, above 0 so that the first step trains."""
        if self.warmup_steps is not None:
            return min(1.0, (step + 1) / (self.warmup_steps + 1))
        if self.warmup_ratio == 0:
            return 1.0
        return min(1.0, max(elapsed / self.warmup_ratio, 1e-3))


def option_name(key: str) -> str:
    """Return the name of the option under `--model.optimizer` of a key in checkpoints."""
    return {stored: name for name, stored in _STORED_NAMES.items()}.get(key, key)


def build_optimizer(
    config: OptimizerConfig, network: MaskRCNN, elapsed: ElapsedFraction, fused: bool
) -> tuple[torch.optim.Optimizer, LambdaLR]:
    """Build the optimizer of a network's trainable parameters, and its schedule.

    There are four groups: weights and the rest (biases, norms), of the backbone and of the heads.
    The learning rate of a backbone that is not trained yet is 0: its gradients exist, so that every
    rank of a distributed run has them.

    Args:
        config: optimizer and schedule.
        network: the network to train.
        elapsed: share of the budget that is used at a step.
        fused: AdamW updates all parameters in one kernel.
    """
    body = list(network.backbone.body.parameters())
    heads = [p for name, p in network.named_parameters() if not name.startswith("backbone.body.")]
    backbone_share = 1.0 if config.backbone_lr is None else config.backbone_lr

    groups: list[dict[str, object]] = []
    factors: list[Callable[[int], float]] = []
    for name, share, freeze_steps, parameters in (
        ("heads", 1.0, 0, heads),
        ("backbone", backbone_share, config.backbone_freeze_steps, body),
    ):
        trainable = [p for p in parameters if p.requires_grad]
        weights: list[Tensor] = [p for p in trainable if p.ndim > 1]
        biases: list[Tensor] = [p for p in trainable if p.ndim <= 1]
        for kind, members, decay in (
            ("weights", weights, config.weight_decay),
            ("biases", biases, 0.0),
        ):
            if members:
                group = {"params": members, "weight_decay": decay, "name": f"{name}_{kind}"}
                groups.append(group)
                factors.append(_group_factor(config, elapsed, share, freeze_steps))

    optimizer: torch.optim.Optimizer
    if config.name == "sgd":
        optimizer = torch.optim.SGD(groups, lr=config.lr, momentum=config.momentum)
    else:
        optimizer = torch.optim.AdamW(groups, lr=config.lr, fused=fused)
    return optimizer, LambdaLR(optimizer, factors)


def _group_factor(
    config: OptimizerConfig, elapsed: ElapsedFraction, share: float, freeze_steps: int
) -> Callable[[int], float]:
    """Return a function of the step: the share of lr that a parameter group gets."""

    def factor(step: int) -> float:
        return share * config.factor(step, elapsed(step)) if step >= freeze_steps else 0.0

    return factor


def elapsed_fraction(trainer: Trainer, total_steps: float) -> ElapsedFraction | None:
    """Return a function of the step: the share of the budget that is used.

    The share is that of the steps or of `max_time`, whichever is larger. Every process of a
    distributed run gets the same value.

    Args:
        trainer: the trainer.
        total_steps: steps until max_epochs or max_steps; infinite where only time ends the
            training.

    Returns:
        None for a training without an end.
    """
    timer = next((c for c in trainer.callbacks if isinstance(c, Timer)), None)  # type: ignore[attr-defined]
    remaining = None if timer is None else timer.time_remaining()
    if timer is None or remaining is None:
        if math.isinf(total_steps):
            return None
        return lambda step: step / max(1.0, total_steps)
    max_time = remaining + timer.time_elapsed()

    @lru_cache(maxsize=1)  # the parameter groups ask one after the other
    def elapsed(step: int) -> float:
        time_share = float(trainer.strategy.broadcast(timer.time_elapsed() / max_time))
        return max(time_share, step / max(1.0, total_steps))

    return elapsed
