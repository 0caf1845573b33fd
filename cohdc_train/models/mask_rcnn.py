"""HDC Mask R-CNN with a CQE head: the parts, and the losses that train them (paper 2.1).

Torchvision's detection parts wherever they fit, under torchvision's names, so that its Mask R-CNN
state dicts load.
"""

from collections import OrderedDict

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads
from torchvision.models.detection.roi_heads import RoIHeads, fastrcnn_loss
from torchvision.ops import FeaturePyramidNetwork, MultiScaleRoIAlign
from torchvision.ops.feature_pyramid_network import LastLevelMaxPool

from cohdc_train.models.backbone import MEAN, STD, Norm
from cohdc_train.models.config import NetworkConfig
from cohdc_train.models.cqe_head import CQEHead
from cohdc_train.models.mask_head import mask_predictor
from cohdc_train.models.mobilenet_v1 import MobileNetV1
from cohdc_train.models.mobilenet_v2 import MobileNetV2
from cohdc_train.models.resnet import HDCResNet
from cohdc_train.models.roi_losses import Target, mask_losses, sample_proposals
from cohdc_train.models.rpn import build_rpn


class BackboneWithFPN(nn.Module):
    """HDC stages and feature pyramid, under the names that torchvision's BackboneWithFPN uses."""

    def __init__(self, config: NetworkConfig) -> None:
        """Build the layers and load the backbone's weights, if the config names some.

        Args:
            config: with norm and frozen_stages decided, see `NetworkConfig.resolved`.
        """
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
        channels = self.body.out_channels[-len(self.levels) :]
        self.fpn = FeaturePyramidNetwork(channels, config.fpn_channels, pool, norm)

    def forward(self, x: Tensor) -> "OrderedDict[str, Tensor]":
        """Compute the feature pyramid.

        Args:
            x: [B, 3, H, W], normalized.

        Returns:
            [B, fpn_channels, H / s, W / s] by level: "0" of stride s = 4 (not with finest_stride 8)
            to "3" of 32, and "pool" of 64 where an anchor scale asks for it.
        """
        stages = self.body(x)
        features: OrderedDict[str, Tensor] = self.fpn(
            OrderedDict((name, stages[name]) for name in self.levels)
        )
        return features


class MaskRCNN(nn.Module):
    """Mask R-CNN with a CQE head: `losses` trains it, `cohdc_train.models.inference` runs it.

    Args:
        num_classes: classes without background.
        config: shape of the network.

    Raises:
        ValueError: the rates leave holes, or the weights do not fit the backbone.
        FileNotFoundError: the weights are neither a file nor a published name.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, num_classes: int, config: NetworkConfig) -> None:
        """Build the layers."""
        super().__init__()
        config = config.resolved(pretrained=config.weights is not None)
        self.config = config
        self.num_classes = num_classes
        channels = config.fpn_channels
        self.backbone = BackboneWithFPN(config)
        self.rpn = build_rpn(channels, config.anchor_scales, config.finest_stride, config.proposals)
        self.roi_heads = _build_roi_heads(config, num_classes)
        self.cqe = None
        if config.cqe != "off":
            self.cqe = CQEHead(channels, num_classes, channels, config.fc, fusion=config.cqe)
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(STD).view(3, 1, 1), persistent=False)

    def features(self, images: Tensor) -> "OrderedDict[str, Tensor]":
        """Normalize images, pad their sides to multiples of 32 px, and compute the pyramid.

        images: float [B, 3, H, W] in 0..1. Returns the levels of `BackboneWithFPN`.
        """
        height, width = images.shape[-2:]
        x = (images - self.mean) / self.std
        padded = F.pad(x, (0, -width % 32, 0, -height % 32))
        pyramid: OrderedDict[str, Tensor] = self.backbone(padded)
        return pyramid

    def losses(self, images: Tensor, targets: list[Target]) -> dict[str, Tensor]:
        """Compute the scalar losses of one batch; their sum trains the network.

        Args:
            images: float [B, 3, H, W] in 0..1 on the canvas.
            targets: per image `boxes` [n, 4] xyxy px, `labels` [n] from 1, `masks` [n, H, W] of 0
                and 1 (or mini-masks [n, h, w] with their `frames`, see GroundTruthMasks), and
                `ignore` [k, 4], the boxes of crowds. n may be 0. `size` is (height, width) of what
                is no padding, the canvas where it is missing.

        Returns:
            objectness, rpn_box, class, box, mask, and cqe where the network has that head.
        """
        canvas = (images.shape[-2], images.shape[-1])
        sizes = [canvas] * len(targets)
        features = self.features(images)
        proposals, loss_objectness, loss_rpn_box = self.rpn(
            canvas, list(features.values()), targets, self.config.proposals[0]
        )

        heads = self.roi_heads
        samples = sample_proposals(heads, proposals, targets)
        box_features = heads.box_head(heads.box_roi_pool(features, samples.boxes, sizes))
        logits, deltas = heads.box_predictor(box_features)
        loss_class, loss_box = fastrcnn_loss(
            logits.float(), deltas.float(), samples.labels, samples.deltas
        )

        positive = samples.positive()
        mask_features = heads.mask_roi_pool(features, positive.boxes, sizes)
        mask_logits = heads.mask_predictor(heads.mask_head(mask_features)).float()
        return {
            "objectness": loss_objectness,
            "rpn_box": loss_rpn_box,
            "class": loss_class,
            "box": loss_box,
            **mask_losses(
                mask_logits,
                mask_features,
                positive,
                targets,
                canvas,
                self.cqe,
                self.config.cqe_target,
            ),
        }


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
