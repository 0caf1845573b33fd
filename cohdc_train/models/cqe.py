"""Contour quality evaluation (paper 2.1.2): a head that regresses how well a predicted mask covers its object.

The paper feeds the true contour to the head; at inference there is none, so the truth enters through the target only.
"""

import math
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 torch's own name for it
from torch import Tensor, nn
from torchvision.ops import roi_align

Fusion = Literal["concat", "multiply", "add"]
Goal = Literal["iou", "ciou"]


class CQEHead(nn.Module):
    """Four 3x3 convolutions and three fully connected layers (paper 2.1.2) over an RoI feature and a predicted mask.

    How the two meet:
    - "concat": the mask, max-pooled to the feature's size, is one more channel (Mask Scoring R-CNN);
    - "multiply": the feature is multiplied by the max-pooled mask (paper, Fig. 5, first structure);
    - "add": the mask, not pooled, is added to the feature enlarged to the mask's size (Fig. 5, second structure; the
      paper's larger RoI feature is the same one, interpolated), and the first convolution halves it again.

    Args:
        in_channels: channels of the RoI feature.
        num_classes: classes without background; one quality is regressed per class.
        channels: width of the convolutions (paper: 256).
        fc: width of the first two fully connected layers (paper: 1024).
        roi_size: side of the RoI feature, cells.
        fusion: see above.
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
        super().__init__()
        self.fusion = fusion
        widths = [in_channels + (fusion == "concat"), channels, channels, channels, channels]
        strides = [2 if fusion == "add" else 1, 1, 1, 2]
        layers: list[nn.Module] = []
        for i in range(4):
            layers += [nn.Conv2d(widths[i], widths[i + 1], 3, stride=strides[i], padding=1), nn.ReLU(inplace=True)]
        side = (roi_size + 1) // 2
        self.convs = nn.Sequential(*layers)
        self.fcs = nn.Sequential(
            nn.Linear(channels * side * side, fc), nn.ReLU(inplace=True), nn.Linear(fc, fc), nn.ReLU(inplace=True)
        )
        self.quality = nn.Linear(fc, num_classes)
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module.bias is not None:
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
                nn.init.zeros_(module.bias)

    def forward(self, features: Tensor, masks: Tensor) -> Tensor:
        """features: [K, C, 14, 14]; masks: [K, 28, 28] probabilities of one class. Returns [K, num_classes], linear."""
        quality: Tensor = self.quality(self.fcs(self.convs(self.fuse(features, masks)).flatten(1)))
        return quality

    def fuse(self, features: Tensor, masks: Tensor) -> Tensor:
        """What the convolutions see: [K, C + 1, 14, 14], [K, C, 14, 14] or [K, C, 28, 28], as `fusion` says."""
        scale = masks.shape[-1] // features.shape[-1]
        if self.fusion == "add":
            return F.interpolate(features, scale_factor=float(scale), mode="bilinear") + masks[:, None]
        pooled = F.max_pool2d(masks[:, None], kernel_size=scale)
        return features * pooled if self.fusion == "multiply" else torch.cat([features, pooled], dim=1)


@torch.no_grad()
def cqe_targets(masks: Tensor, boxes: Tensor, gt_masks: Tensor, matched: Tensor, kind: Goal = "iou") -> Tensor:
    """How well each predicted mask covers its whole ground-truth mask, also what of it lies outside the box.

    masks: [K, M, M] probabilities; boxes: [K, 4] xyxy, px; gt_masks: [G, H, W] of 0 and 1; matched: [K] index into G.
    Returns [K] in 0..1: the IoU for "iou"; for "ciou" (1 + CIoU) / 2 clipped, the paper's S_iou, and 0 where the masks
    do not meet. Counted on the box's M x M grid, in whose cells the whole object's area is expressed too.
    """
    side = masks.shape[-1]
    truth = gt_masks.to(boxes.dtype)
    rois = torch.cat([matched[:, None].to(boxes.dtype), boxes], dim=1)
    covered = roi_align(truth[:, None], rois, (side, side), sampling_ratio=2, aligned=True)[:, 0]
    inside = (covered >= 0.5).to(boxes.dtype)
    predicted = (masks > 0.5).to(boxes.dtype)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    whole = truth.sum(dim=(1, 2))[matched] * side**2 / area.clamp(min=1.0)
    intersection = (predicted * inside).sum(dim=(1, 2))
    union = predicted.sum(dim=(1, 2)) + whole - intersection
    iou: Tensor = (intersection / union.clamp(min=1e-6)).clamp(0.0, 1.0)
    if kind == "iou" or not len(masks):
        return iou
    cell = (boxes[:, 2:] - boxes[:, :2]) / side
    shape = Shape.of(predicted).placed(cell, boxes[:, :2])
    return torch.where(iou > 0, 0.5 * (1 + ciou(iou, shape, Shape.of(truth).chosen(matched))).clamp(0.0, 2.0), 0.0)


class Shape(NamedTuple):
    """centre: [K, 2] centroid x, y; low, high: [K, 2] the corners of the tight box."""

    centre: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, masks: Tensor) -> "Shape":
        """The shapes of masks [K, H, W] of 0 and 1, in cells; an empty mask's is all zeros."""
        centre, low, high = [], [], []
        for line in (masks.sum(dim=1), masks.sum(dim=2)):  # cells per column, per row
            place = torch.arange(line.shape[1], device=line.device, dtype=line.dtype)
            centre.append((line * (place + 0.5)).sum(dim=1) / line.sum(dim=1).clamp(min=1))
            hit = line > 0
            low.append(torch.where(hit, place, float(line.shape[1])).amin(dim=1) * hit.any(dim=1))
            high.append(torch.where(hit, place + 1, 0.0).amax(dim=1))
        return cls(torch.stack(centre, 1), torch.stack(low, 1), torch.stack(high, 1))

    def placed(self, cell: Tensor, origin: Tensor) -> "Shape":
        """In px: cell, origin: [K, 2] a cell's width and height and the grid's corner."""
        return Shape(*(part * cell + origin for part in self))

    def chosen(self, index: Tensor) -> "Shape":
        """The shapes at `index` [N]."""
        return Shape(*(part[index] for part in self))


