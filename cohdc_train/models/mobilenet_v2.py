"""torchvision's MobileNetV2 as a backbone (Sandler et al. 2018), tensor for tensor."""

from torch import Tensor, nn
from torchvision.models import mobilenet_v2

from cohdc_train.models.backbone import (
    Norm,
    Rates,
    StagedBackbone,
    load_weights,
    norm_layer,
    read_weights,
)

_PARTS = (
    (0, 2),
    (2, 4),
    (4, 7),
    (7, 14),
    (14, 18),
)  # modules of the stem and the stages of strides 4, 8, 16, 32


class MobileNetV2(StagedBackbone):
    """MobileNetV2 without its last convolution; the depthwise ones may follow a dilation pattern
    inside each stage.

    Args:
        width: channels as a share of the network's, rounded to multiples of 8.
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
        norm: Norm = "batch",
        frozen_stages: int = 0,
    ) -> None:
        super().__init__()
        whole = mobilenet_v2(width_mult=width, norm_layer=norm_layer(norm))
        self.features = whole.features[: _PARTS[-1][1]]
        self.out_channels = [self.features[end - 1].out_channels for _, end in _PARTS[1:]]
        self.finish(rates, frozen_stages)

    def parts(self) -> list[list[nn.Module]]:
        return [[*self.features[start:end]] for start, end in _PARTS]

    def stem(self, x: Tensor) -> Tensor:
        for module in self.parts()[0]:
            x = module(x)
        return x

    def field_of_stem(self) -> tuple[int, int]:
        return 3 + 2 * 2, 2

    def load(self, weights: str) -> None:
        """Fill a full-width network: a torchvision name or the path of a state dict (`classifier.*`
        is passed over).

        Raises ValueError as `load_weights`, FileNotFoundError as `read_weights`.
        """
        load_weights(self, weights, read_weights(weights, "mobilenet_v2"), "MobileNetV2")
