"""Torchvision's region proposal network, exact in mixed precision, aware of crowds, and batched."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.rpn import RegionProposalNetwork, RPNHead

from cohdc_train.models.ops import nms_keep

_NMS_IOU = 0.7
_MAX_LOG_GROWTH = 4.135  # a box grows at most 1000 / 16 times
_MIN_SIDE = 1e-2  # px on the canvas; smaller boxes hold nothing
# Share of a background anchor or proposal inside a crowd box from which it is no negative.
_CROWD_OVERLAP = 0.5


class PreciseRPNHead(RPNHead):  # type: ignore[misc]  # torchvision is not typed
    """Torchvision's RPN head with float32 outputs, in mixed precision too.

    Torchvision gives its proposals the type of the deltas: in bfloat16 they, and the true boxes
    that join them, would lie on a grid of 2 px at the 300th pixel.
    """

    def forward(self, x: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Compute objectness and box deltas of each level, float32."""
        logits, deltas = super().forward(x)
        return [one.float() for one in logits], [one.float() for one in deltas]


class CrowdAwareRPN(RegionProposalNetwork):  # type: ignore[misc]
    """Torchvision's RPN, for which a background anchor inside a crowd box is no negative.

    Anchors lie at the pyramid's strides. Torchvision divides the image by the map instead, which is
    another number where the image was padded for it.
    """

    def __init__(self, finest_stride: int, *args: Any) -> None:
        """Build torchvision's RPN from `args`; finest_stride: of the finest level, px."""
        super().__init__(*args)
        self.finest_stride = finest_stride

    def forward(
        self,
        canvas: tuple[int, int],
        features: list[Tensor],
        targets: Sequence[Mapping[str, Any]],
        max_proposals: int,
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Propose boxes for training the heads, and compute the losses of objectness and boxes.

        Args:
            canvas: (height, width) px of the images.
            features: of the pyramid, finest first.
            targets: as `MaskRCNN.losses` takes them.
            max_proposals: per image.

        Returns:
            Proposals [n, 4] of each image, canvas px, and the two losses.
        """
        objectness, deltas = self.head(features)
        height, width = canvas
        limit = objectness[0].new_tensor([[[width, height, width, height]]])
        with torch.no_grad():
            proposals = self.propose(objectness, deltas, max_proposals, limit)
            counts = is_nonempty(proposals).sum(dim=1).tolist()
        anchors = [
            torch.cat([self.anchors(level, logits) for level, logits in enumerate(objectness)])
        ] * len(targets)
        labels, boxes = self.assign_targets_to_anchors(anchors, targets)
        box_targets = self.box_coder.encode(boxes, anchors)
        logits, shifts = (
            torch.cat([_flatten(one, values) for one in maps], dim=1).flatten(0, 1)
            for maps, values in ((objectness, 1), (deltas, 4))
        )
        losses: tuple[Tensor, Tensor] = self.compute_loss(logits, shifts, labels, box_targets)
        return [boxes[:count] for boxes, count in zip(proposals, counts, strict=True)], *losses

    def propose(
        self, objectness: list[Tensor], deltas: list[Tensor], max_proposals: int, limit: Tensor
    ) -> Tensor:
        """Select the best proposals of each image.

        Args:
            objectness: the head's maps, one per level.
            deltas: the head's maps, one per level.
            max_proposals: per image.
            limit: [B, 1, 4], or [1, 1, 4] for all images, what boxes are clipped to.

        Returns:
            [B, R, 4] xyxy, canvas px, R at most `max_proposals`; rows without a proposal are zeros,
            and last.
        """
        boxes, scores = [], []
        for level, (logits, delta) in enumerate(zip(objectness, deltas, strict=True)):
            score, index = (
                _flatten(logits, 1)
                .squeeze(2)
                .topk(min(2 * max_proposals, logits[0].numel()), dim=1)
            )
            delta = _flatten(delta, 4).gather(1, index[:, :, None].expand(-1, -1, 4))
            box = decode(
                delta.float(), self.anchors(level, logits, index), (1.0, 1.0, 1.0, 1.0), limit
            )
            score = torch.where(is_nonempty(box), score.float().sigmoid(), 0.0)
            score = torch.where(nms_keep(box, score, _NMS_IOU, 0.0), score, 0.0)
            boxes.append(box)
            scores.append(score)
        score, index = torch.cat(scores, dim=1).topk(
            min(max_proposals, sum(s.shape[1] for s in scores)), dim=1
        )
        box = torch.cat(boxes, dim=1).gather(1, index[:, :, None].expand(-1, -1, 4))
        return box * (score > 0)[:, :, None]

    def anchors(self, level: int, logits: Tensor, index: Tensor | None = None) -> Tensor:
        """Return [..., 4] a level's anchors at flat positions, or all of them.

        Positions count shapes first, then columns, then rows.
        """
        cell = self.anchor_generator.cell_anchors[level].to(logits.device)
        index = torch.arange(logits[0].numel(), device=logits.device) if index is None else index
        stride, shapes, width = self.finest_stride * 2**level, cell.shape[0], logits.shape[3]
        x, y = (index // shapes) % width * stride, index // (shapes * width) * stride
        anchors: Tensor = cell[index % shapes] + torch.stack([x, y, x, y], dim=-1)
        return anchors

    def assign_targets_to_anchors(
        self, anchors: list[Tensor], targets: Sequence[Mapping[str, Any]]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Assign objects to anchors; background anchors inside crowds are ignored."""
        labels, matched = super().assign_targets_to_anchors(anchors, targets)
        for label, anchor, target in zip(labels, anchors, targets, strict=True):
            label[(label == 0) & in_crowd(anchor, target)] = -1
        return labels, matched


def build_rpn(
    channels: int, scales: Sequence[int], finest_stride: int, proposals: tuple[int, int]
) -> CrowdAwareRPN:
    """Build the region proposal network.

    Args:
        channels: of the pyramid.
        scales: side of the anchors, px, one per level, each in three aspects.
        finest_stride: of the finest level, px.
        proposals: kept per image in training and at inference.
    """
    anchors = AnchorGenerator(tuple((scale,) for scale in scales), ((0.5, 1.0, 2.0),) * len(scales))
    head = PreciseRPNHead(channels, anchors.num_anchors_per_location()[0])
    top = {"training": proposals[0], "testing": proposals[1]}
    twice = {kind: 2 * n for kind, n in top.items()}
    return CrowdAwareRPN(finest_stride, anchors, head, 0.7, 0.3, 256, 0.5, twice, top, _NMS_IOU)


def decode(deltas: Tensor, boxes: Tensor, weights: tuple[float, ...], limit: Tensor) -> Tensor:
    """Apply box deltas to boxes and clip the result (R-CNN's parametrization).

    Args:
        deltas: [B, n, 4].
        boxes: [B, n, 4] xyxy, px.
        weights: of the four deltas.
        limit: [B, 1, 4] largest x, y, x, y.
    """
    size = boxes[:, :, 2:] - boxes[:, :, :2]
    center = boxes[:, :, :2] + 0.5 * size
    shift = deltas * deltas.new_tensor([1.0 / weight for weight in weights])
    center = center + shift[:, :, :2] * size
    growth = shift[:, :, 2:].clamp(max=_MAX_LOG_GROWTH)
    half = 0.5 * torch.exp(growth) * size
    corners = torch.cat([center - half, center + half], dim=2)
    return torch.minimum(corners.clamp(min=0.0), limit)


def is_nonempty(boxes: Tensor) -> Tensor:
    """Return [B, n] bool: both sides of the box are long enough to hold something."""
    return ((boxes[:, :, 2:] - boxes[:, :, :2]) >= _MIN_SIDE).all(dim=2)


def _flatten(maps: Tensor, values: int) -> Tensor:
    """Reorder [B, A * values, H, W] to [B, H * W * A, values], as torchvision's anchors."""
    batch, channels, height, width = maps.shape
    return (
        maps.reshape(batch, channels // values, values, height, width)
        .permute(0, 3, 4, 1, 2)
        .reshape(batch, height * width * (channels // values), values)
    )


def in_crowd(boxes: Tensor, target: Mapping[str, Any]) -> Tensor:
    """Return [n] bool: more than half of the box lies inside one of the target's `ignore` boxes."""
    crowd = target.get("ignore")
    if crowd is None or not len(crowd):
        return torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    corner = torch.minimum(boxes[:, None, 2:], crowd[None, :, 2:]) - torch.maximum(
        boxes[:, None, :2], crowd[None, :, :2]
    )
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1).clamp(min=1e-6)
    share: Tensor = corner.clamp(min=0).prod(dim=2) / area[:, None]
    return (share > _CROWD_OVERLAP).any(dim=1)
