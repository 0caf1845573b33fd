"""Contour quality evaluation (paper 2.1.2): a head that regresses the IoU of predicted masks.

The paper feeds the true contour to the head; at inference there is none, so the truth enters
through the target only.
"""

from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812 torch's own name for it
from torch import Tensor, nn

Fusion = Literal["concat", "multiply", "add"]


class CQEHead(nn.Module):
    """Head of four 3x3 convolutions and three fully connected layers over RoI feature and mask.

    `fusion` decides how the two are joined (paper 2.1.2):
    - "concat": the mask, max-pooled to the feature's size, is one more channel (Mask Scoring
      R-CNN);
    - "multiply": the feature is multiplied by the max-pooled mask (paper, Fig. 5, first structure);
    - "add": the mask is added to the feature enlarged to twice its size (Fig. 5, second structure;
      the paper's larger RoI feature is the same one, interpolated), and the first convolution
      halves it again. A 28 x 28 mask is not pooled, a larger one to 28 x 28.

    Args:
        in_channels: channels of the RoI feature.
        num_classes: classes without background; one quality is regressed per class.
        channels: width of the convolutions (paper: 256).
        fc: width of the first two fully connected layers (paper: 1024).
        roi_size: side of the RoI feature, cells.
        fusion: "concat", "multiply" or "add".
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        channels: int = 256,
        fc: int = 1024,
        roi_size: int = 14,
        fusion: Fusion = "concat",
    ) -> None:
        """Build the layers."""
        super().__init__()
        self.fusion = fusion
        widths = [in_channels + (fusion == "concat"), channels, channels, channels, channels]
        strides = [2 if fusion == "add" else 1, 1, 1, 2]
        layers: list[nn.Module] = []
        for i in range(4):
            layers += [
                nn.Conv2d(widths[i], widths[i + 1], 3, stride=strides[i], padding=1),
                nn.ReLU(inplace=True),
            ]
        side = (roi_size + 1) // 2
        self.convs = nn.Sequential(*layers)
        self.fcs = nn.Sequential(
            nn.Linear(channels * side * side, fc),
            nn.ReLU(inplace=True),
            nn.Linear(fc, fc),
            nn.ReLU(inplace=True),
        )
        self.quality = nn.Linear(fc, num_classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module.bias is not None:
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
                nn.init.zeros_(module.bias)

    def forward(self, features: Tensor, masks: Tensor) -> Tensor:
        """Predict the quality of masks.

        Args:
            features: [K, C, 14, 14].
            masks: [K, M, M] probabilities of one class, M a multiple of 28.

        Returns:
            [K, num_classes], linear.
        """
        quality: Tensor = self.quality(self.fcs(self.convs(self.fuse(features, masks)).flatten(1)))
        return quality

    def fuse(self, features: Tensor, masks: Tensor) -> Tensor:
        """Join feature and mask to the input of the convolutions.

        Returns [K, C + 1, 14, 14] for "concat", [K, C, 14, 14] for "multiply", [K, C, 28, 28] for
        "add".
        """
        scale = masks.shape[-1] // features.shape[-1]
        if self.fusion == "add":
            larger = F.interpolate(features, scale_factor=2.0, mode="bilinear")
            return larger + F.max_pool2d(masks[:, None], kernel_size=scale // 2)
        pooled = F.max_pool2d(masks[:, None], kernel_size=scale)
        return (
            features * pooled if self.fusion == "multiply" else torch.cat([features, pooled], dim=1)
        )


def cqe_loss(quality: Tensor, labels: Tensor, targets: Tensor) -> Tensor:
    """Compute half the mean squared error over RoIs with a target above 0.

    Without such a RoI the loss is a zero that still reaches every parameter, so that no rank of a
    distributed run waits for another.

    quality: [K, num_classes]; labels: [K] class from 0; targets: [K].
    """
    valid = targets > 0
    if not bool(valid.any()):
        return quality.sum() * 0
    predicted = quality.gather(1, labels[:, None])[:, 0]
    return 0.5 * F.mse_loss(predicted[valid].float(), targets[valid].float())
