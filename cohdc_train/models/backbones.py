"""ResNets with hybrid dilated stages, parameter for parameter torchvision's (paper 2.1.1, Fig. 4)."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torchvision.models import get_model_weights
from torchvision.models.resnet import BasicBlock, Bottleneck
from torchvision.ops import FrozenBatchNorm2d

from cohdc_train.models.hdc import cycle

Depth = Literal[18, 34, 50]
_BLOCKS: dict[int, tuple[type[BasicBlock] | type[Bottleneck], tuple[int, int, int, int]]] = {
    18: (BasicBlock, (2, 2, 2, 2)),
    34: (BasicBlock, (3, 4, 6, 3)),
    50: (Bottleneck, (3, 4, 6, 3)),
}


class FrozenNorm(FrozenBatchNorm2d):  # type: ignore[misc]  # torchvision is not typed
    """Torchvision's, which in mixed precision turns every half-precision map into float32 and leaves it so."""

    def forward(self, x: Tensor) -> Tensor:
        if x.dtype == self.weight.dtype:
            out: Tensor = super().forward(x)
            return out
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)


class HDCResNet(nn.Module):
    """ResNet-18/34/50 whose 3x3 convolutions follow a dilation pattern inside each stage; strides stay 4, 8, 16, 32.

    Dilation changes no tensor's shape, so ImageNet weights load unchanged. A stage's strided convolution keeps rate 1
    and the pattern starts behind it: with the stride inside the pattern, (1, 2, 3) would skip every eighth pixel.

    Args:
        depth: 18, 34 or 50.
        width: channels as a share of ResNet's (64, 128, 256, 512 planes), rounded to multiples of 8.
        rates: dilation pattern of each of the four stages, cycled over its convolutions; (1,) is a plain stage.
        norm: "batch" trains BatchNorm, "frozen" keeps its statistics and scale (small batches, pretrained weights).
        frozen_stages: how many of stem, layer1 .. layer4 are not trained, counted from the stem.

    Raises:
        ValueError: a pattern leaves holes (they are named), or there are not four patterns.
    """

    def __init__(
        self,
        depth: Depth,
        width: float = 1.0,
        rates: Sequence[Sequence[int]] = ((1, 2, 3),) * 4,
        norm: Literal["batch", "frozen"] = "batch",
        frozen_stages: int = 0,
    ) -> None:
        super().__init__()
        if len(rates) != 4:
            raise ValueError(f"HDC rates {tuple(rates)}: {len(rates)} patterns for 4 stages")
        block, blocks = _BLOCKS[depth]
        norm_layer: Callable[..., nn.Module] = nn.BatchNorm2d if norm == "batch" else FrozenNorm
        planes = [max(8, round(64 * width * 2**i / 8) * 8) for i in range(4)]
        self.conv1 = nn.Conv2d(3, planes[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = norm_layer(planes[0])
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        channels = planes[0]
        for i in range(4):
            stage = _stage(block, channels, planes[i], blocks[i], 1 if i == 0 else 2, norm_layer)
            dilate(stage, rates[i])
            self.add_module(f"layer{i + 1}", stage)
            channels = planes[i] * block.expansion
        self.out_channels = [p * block.expansion for p in planes]
        self.frozen_stages = frozen_stages
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        for frozen in self._frozen():
            frozen.requires_grad_(False)

    def forward(self, x: Tensor) -> "OrderedDict[str, Tensor]":
        """x: [B, 3, H, W], normalised. Returns {"0": stride 4, "1": 8, "2": 16, "3": 32} feature maps."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        features = OrderedDict()
        for i in range(4):
            x = self.get_submodule(f"layer{i + 1}")(x)
            features[str(i)] = x
        return features

    def rates(self) -> list[tuple[int, ...]]:
        """Dilations of each stage's 3x3 convolutions, in their order."""
        return [tuple(c.dilation[0] for c in _convolutions(self.get_submodule(f"layer{i}"))) for i in range(1, 5)]

    def receptive_field(self) -> int:
        """Side, in px of the input, of what a cell of the last stage sees."""
        side, jump = 7 + 2 * 2, 4  # the first convolution, and the pooling behind it
        for i in range(1, 5):
            for conv in _convolutions(self.get_submodule(f"layer{i}")):
                side += 2 * conv.dilation[0] * jump
                jump *= conv.stride[0]
        return side

    def train(self, mode: bool = True) -> "HDCResNet":
        """As nn.Module's, but frozen stages stay in evaluation mode, so that their BatchNorm statistics rest."""
        super().train(mode)
        for frozen in self._frozen():
            frozen.eval()
        return self

    def _frozen(self) -> list[nn.Module]:
        if self.frozen_stages == 0:
            return []
        layers = [self.get_submodule(f"layer{i}") for i in range(1, self.frozen_stages)]
        return [self.conv1, self.bn1, *layers]


def dilate(stage: nn.Module, pattern: Sequence[int]) -> None:
    """Set the dilation of a stage's 3x3 convolutions in place; the one with a stride keeps rate 1.

    Raises ValueError naming the holes of a pattern that leaves some.
    """
    free = [conv for conv in _convolutions(stage) if conv.stride == (1, 1)]
    for conv, rate in zip(free, cycle(pattern, len(free)), strict=True):
        conv.dilation = conv.padding = (rate, rate)


def _convolutions(stage: nn.Module) -> list[nn.Conv2d]:
    return [m for m in stage.modules() if isinstance(m, nn.Conv2d) and m.kernel_size == (3, 3)]


def load_backbone_weights(backbone: HDCResNet, depth: Depth, weights: str) -> None:
    """Fill a full-width backbone with ImageNet weights.

    weights: a torchvision name such as "IMAGENET1K_V1", or the path of a state dict (`fc.*` is passed over).
    Raises ValueError naming the file and the first tensor that does not fit; FileNotFoundError when there is no such
    file and no such name.
    """
    published = get_model_weights(f"resnet{depth}")
    if Path(weights).is_file():
        state = torch.load(weights, map_location="cpu", weights_only=True)
    elif weights in published.__members__:
        state = published[weights].get_state_dict(progress=True)
    else:
        names = ", ".join(published.__members__)
        raise FileNotFoundError(f"{weights}: no such file, and torchvision's ResNet-{depth} weights are {names}")
    state = {name: tensor for name, tensor in state.items() if not name.startswith("fc.")}
    own = backbone.state_dict()
    for name in (key for key in own if not key.endswith("num_batches_tracked")):
        if name not in state:
            raise ValueError(f"{weights}: no tensor {name}; these are not ResNet-{depth} weights")
        if state[name].shape != own[name].shape:
            raise ValueError(f"{weights}: {name} is {list(state[name].shape)}, the backbone's {list(own[name].shape)}")
    backbone.load_state_dict(state, strict=False)


def _stage(
    block: type[BasicBlock] | type[Bottleneck],
    channels: int,
    planes: int,
    blocks: int,
    stride: int,
    norm_layer: Callable[..., nn.Module],
) -> nn.Sequential:
    out = planes * block.expansion
    shortcut = None
    if stride != 1 or channels != out:
        shortcut = nn.Sequential(nn.Conv2d(channels, out, 1, stride=stride, bias=False), norm_layer(out))
    first = block(channels, planes, stride, shortcut, norm_layer=norm_layer)
    rest = [block(out, planes, norm_layer=norm_layer) for _ in range(blocks - 1)]
    return nn.Sequential(first, *rest)
