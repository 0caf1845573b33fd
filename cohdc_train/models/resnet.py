"""ResNets with hybrid dilated stages, with torchvision's parameters (paper 2.1.1, Fig. 4)."""

from collections.abc import Callable
from typing import Literal

from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock, Bottleneck

from cohdc_train.models.backbone import Backbone, Norm, Rates, norm_layer, round_channels
from cohdc_train.models.backbone_weights import load_weights, read_weights

Depth = Literal[18, 34, 50, 101]
_BLOCKS: dict[int, tuple[type[BasicBlock] | type[Bottleneck], tuple[int, int, int, int]]] = {
    18: (BasicBlock, (2, 2, 2, 2)),
    34: (BasicBlock, (3, 4, 6, 3)),
    50: (Bottleneck, (3, 4, 6, 3)),
    101: (Bottleneck, (3, 4, 23, 3)),
}


class HDCResNet(Backbone):
    """ResNet whose 3x3 convolutions follow a dilation pattern inside each stage.

    Strides stay 4, 8, 16, 32. Dilation changes no tensor's shape, so ImageNet weights load
    unchanged. A stage's strided convolution keeps rate 1 and the pattern starts behind it: with the
    stride inside the pattern, (1, 2, 3) would skip every eighth pixel.

    Args:
        depth: 18, 34, 50 or 101.
        width: channels as a share of ResNet's (64, 128, 256, 512 planes), rounded to multiples of
            8.
        rates: dilation pattern of each of the four stages, repeated over its convolutions; (1,) is
            a plain stage.
        norm: "batch" trains BatchNorm, "frozen" keeps its statistics and scale (small batches,
            pretrained weights).
        frozen_stages: how many of stem, layer1 .. layer4 are not trained, counted from the stem.

    Raises:
        ValueError: as `Backbone.init_stages`.
    """

    def __init__(
        self,
        depth: Depth,
        width: float = 1.0,
        rates: Rates = ((1, 2, 3),) * 4,
        norm: Norm = "batch",
        frozen_stages: int = 0,
    ) -> None:
        """Build the layers."""
        super().__init__()
        self.depth: Depth = depth
        block, blocks = _BLOCKS[depth]
        make_norm = norm_layer(norm)
        planes = [round_channels(64 * width * 2**i) for i in range(4)]
        self.conv1 = nn.Conv2d(3, planes[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = make_norm(planes[0])
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        channels = planes[0]
        for i in range(4):
            stage = _stage(block, channels, planes[i], blocks[i], 1 if i == 0 else 2, make_norm)
            self.add_module(f"layer{i + 1}", stage)
            channels = planes[i] * block.expansion
        self.out_channels = [p * block.expansion for p in planes]
        self.init_stages(rates, frozen_stages)

    def stem_modules(self) -> list[nn.Module]:
        """Return the first convolution and its norm."""
        return [self.conv1, self.bn1]

    def stages(self) -> list[list[nn.Module]]:
        """Return layer1 to layer4."""
        return [[self.get_submodule(f"layer{i}")] for i in range(1, 5)]

    def stem(self, x: Tensor) -> Tensor:
        """Compute the input of layer1."""
        out: Tensor = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        return out

    def stem_receptive_field(self) -> tuple[int, int]:
        """Return the side of the stem's receptive field and its stride, px."""
        return 7 + 2 * 2, 4

    def load(self, weights: str) -> None:
        """Load ImageNet weights into a network of full width.

        Args:
            weights: a torchvision name such as "IMAGENET1K_V1", or the path of a state dict; its
                `fc.*` is ignored.

        Raises:
            ValueError: a tensor does not fit; the message names the file and the first such tensor.
            FileNotFoundError: there is no such file and no such name.
        """
        state = read_weights(weights, f"resnet{self.depth}")
        load_weights(self, weights, state, f"ResNet-{self.depth}")


def _stage(
    block: type[BasicBlock] | type[Bottleneck],
    channels: int,
    planes: int,
    blocks: int,
    stride: int,
    make_norm: Callable[[int], nn.Module],
) -> nn.Sequential:
    """Build one stage: a block that changes stride and channels, then blocks that keep both."""
    out = planes * block.expansion
    shortcut = None
    if stride != 1 or channels != out:
        shortcut = nn.Sequential(
            nn.Conv2d(channels, out, 1, stride=stride, bias=False), make_norm(out)
        )
    first = block(channels, planes, stride, shortcut, norm_layer=make_norm)
    rest = [block(out, planes, norm_layer=make_norm) for _ in range(blocks - 1)]
    return nn.Sequential(first, *rest)
