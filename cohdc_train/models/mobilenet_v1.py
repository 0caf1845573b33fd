"""MobileNetV1 as a backbone (Howard et al. 2017), the light row of the paper's Table 4."""

from collections.abc import Callable

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from cohdc_train.models.backbone import MEAN, STD, Backbone, Norm, Rates, norm_layer, round_channels
from cohdc_train.models.backbone_weights import load_weights, read_weights

_EPS = 1e-3  # TensorFlow's, with which the published weights were trained
_BLOCKS = (
    (64, 1),
    (128, 2),
    (128, 1),
    (256, 2),
    (256, 1),
    (512, 2),
    *((512, 1),) * 5,
    (1024, 2),
    (1024, 1),
)
_STAGES = ((0, 3), (3, 5), (5, 11), (11, 13))  # blocks of each stage: strides 4, 8, 16, 32


class _ConvNorm(nn.Module):
    """Convolution, norm and ReLU6.

    A stride of 2 pads below and right only, as TensorFlow does with even sides.
    """

    def __init__(self, conv: nn.Conv2d, norm: nn.Module) -> None:
        super().__init__()
        self.conv, self.bn = conv, norm

    def forward(self, x: Tensor) -> Tensor:
        if self.conv.stride == (2, 2):
            x = F.pad(x, (0, 1, 0, 1))
        return F.relu6(self.bn(self.conv(x)))


class _Separable(nn.Module):
    """Depthwise 3x3 convolution and pointwise convolution."""

    def __init__(
        self, channels: int, out: int, stride: int, norm: Callable[[int], nn.Module]
    ) -> None:
        super().__init__()
        padding = 1 if stride == 1 else 0
        depthwise = nn.Conv2d(channels, channels, 3, stride, padding, groups=channels, bias=False)
        self.dw = _ConvNorm(depthwise, norm(channels))
        self.pw = _ConvNorm(nn.Conv2d(channels, out, 1, bias=False), norm(out))

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.pw(self.dw(x))
        return out


class MobileNetV1(Backbone):
    """MobileNetV1 whose depthwise convolutions may follow a dilation pattern inside each stage.

    The tensors' names are `stem_block.{conv,bn}` and `blocks.N.{dw,pw}.{conv,bn}`; weights are
    those of TensorFlow's network, which takes pixels in -1..1: the input is brought there from
    ImageNet's normalization.

    Args:
        width: channels as a share of the network's (32 to 1024), rounded to multiples of 8.
        rates: dilation pattern of each of the four stages.
        norm: "batch" trains BatchNorm, "frozen" keeps its statistics and scale.
        frozen_stages: how many of the stem and the stages are not trained.

    Raises:
        ValueError: as `Backbone.init_stages`.
    """

    scale: Tensor
    shift: Tensor

    def __init__(
        self,
        width: float = 1.0,
        rates: Rates = ((1,),) * 4,
        norm: Norm = "batch",
        frozen_stages: int = 0,
    ) -> None:
        """Build the layers."""
        super().__init__()
        make_norm = norm_layer(norm, _EPS)
        channels = round_channels(32 * width)
        self.stem_block = _ConvNorm(nn.Conv2d(3, channels, 3, 2, bias=False), make_norm(channels))
        self.blocks = nn.ModuleList()
        for out, stride in _BLOCKS:
            self.blocks.append(_Separable(channels, round_channels(out * width), stride, make_norm))
            channels = round_channels(out * width)
        self.out_channels = [round_channels(_BLOCKS[end - 1][0] * width) for _, end in _STAGES]
        self.register_buffer("scale", 2 * torch.tensor(STD).view(3, 1, 1), persistent=False)
        self.register_buffer("shift", 2 * torch.tensor(MEAN).view(3, 1, 1) - 1, persistent=False)
        self.init_stages(rates, frozen_stages)

    def stem_modules(self) -> list[nn.Module]:
        """Return the first convolution with its norm."""
        return [self.stem_block]

    def stages(self) -> list[list[nn.Module]]:
        """Return the blocks of each stage."""
        return [[*self.blocks[start:end]] for start, end in _STAGES]

    def stem(self, x: Tensor) -> Tensor:
        """Compute the input of the first stage."""
        out: Tensor = self.stem_block(x * self.scale + self.shift)
        return out

    def stem_receptive_field(self) -> tuple[int, int]:
        """Return the side of the stem's receptive field and its stride, px."""
        return 3, 2

    def load(self, weights: str) -> None:
        """Load a state dict into a network of full width; torchvision publishes none by name.

        weights: path of the state dict, whose stem may be called `stem`. Raises ValueError as
        `load_weights`, and FileNotFoundError when there is no such file.
        """
        state = {
            key.replace("stem.", "stem_block."): value
            for key, value in read_weights(weights, None).items()
        }
        load_weights(self, weights, state, "MobileNetV1")
