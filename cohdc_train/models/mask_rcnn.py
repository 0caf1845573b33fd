"""HDC Mask R-CNN with a CQE head: the parts, and the losses that train them (paper 2.1).

Torchvision's detection parts wherever they fit, under torchvision's names, so that its Mask R-CNN
state dicts load.
"""

from collections import OrderedDict
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads
from torchvision.models.detection.roi_heads import RoIHeads, fastrcnn_loss
from torchvision.ops import FeaturePyramidNetwork, MultiScaleRoIAlign
from torchvision.ops.feature_pyramid_network import LastLevelMaxPool

from cohdc_train.models.backbone import MEAN, STD, Norm
from cohdc_train.models.cqe_head import CQEHead, Fusion, cqe_loss
from cohdc_train.models.cqe_targets import Goal, band_of, cqe_targets
from cohdc_train.models.gt_masks import TrueMasks
from cohdc_train.models.mask_head import MaskSize, mask_loss, mask_predictor
from cohdc_train.models.mobilenet_v1 import MobileNetV1
from cohdc_train.models.mobilenet_v2 import MobileNetV2
from cohdc_train.models.resnet import Depth, HDCResNet
from cohdc_train.models.rpn import build_rpn, in_crowd

Target = dict[str, Any]
STRIDES = (4, 8, 16, 32)  # of the backbone's four stages


@dataclass(frozen=True)
class NetworkConfig:
    """Everything that shapes the network; the number of classes comes from the data.

    Attributes:
        backbone: "resnet", "mobilenet_v1" or "mobilenet_v2"; only the first has depths.
        depth: ResNet of 18, 34, 50 or 101 layers.
        width: channels of the backbone as a share of ResNet's.
        rates: dilation patterns of the four stages.
        weights: torchvision name or local path of ImageNet weights for the backbone; None trains
            from scratch.
        norm: of the backbone, and "batch" of the pyramid too: "batch" trains BatchNorm, "frozen"
            keeps the statistics of the initial weights, "auto" is "frozen" with initial weights and
            "batch" without.
        head_norm: "batch" trains BatchNorm in the pyramid and the mask head whatever the backbone
            has; exported, it costs nothing.
        frozen_stages: how many of the stem and the four stages are not trained; None is 2 with
            initial weights, as in torchvision, and 0 without.
        canvas: (height, width) in px every image is fitted into.
        finest_stride: of the pyramid: 4, or 8 without the level that costs most and sees the
            smallest objects.
        anchor_scales: side of the anchors in px, one per pyramid level from the finest; one more
            adds the pool level.
        fpn_channels: width of the pyramid, and of the RPN and mask heads.
        fc: width of the box and CQE heads' fully connected layers.
        cqe: how the CQE head joins feature and mask ("concat", "multiply", "add"); "off" leaves the
            head out, and quality is then 1.
        cqe_target: what the CQE head regresses: mask IoU ("iou"), (1 + CIoU) / 2 ("ciou", the
            paper's S_iou), Boundary IoU ("boundary_iou"), or the smaller of it and mask IoU
            ("min").
        mask_size: side of the predicted masks, cells: 28, or 56 by one more deconvolution.
        mask_cut: what a mask's 0.5 stands for at inference: as likely as not ("half"), or the cut
            of the greatest expected IoU by CQE's estimate of it ("quality",
            `inference.cut_by_quality`).
        proposals: proposals kept per image in training and at inference.
        rois: proposals per image that train the box head, a quarter of them positive.
        detections: rows of the padded output.
        score_threshold: detections at or below it are dropped.
        nms_iou: overlap from which the weaker of two detections of a class is dropped.
    """

    backbone: Literal["resnet", "mobilenet_v1", "mobilenet_v2"] = "resnet"
    depth: Depth = 50
    width: float = 1.0
    rates: tuple[tuple[int, ...], ...] = ((1, 2, 3), (1, 2, 3), (1, 2, 3), (1, 2, 3))
    weights: str | None = None
    norm: Norm | Literal["auto"] = "auto"
    head_norm: Literal["none", "batch"] = "none"
    frozen_stages: int | None = None
    canvas: tuple[int, int] = (800, 1024)
    finest_stride: Literal[4, 8] = 4
    anchor_scales: tuple[int, ...] = (32, 64, 128, 256)
    fpn_channels: int = 256
    fc: int = 1024
    cqe: Fusion | Literal["off"] = "concat"
    cqe_target: Goal = "iou"
    mask_size: MaskSize = 28
    mask_cut: Literal["half", "quality"] = "half"
    proposals: tuple[int, int] = (1000, 300)
    rois: int = 256
    detections: int = 100
    score_threshold: float = 0.05
    nms_iou: float = 0.5

    def __post_init__(self) -> None:
        levels, scales = len(self.roi_strides()), len(self.anchor_scales)
        if scales not in (levels, levels + 1):
            raise ValueError(
                f"anchor_scales {self.anchor_scales}: {scales} scales for {levels} or {levels + 1} levels"
            )
        if self.frozen_stages is not None and not 0 <= self.frozen_stages <= 5:
            raise ValueError(
                f"frozen_stages {self.frozen_stages}: a ResNet has a stem and 4 stages"
            )
        if self.mask_cut == "quality" and (self.cqe == "off" or self.cqe_target != "iou"):
            raise ValueError("mask_cut quality needs a CQE head that estimates the mask's IoU")
        if self.weights is not None and self.width != 1.0:
            raise ValueError(
                f"weights {self.weights} are of full width, the backbone of width {self.width}"
            )

    def resolved(self, pretrained: bool) -> "NetworkConfig":
        """Return a copy in which norm and frozen_stages are decided.

        pretrained: whether training starts from trained weights of the backbone, of this config or
        elsewhere.
        """
        norm: Norm = ("frozen" if pretrained else "batch") if self.norm == "auto" else self.norm
        frozen = (2 if pretrained else 0) if self.frozen_stages is None else self.frozen_stages
        return replace(self, norm=norm, frozen_stages=frozen)

    def roi_strides(self) -> list[int]:
        """Strides of the pyramid's levels, without the pool level."""
        return [stride for stride in STRIDES if stride >= self.finest_stride]

    def roi_levels(self) -> list[str]:
        """Names of those levels."""
        return [str(STRIDES.index(stride)) for stride in self.roi_strides()]


