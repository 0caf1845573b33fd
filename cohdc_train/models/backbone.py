"""Base of the backbones: a stem and four stages of strides 4, 8, 16, 32, with dilation."""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, Self

from torch import Tensor, nn

from cohdc_train.models.frozen_norm import FrozenNorm, apply_norms_in_convolutions
from cohdc_train.models.hdc import cycle_rates

Rates = Sequence[Sequence[int]]
Norm = Literal["batch", "frozen"]  # frozen keeps statistics and scale
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, RGB in 0..1


def norm_layer(norm: Norm, eps: float = 1e-5) -> Callable[[int], nn.Module]:
    """Return a function that builds the norm behind a convolution of so many channels."""
    return partial(nn.BatchNorm2d if norm == "batch" else FrozenNorm, eps=eps)


def round_channels(channels: float) -> int:
    """Round to the nearest multiple of 8, at least 8."""
    return max(8, round(channels / 8) * 8)


class Backbone(nn.Module, ABC):
    """Base of the backbones; a subclass builds its layers and then calls `init_stages`.

    Attributes:
        out_channels: channels of the four stages.
        frozen_stages: how many of the stem and the stages are not trained, counted from the stem.
    """

    out_channels: list[int]
    frozen_stages = 0

    @abstractmethod
    def stem_modules(self) -> list[nn.Module]:
        """Return the trainable modules of the stem, in the order in which they run."""

    @abstractmethod
    def stages(self) -> list[list[nn.Module]]:
        """Return the modules of the four stages, in the order in which they run."""

    @abstractmethod
    def stem(self, x: Tensor) -> Tensor:
        """Compute the input of the first stage.

        x: [B, 3, H, W], normalized by ImageNet's mean and deviation.
        """

    @abstractmethod
    def stem_receptive_field(self) -> tuple[int, int]:
        """Return the side of the stem's receptive field and its stride, px."""

    def init_stages(self, rates: Rates, frozen_stages: int) -> None:
        """Dilate the convolutions, initialize them as He et al. 2015, and freeze the first stages.

        Args:
            rates: dilation pattern of each of the four stages, repeated over its convolutions; (1,)
                is a plain stage.
            frozen_stages: how many of the stem and the stages are not trained.

        Raises:
            ValueError: a pattern leaves holes (the message names them), or there are not four
                patterns.
        """
        if len(rates) != 4:
            raise ValueError(f"HDC rates {tuple(rates)}: {len(rates)} patterns for 4 stages")
        for stage, pattern in zip(self.stages(), rates, strict=True):
            set_dilation(stage, pattern)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        apply_norms_in_convolutions(self)
        self.frozen_stages = frozen_stages
        for frozen in self._frozen():
            frozen.requires_grad_(False)

    def forward(self, x: Tensor) -> "OrderedDict[str, Tensor]":
        """Compute the feature map of each stage.

        Args:
            x: [B, 3, H, W], normalized; sides are multiples of 32.

        Returns:
            [B, C, H / s, W / s] by name: "0" of stride s = 4, "1" of 8, "2" of 16, "3" of 32.
        """
        x = self.stem(x)
        features = OrderedDict()
        for i, stage in enumerate(self.stages()):
            for module in stage:
                x = module(x)
            features[str(i)] = x
        return features

    def rates(self) -> list[tuple[int, ...]]:
        """Return the dilations of each stage's 3x3 convolutions, in their order."""
        return [tuple(c.dilation[0] for c in _convolutions(stage)) for stage in self.stages()]

    def receptive_field(self) -> int:
        """Return the side of the receptive field of a cell of the last stage, px of the input."""
        side, jump = self.stem_receptive_field()
        for stage in self.stages():
            for conv in _convolutions(stage):
                side += 2 * conv.dilation[0] * jump
                jump *= conv.stride[0]
        return side

    def train(self, mode: bool = True) -> Self:
        """Set training mode; frozen stages stay in evaluation mode, and so do their statistics."""
        super().train(mode)
        for frozen in self._frozen():
            frozen.eval()
        return self

    def _frozen(self) -> list[nn.Module]:
        """Return the modules of the stem and the stages that are not trained."""
        stem_and_stages = [self.stem_modules(), *self.stages()]
        return [module for part in stem_and_stages[: self.frozen_stages] for module in part]


def set_dilation(stage: Sequence[nn.Module], pattern: Sequence[int]) -> None:
    """Set the dilation of a stage's 3x3 convolutions in place; those with a stride keep rate 1.

    Raises:
        ValueError: the pattern leaves holes; the message names them.
    """
    unstrided = [conv for conv in _convolutions(stage) if conv.stride == (1, 1)]
    for conv, rate in zip(unstrided, cycle_rates(pattern, len(unstrided)), strict=True):
        conv.dilation = conv.padding = (rate, rate)


def _convolutions(stage: Sequence[nn.Module]) -> list[nn.Conv2d]:
    """Return a stage's 3x3 convolutions."""
    modules = (m for module in stage for m in module.modules())
    return [m for m in modules if isinstance(m, nn.Conv2d) and m.kernel_size == (3, 3)]
