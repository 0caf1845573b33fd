"""torchvision's MobileNetV2 as a backbone (Sandler et al. 2018), tensor for tensor."""

from torch import Tensor, nn
from torchvision.models import mobilenet_v2

from cohdc_train.models.backbone import Backbone, Norm, Rates, norm_layer
from cohdc_train.models.backbone_weights import load_weights, read_weights

_STEM = (0, 2)  # modules of the stem
_STAGES = ((2, 4), (4, 7), (7, 14), (14, 18))  # and of the stages of strides 4, 8, 16, 32


class MobileNetV2(Backbone):
    """MobileNetV2 without its last convolution, whose stages may be dilated.

    Args:
        width: channels as a share of the network's, rounded to multiples of 8.
        rates: dilation pattern of each of the four stages.
        norm: "batch" trains BatchNorm, "frozen" keeps its statistics and scale.
        frozen_stages: how many of the stem and the stages are not trained.

    Raises:
        ValueError: as `Backbone.init_stages`.
    """

    def __init__(
        self,
        width: float = 1.0,
        rates: Rates = ((1,),) * 4,
        norm: Norm = "batch",
        frozen_stages: int = 0,
    ) -> None:
        """Build the layers."""
        super().__init__()
        whole = mobilenet_v2(width_mult=width, norm_layer=norm_layer(norm))
        self.features = whole.features[: _STAGES[-1][1]]
        self.out_channels = [self.features[end - 1].out_channels for _, end in _STAGES]
        self.init_stages(rates, frozen_stages)

    def stem_modules(self) -> list[nn.Module]:
        """Return the first convolution and the first block."""
        return [*self.features[: _STEM[1]]]

    def stages(self) -> list[list[nn.Module]]:
        """Return the blocks of each stage."""
        return [[*self.features[start:end]] for start, end in _STAGES]

    def stem(self, x: Tensor) -> Tensor:
        """Compute the input of the first stage."""
        for module in self.stem_modules():
            x = module(x)
        return x

    def stem_receptive_field(self) -> tuple[int, int]:
        """Return the side of the stem's receptive field and its stride, px."""
        return 3 + 2 * 2, 2

    def load(self, weights: str) -> None:
        """Load weights into a network of full width.

        weights: a torchvision name, or the path of a state dict, whose `classifier.*` is ignored.
        Raises ValueError as `load_weights`, and FileNotFoundError as `read_weights`.
        """
        load_weights(self, weights, read_weights(weights, "mobilenet_v2"), "MobileNetV2")