class Backbone(nn.Module):
    """HDC stages and feature pyramid, under the names that torchvision's BackboneWithFPN uses."""

    def __init__(self, config: NetworkConfig) -> None:
        """config: resolved, of MaskRCNN."""
        super().__init__()
        body_norm: Norm = "frozen" if config.norm == "frozen" else "batch"
        shape = (config.width, config.rates, body_norm, config.frozen_stages or 0)
        self.body: HDCResNet | MobileNetV1 | MobileNetV2
        if config.backbone == "resnet":
            self.body = HDCResNet(config.depth, *shape)
        else:
            self.body = (MobileNetV1 if config.backbone == "mobilenet_v1" else MobileNetV2)(*shape)
        self.levels = config.roi_levels()
        if config.weights is not None:
            self.body.load(config.weights)
        pool = LastLevelMaxPool() if len(config.anchor_scales) > len(self.levels) else None
        norm = nn.BatchNorm2d if "batch" in (config.norm, config.head_norm) else None
        self.fpn = FeaturePyramidNetwork(
            self.body.out_channels[-len(self.levels) :], config.fpn_channels, pool, norm
        )

    def forward(self, x: Tensor) -> "OrderedDict[str, Tensor]":
        """x: [B, 3, H, W] normalised. Returns the pyramid: "0" at stride 4 to "3" at 32, perhaps
        "pool" at 64.
        """
        stages = self.body(x)
        features: OrderedDict[str, Tensor] = self.fpn(
            OrderedDict((name, stages[name]) for name in self.levels)
        )
        return features


