"""MobileNetV1 as a backbone (Howard et al. 2017), the light row of the paper's Table 4."""

from collections.abc import Callable
from typing import Literal

import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from cohdc_train.models.staged import FrozenNorm, Rates, StagedBackbone, load_weights, read_weights

_EPS = 1e-3  # TensorFlow's, with which the published weights were trained
_BLOCKS = ((64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), *((512, 1),) * 5, (1024, 2), (1024, 1))
_STAGES = ((0, 3), (3, 5), (5, 11), (11, 13))  # blocks of each stage: strides 4, 8, 16, 32
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class _ConvNorm(nn.Module):
    """Convolution, norm, ReLU6; a stride of 2 pads below and right only, as TensorFlow does with even sides."""

    def __init__(self, conv: nn.Conv2d, norm: nn.Module) -> None:
        super().__init__()
        self.conv, self.bn = conv, norm

    def forward(self, x: Tensor) -> Tensor:
        if self.conv.stride == (2, 2):
            x = F.pad(x, (0, 1, 0, 1))
        return F.relu6(self.bn(self.conv(x)))


class _Separable(nn.Module):
    """A depthwise 3x3 and a pointwise convolution."""

    def __init__(self, channels: int, out: int, stride: int, norm: Callable[[int], nn.Module]) -> None:
        super().__init__()
        padding = 1 if stride == 1 else 0
        depthwise = nn.Conv2d(channels, channels, 3, stride, padding, groups=channels, bias=False)
        self.dw = _ConvNorm(depthwise, norm(channels))
        self.pw = _ConvNorm(nn.Conv2d(channels, out, 1, bias=False), norm(out))

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.pw(self.dw(x))
        return out


class MobileNetV1(StagedBackbone):
    """MobileNetV1 whose depthwise convolutions may follow a dilation pattern inside each stage.

    The tensors' names are `stem.{conv,bn}` and `blocks.N.{dw,pw}.{conv,bn}`; weights are those of TensorFlow's network,
    which takes pixels in -1..1: the input is brought there from ImageNet's normalisation.

    Args:
        width: channels as a share of the network's (32 to 1024), rounded to multiples of 8.
        rates: dilation pattern of each of the four stages.
        norm: "batch" trains BatchNorm, "frozen" keeps its statistics and scale.
        frozen_stages: how many of the stem and the stages are not trained.

    Raises:
        ValueError: as `StagedBackbone.finish`.
    """

    def __init__(
        self,
        width: float = 1.0,
        rates: Rates = ((1,),) * 4,
        norm: Literal["batch", "frozen"] = "batch",
        frozen_stages: int = 0,
    ) -> None:
        super().__init__()

        def norm_layer(channels: int) -> nn.Module:
            return nn.BatchNorm2d(channels, eps=_EPS) if norm == "batch" else FrozenNorm(channels, eps=_EPS)

        channels = _rounded(32 * width)
        self.stem_block = _ConvNorm(nn.Conv2d(3, channels, 3, 2, bias=False), norm_layer(channels))
        self.blocks = nn.ModuleList()
        for out, stride in _BLOCKS:
            self.blocks.append(_Separable(channels, _rounded(out * width), stride, norm_layer))
            channels = _rounded(out * width)
        self.out_channels = [_rounded(_BLOCKS[end - 1][0] * width) for _, end in _STAGES]
        self.finish(rates, frozen_stages)

    def parts(self) -> list[list[nn.Module]]:
        return [[self.stem_block], *([*self.blocks[start:end]] for start, end in _STAGES)]

    def stem(self, x: Tensor) -> Tensor:
        mean, std = (x.new_tensor(v).view(3, 1, 1) for v in (_MEAN, _STD))
        out: Tensor = self.stem_block(x * (2 * std) + (2 * mean - 1))
        return out

    def field_of_stem(self) -> tuple[int, int]:
        return 3, 2

    def load(self, weights: str) -> None:
        """Fill a full-width network from a state dict. Raises ValueError as `load_weights`; FileNotFoundError when
        there is no such file: torchvision publishes none under a name.
        """
        state = {key.replace("stem.", "stem_block."): value for key, value in read_weights(weights, None).items()}
        load_weights(self, weights, state, "MobileNetV1")


def _rounded(channels: float) -> int:
    return max(8, round(channels / 8) * 8)