def ciou(iou: Tensor, a: Shape, b: Shape) -> Tensor:
    """Complete IoU of masks: IoU - rho^2 / c^2 - alpha v (Zheng et al. 2020, with the masks' centroids).

    rho: distance of the centroids; c: diagonal of the smallest box around both; v: how far the aspect ratios of their
    tight boxes differ, alpha = v / (1 - IoU + v). iou: [K]. Returns [K], above -1.5 and at most 1.
    """
    distance = (a.centre - b.centre).square().sum(dim=1)
    around = (torch.maximum(a.high, b.high) - torch.minimum(a.low, b.low)).square().sum(dim=1)
    angles = [torch.atan2(*(s.high - s.low).unbind(dim=1)) for s in (a, b)]
    v = 4 / math.pi**2 * (angles[0] - angles[1]).square()
    return iou - distance / around.clamp(min=1e-6) - v * v / (1 - iou + v).clamp(min=1e-6)


def cqe_loss(quality: Tensor, labels: Tensor, targets: Tensor) -> Tensor:
    """Half the mean squared error over RoIs with a target above 0.

    quality: [K, num_classes]; labels: [K] 0-based class; targets: [K]. Without such a RoI the loss is a zero that
    still reaches every parameter, so that no rank of a distributed run waits for another.
    """
    valid = targets > 0
    if not bool(valid.any()):
        return quality.sum() * 0
    predicted = quality.gather(1, labels[:, None])[:, 0]
    return 0.5 * F.mse_loss(predicted[valid].float(), targets[valid].float())
