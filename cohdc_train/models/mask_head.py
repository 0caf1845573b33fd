"""The last layers of the mask head, for masks of 28 or 56 cells a side, and its loss."""

from collections import OrderedDict
from typing import Literal

import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torchvision.models.detection.mask_rcnn import MaskRCNNPredictor

from cohdc_train.models.gt_masks import GroundTruthMasks

MaskSize = Literal[28, 56]


def mask_predictor(channels: int, classes: int, side: MaskSize) -> nn.Sequential:
    """Build torchvision's layers from features to logits; 56 cells take one more deconvolution.

    They map [K, channels, 14, 14] to [K, classes, side, side].
    """
    once: nn.Sequential = MaskRCNNPredictor(channels, channels, classes)
    if side == 28:
        return once
    again = nn.ConvTranspose2d(channels, channels, 2, 2)
    nn.init.kaiming_normal_(again.weight, mode="fan_out", nonlinearity="relu")
    layers = OrderedDict(once.named_children())
    last = layers.pop("mask_fcn_logits")
    return nn.Sequential(
        OrderedDict(**layers, conv6_mask=again, relu6=nn.ReLU(inplace=True), mask_fcn_logits=last)
    )


def mask_loss(logits: Tensor, truth: GroundTruthMasks, boxes: Tensor, matched: Tensor) -> Tensor:
    """Compute the binary cross-entropy of masks with the share of each cell that the object covers.

    The targets are soft and lie on the grid by which masks are pasted; Matterport's are rounded,
    torchvision's half a pixel off.

    Args:
        logits: [K, M, M] of the object's class.
        truth: masks of the objects.
        boxes: [K, 4] xyxy, canvas px.
        matched: [K] index of each box's object.
    """
    if not len(boxes):
        return logits.sum() * 0
    covered = truth.coverage(boxes, matched, (logits.shape[-2], logits.shape[-1]))
    return F.binary_cross_entropy_with_logits(logits, covered)
