"""Proposals that train the heads, and the mask and CQE losses over them."""

from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchvision.models.detection.roi_heads import RoIHeads

from cohdc_train.models.cqe_head import CQEHead, cqe_loss
from cohdc_train.models.cqe_targets import QualityTarget, boundary_band_px, cqe_targets
from cohdc_train.models.gt_masks import GroundTruthMasks
from cohdc_train.models.mask_head import mask_loss
from cohdc_train.models.rpn import in_crowd

Target = dict[str, Any]


class RoISamples(NamedTuple):
    """Proposals that train the heads, one tensor per image.

    Attributes:
        boxes: [N, 4] xyxy, canvas px.
        objects: [N] index of the object that a proposal is matched with.
        labels: [N] class from 1, 0 for background.
        deltas: [N, 4] from the proposal to its object's box, as the box head regresses them.
    """

    boxes: list[Tensor]
    objects: list[Tensor]
    labels: list[Tensor]
    deltas: list[Tensor]

    def positive(self) -> "RoISamples":
        """Return the samples that are matched with an object."""
        chosen = [torch.nonzero(label > 0)[:, 0] for label in self.labels]
        parts = ([v[c] for v, c in zip(values, chosen, strict=True)] for values in self)
        return RoISamples(*parts)


def sample_proposals(heads: RoIHeads, proposals: list[Tensor], targets: list[Target]) -> RoISamples:
    """Match proposals with objects and sample those that train the heads.

    A background proposal inside a crowd box is neither positive nor negative.

    Args:
        heads: torchvision's heads, for matching, sampling and box coding.
        proposals: [N, 4] xyxy of each image, canvas px.
        targets: as `MaskRCNN.losses` takes them.
    """
    gt_boxes = [target["boxes"].to(proposals[0].dtype) for target in targets]
    proposals = heads.add_gt_proposals(proposals, gt_boxes)
    matched, labels = heads.assign_targets_to_proposals(
        proposals, gt_boxes, [target["labels"] for target in targets]
    )
    for label, proposal, target in zip(labels, proposals, targets, strict=True):
        label[(label == 0) & in_crowd(proposal, target)] = -1
    chosen = heads.subsample(labels)
    boxes = [p[c] for p, c in zip(proposals, chosen, strict=True)]
    labels = [label[c] for label, c in zip(labels, chosen, strict=True)]
    matched = [m[c] for m, c in zip(matched, chosen, strict=True)]
    matched_boxes = [
        own[m] if len(own) else own.new_zeros((len(m), 4))
        for own, m in zip(gt_boxes, matched, strict=True)
    ]
    deltas = list(heads.box_coder.encode(matched_boxes, boxes))
    return RoISamples(boxes, matched, labels, deltas)


def mask_losses(
    logits: Tensor,
    features: Tensor,
    samples: RoISamples,
    targets: list[Target],
    canvas: tuple[int, int],
    cqe: CQEHead | None,
    cqe_target: QualityTarget,
) -> dict[str, Tensor]:
    """Compute the mask loss, and with a CQE head the loss of its quality, over positive proposals.

    Args:
        logits: float32 [K, C + 1, M, M] of the mask head.
        features: [K, channels, 14, 14] that the mask head has seen.
        samples: the K positive proposals.
        targets: as `MaskRCNN.losses` takes them.
        canvas: (height, width) px of the batch's images.
        cqe: the CQE head; None without one.
        cqe_target: what the CQE head regresses.
    """
    truth, objects = _sampled_masks(samples, targets)
    boxes = torch.cat(samples.boxes).float()
    classes = torch.cat(samples.labels)
    class_logits = logits[torch.arange(len(classes), device=classes.device), classes]
    losses = {"mask": mask_loss(class_logits, truth, boxes, objects)}
    if cqe is None:
        return losses
    masks = class_logits.sigmoid()
    quality = cqe(features, masks.to(features.dtype))
    bands: list[int] = []
    for target, own in zip(targets, samples.boxes, strict=True):
        bands += [boundary_band_px(*target.get("size", canvas))] * len(own)
    wanted = cqe_targets(masks, boxes, truth, objects, cqe_target, bands)
    losses["cqe"] = cqe_loss(quality, classes - 1, wanted)
    return losses


def _sampled_masks(samples: RoISamples, targets: list[Target]) -> tuple[GroundTruthMasks, Tensor]:
    """Return the masks of the sampled objects of all images, and [K] each sample's index in them.

    The losses turn masks into float32: only those that are used, however many an image has.
    """
    keys = [key for key in ("masks", "frames") if key in targets[0]]
    with torch.autocast(samples.boxes[0].device.type, enabled=False):
        # Autocast to bfloat16 on a CPU cannot concatenate the float16 of mini-masks.
        joined: Target = {key: torch.cat([target[key] for target in targets]) for key in keys}
    first = accumulate((len(target["boxes"]) for target in targets[:-1]), initial=0)
    indices = torch.cat([own + n for own, n in zip(samples.objects, first, strict=True)])
    used, objects = torch.unique(indices, return_inverse=True)
    return GroundTruthMasks.from_target(joined, used), objects