class MaskRCNN(nn.Module):
    """The network. `losses` trains it; `cohdc_train.models.inference` runs it.

    Args:
        num_classes: classes without background.
        config: its shape.

    Raises:
        ValueError: the rates leave holes, or the weights do not fit the backbone.
        FileNotFoundError: the weights are neither a file nor a published name.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, num_classes: int, config: NetworkConfig) -> None:
        super().__init__()
        config = config.resolved(pretrained=config.weights is not None)
        self.config = config
        self.num_classes = num_classes
        channels = config.fpn_channels
        self.backbone = Backbone(config)
        self.rpn = build_rpn(channels, config.anchor_scales, config.finest_stride, config.proposals)
        self.roi_heads = _build_roi_heads(config, num_classes)
        self.cqe = None
        if config.cqe != "off":
            self.cqe = CQEHead(channels, num_classes, channels, config.fc, fusion=config.cqe)
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(STD).view(3, 1, 1), persistent=False)

    def features(self, images: Tensor) -> "OrderedDict[str, Tensor]":
        """images: float [B, 3, H, W] in 0..1. Returns the feature pyramid; sides are padded to
        multiples of 32 px.
        """
        height, width = images.shape[-2:]
        x = (images - self.mean) / self.std
        pyramid: OrderedDict[str, Tensor] = self.backbone(
            F.pad(x, (0, -width % 32, 0, -height % 32))
        )
        return pyramid

    def losses(self, images: Tensor, targets: list[Target]) -> dict[str, Tensor]:
        """The scalar losses of one batch; their sum trains the network.

        images: float [B, 3, H, W] in 0..1 on the canvas; targets: per image `boxes` [n, 4] xyxy px,
        `labels` [n] from 1, `masks` [n, H, W] of 0 and 1 (or mini-masks [n, h, w] with their
        `frames`, see TrueMasks), and `ignore` [k, 4], the crowd's boxes. n may be 0. `size`:
        (height, width) of what is no padding, the canvas' when missing.
        """
        features = self.features(images)
        sizes = [(images.shape[-2], images.shape[-1])] * len(targets)
        pyramid, wanted = list(features.values()), self.config.proposals[0]
        proposals, loss_objectness, loss_proposal = self.rpn(sizes[0], pyramid, targets, wanted)
        heads = self.roi_heads
        sampled, matched, labels, regression = self._sample(proposals, targets)
        box_features = heads.box_head(heads.box_roi_pool(features, sampled, sizes))
        logits, deltas = heads.box_predictor(box_features)
        loss_class, loss_box = fastrcnn_loss(logits.float(), deltas.float(), labels, regression)
        return {
            "objectness": loss_objectness,
            "rpn_box": loss_proposal,
            "class": loss_class,
            "box": loss_box,
            **self._mask_losses(features, sizes, sampled, matched, labels, targets),
        }

    def _sample(
        self, proposals: list[Tensor], targets: list[Target]
    ) -> tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]:
        """Proposals that train the heads: their boxes, matched object, label and box deltas, per
        image.
        """
        heads = self.roi_heads
        gt_boxes = [t["boxes"].to(proposals[0].dtype) for t in targets]
        proposals = heads.add_gt_proposals(proposals, gt_boxes)
        matched, labels = heads.assign_targets_to_proposals(
            proposals, gt_boxes, [t["labels"] for t in targets]
        )
        for label, proposal, target in zip(labels, proposals, targets, strict=True):
            label[(label == 0) & in_crowd(proposal, target)] = -1
        chosen = heads.subsample(labels)
        proposals = [p[c] for p, c in zip(proposals, chosen, strict=True)]
        labels = [label[c] for label, c in zip(labels, chosen, strict=True)]
        matched = [m[c] for m, c in zip(matched, chosen, strict=True)]
        truths = [
            boxes[m] if len(boxes) else boxes.new_zeros((len(m), 4))
            for boxes, m in zip(gt_boxes, matched, strict=True)
        ]
        return proposals, matched, labels, list(heads.box_coder.encode(truths, proposals))

    def _mask_losses(
        self,
        features: "OrderedDict[str, Tensor]",
        sizes: list[tuple[int, int]],
        sampled: list[Tensor],
        matched: list[Tensor],
        labels: list[Tensor],
        targets: list[Target],
    ) -> dict[str, Tensor]:
        """Mask and CQE losses over the positive proposals."""
        heads = self.roi_heads
        positive = [torch.nonzero(label > 0)[:, 0] for label in labels]
        boxes = [b[p] for b, p in zip(sampled, positive, strict=True)]
        matches = [m[p] for m, p in zip(matched, positive, strict=True)]
        pooled = heads.mask_roi_pool(features, boxes, sizes)
        logits = heads.mask_predictor(heads.mask_head(pooled)).float()
        # The losses turn masks into float32: only those of the sampled objects, however many the
        # image has.
        keys = [key for key in ("masks", "frames") if key in targets[0]]
        with torch.autocast(logits.device.type, enabled=False):
            # Autocast to bfloat16 on a CPU cannot concatenate the float16 of mini-masks.
            joined: Target = {key: torch.cat([t[key] for t in targets]) for key in keys}
        before = accumulate((len(t["boxes"]) for t in targets[:-1]), initial=0)
        every = torch.cat([m + n for m, n in zip(matches, before, strict=True)])
        used, objects = torch.unique(every, return_inverse=True)
        truth, where = TrueMasks.of(joined, used), torch.cat(boxes).float()
        classes = torch.cat([label[p] for label, p in zip(labels, positive, strict=True)])
        chosen_logits = logits[torch.arange(len(classes), device=classes.device), classes]
        losses = {"mask": mask_loss(chosen_logits, truth, where, objects)}
        if self.cqe is None:
            return losses
        probabilities = chosen_logits.sigmoid()
        quality = self.cqe(pooled, probabilities.to(pooled.dtype))
        bands = [
            band_of(*t.get("size", sizes[0]))
            for t, b in zip(targets, boxes, strict=True)
            for _ in range(len(b))
        ]
        goals = cqe_targets(probabilities, where, truth, objects, self.config.cqe_target, bands)
        losses["cqe"] = cqe_loss(quality, classes - 1, goals)
        return losses


def _build_roi_heads(config: NetworkConfig, num_classes: int) -> RoIHeads:
    channels = config.fpn_channels
    return RoIHeads(
        box_roi_pool=MultiScaleRoIAlign(config.roi_levels(), 7, 2),
        box_head=TwoMLPHead(channels * 49, config.fc),
        box_predictor=FastRCNNPredictor(config.fc, num_classes + 1),
        fg_iou_thresh=0.5,
        bg_iou_thresh=0.5,
        batch_size_per_image=config.rois,
        positive_fraction=0.25,
        bbox_reg_weights=None,
        score_thresh=config.score_threshold,
        nms_thresh=config.nms_iou,
        detections_per_img=config.detections,
        mask_roi_pool=MultiScaleRoIAlign(config.roi_levels(), 14, 2),
        mask_head=MaskRCNNHeads(
            channels, (channels,) * 4, 1, nn.BatchNorm2d if config.head_norm == "batch" else None
        ),
        mask_predictor=mask_predictor(channels, num_classes + 1, config.mask_size),
    )
