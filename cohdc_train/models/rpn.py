"""The region proposal network: torchvision's, exact in mixed precision, and blind to what crowds hide."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.rpn import RegionProposalNetwork, RPNHead

_CROWD_OVERLAP = 0.5  # share of a background anchor or proposal inside a crowd box from which it is not a negative


class PreciseRPNHead(RPNHead):  # type: ignore[misc]  # torchvision is not typed
    """Torchvision's RPN head, whose outputs are float32 also in mixed precision.

    Torchvision gives its proposals the type of the deltas: in bfloat16 they, and the true boxes that join them, would
    lie on a grid of 2 px at the 300th pixel.
    """

    def forward(self, x: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        logits, deltas = super().forward(x)
        return [one.float() for one in logits], [one.float() for one in deltas]


class PreciseAnchors(AnchorGenerator):  # type: ignore[misc]
    """Torchvision's anchors, float32 whatever the features are, for the same reason."""

    def set_cell_anchors(self, dtype: torch.dtype, device: torch.device) -> None:
        super().set_cell_anchors(torch.float32, device)


class CrowdAwareRPN(RegionProposalNetwork):  # type: ignore[misc]
    """Torchvision's RPN, for which a background anchor inside a crowd box is no negative."""

    def assign_targets_to_anchors(
        self, anchors: list[Tensor], targets: Sequence[Mapping[str, Any]]
    ) -> tuple[list[Tensor], list[Tensor]]:
        labels, matched = super().assign_targets_to_anchors(anchors, targets)
        for label, anchor, target in zip(labels, anchors, targets, strict=True):
            label[(label == 0) & in_crowd(anchor, target)] = -1
        return labels, matched


def build_rpn(channels: int, scales: Sequence[int], proposals: tuple[int, int]) -> CrowdAwareRPN:
    """channels: of the pyramid; scales: px, one a level, in three aspects; proposals: in training and at inference."""
    anchors = PreciseAnchors(tuple((scale,) for scale in scales), ((0.5, 1.0, 2.0),) * len(scales))
    head = PreciseRPNHead(channels, anchors.num_anchors_per_location()[0])
    top = {"training": proposals[0], "testing": proposals[1]}
    return CrowdAwareRPN(anchors, head, 0.7, 0.3, 256, 0.5, {k: 2 * n for k, n in top.items()}, top, 0.7)


def in_crowd(boxes: Tensor, target: Mapping[str, Any]) -> Tensor:
    """[n] bool: more than half of the box's area lies inside one of the target's `ignore` boxes."""
    crowd = target.get("ignore")
    if crowd is None or not len(crowd):
        return torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    corner = torch.minimum(boxes[:, None, 2:], crowd[None, :, 2:]) - torch.maximum(
        boxes[:, None, :2], crowd[None, :, :2]
    )
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1).clamp(min=1e-6)
    share: Tensor = corner.clamp(min=0).prod(dim=2) / area[:, None]
    return (share > _CROWD_OVERLAP).any(dim=1)
