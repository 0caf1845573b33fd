"""Inference with a fixed number of padded detections, the same code in torch and in the export.

Rows that hold no detection are zeros behind `count`; only the others go through the mask and CQE
heads.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cohdc_train.models.mask_rcnn import MaskRCNN
from cohdc_train.models.ops import letterbox, nms_keep, roi_pool_levels, rows_to_segment
from cohdc_train.models.rpn import decode, is_nonempty

_CANDIDATES = 1000  # best (proposal, class) pairs that enter the last suppression
_MIN_IOU = 0.25  # lowest IoU estimate that a mask is cut by, at a probability of 0.2


@dataclass(frozen=True)
class PaddedDetections:
    """Output tensors, in the order of `cohdc_train.signature.OUTPUTS`."""

    boxes: Tensor
    labels: Tensor
    scores: Tensor
    quality: Tensor
    masks: Tensor
    count: Tensor


class Detector(torch.nn.Module):
    """MaskRCNN as it is exported: from images to the outputs of `cohdc_train.signature`."""

    def __init__(self, network: MaskRCNN) -> None:
        """Wrap a network in evaluation mode."""
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """Detect objects; rows of the result are sorted by score.

        images: uint8 [B, H, W, 3] RGB, any H and W.
        """
        return self.on_canvas(*letterbox(images, *self.network.config.canvas))

    def on_canvas(self, canvas: Tensor, geometry: Tensor) -> tuple[Tensor, ...]:
        """Detect objects on images that `letterbox` has fitted into the canvas.

        canvas, geometry: the results of `letterbox`.
        """
        found = detect_on_canvas(
            self.network, canvas, geometry[None, :2].expand(canvas.shape[0], 2)
        )
        boxes = found.boxes * torch.stack([geometry[3], geometry[2], geometry[3], geometry[2]])
        return boxes, found.labels, found.scores, found.quality, found.masks, found.count


@torch.no_grad()
def detect(network: MaskRCNN, images: list[Tensor]) -> list[dict[str, Tensor]]:
    """Detect objects in images of any sizes, each in its own pixels.

    Args:
        network: a network in evaluation mode.
        images: uint8 [3, H, W] RGB.

    Returns:
        Per image `boxes` [n, 4] xyxy px, `labels` [n] from 0, `scores` [n], `quality` [n], `masks`
        [n, M, M] probabilities inside the box.
    """
    rows, columns = network.config.canvas
    fitted = [letterbox(image.permute(1, 2, 0)[None], rows, columns) for image in images]
    geometry = torch.stack([g for _, g in fitted])
    found = detect_on_canvas(network, torch.cat([c for c, _ in fitted]), geometry[:, :2])
    boxes = found.boxes * geometry[:, None, [3, 2, 3, 2]]
    results = []
    for i in range(len(images)):
        n = int(found.count[i])
        rest = {
            name: getattr(found, name)[i, :n] for name in ("labels", "scores", "quality", "masks")
        }
        results.append({"boxes": boxes[i, :n], **rest})
    return results


def detect_on_canvas(network: MaskRCNN, canvas: Tensor, content: Tensor) -> PaddedDetections:
    """Detect objects on a batch of fitted images; boxes are in canvas px.

    canvas: float [B, 3, H, W] in 0..1; content: [B, 2] height and width of what is not padding, px.
    """
    pyramid = network.features(canvas)
    limit = content.flip(1).repeat(1, 2)[:, None]  # [B, 1, 4]: x, y, x, y
    objectness, deltas = network.rpn.head(list(pyramid.values()))
    proposals = network.rpn.propose(objectness, deltas, network.config.proposals[1], limit)
    # RoIAlign reads channels first, and would copy every level each time it is called
    levels = [pyramid[name].float().contiguous() for name in network.config.roi_levels()]
    boxes, labels, scores, count = _classify(network, levels, proposals, limit)
    masks, quality = _segment(network, levels, boxes, labels, count)
    return PaddedDetections(boxes, labels, scores, quality, masks, count)


def _classify(
    network: MaskRCNN, levels: list[Tensor], proposals: Tensor, limit: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Classify proposals and suppress overlapping boxes.

    Returns boxes [B, N, 4], labels [B, N] from 0, scores [B, N] in falling order, count [B]; padded
    with zeros.
    """
    config, heads = network.config, network.roi_heads
    batch, rois = proposals.shape[:2]
    images = torch.arange(batch, device=proposals.device).repeat_interleave(rois)
    pooled = roi_pool_levels(
        levels, proposals.reshape(batch * rois, 4), images, config.roi_strides(), 7
    )
    logits, deltas = heads.box_predictor(heads.box_head(pooled))
    classes = network.num_classes
    scores = logits.float().softmax(dim=1)[:, 1:].reshape(batch, rois * classes)
    deltas = deltas.float().reshape(batch, rois * (classes + 1), 4)
    solid = (
        is_nonempty(proposals)[:, :, None]
        .expand(batch, rois, classes)
        .reshape(batch, rois * classes)
    )
    scores, index = torch.where(solid, scores, 0.0).topk(min(_CANDIDATES, rois * classes), dim=1)
    roi, label = index // classes, index % classes
    deltas = deltas.gather(1, (roi * (classes + 1) + label + 1)[:, :, None].expand(-1, -1, 4))
    boxes = decode(
        deltas,
        proposals.gather(1, roi[:, :, None].expand(-1, -1, 4)),
        heads.box_coder.weights,
        limit,
    )
    scores = torch.where(is_nonempty(boxes), scores, 0.0)
    apart = label.float() * (max(config.canvas) + 1.0)  # no two classes overlap
    keep = nms_keep(boxes + apart[:, :, None], scores, config.nms_iou, config.score_threshold)
    scores, best = torch.where(keep, scores, 0.0).topk(
        min(config.detections, scores.shape[1]), dim=1
    )
    present = scores > 0
    boxes = boxes.gather(1, best[:, :, None].expand(-1, -1, 4)) * present[:, :, None]
    return boxes, label.gather(1, best) * present, scores, present.sum(dim=1)


def _segment(
    network: MaskRCNN, levels: list[Tensor], boxes: Tensor, labels: Tensor, count: Tensor
) -> tuple[Tensor, Tensor]:
    """Predict mask and quality of the predicted classes.

    Returns masks [B, N, M, M] and quality [B, N]; zeros from row count [B] on.
    """
    heads = network.roi_heads
    batch, n = labels.shape
    present = torch.arange(n, device=count.device)[None] < count[:, None]
    rows = rows_to_segment(present.reshape(batch * n))
    label = labels.reshape(batch * n)[rows]
    pooled = roi_pool_levels(
        levels, boxes.reshape(batch * n, 4)[rows], rows // n, network.config.roi_strides(), 14
    )
    logits = heads.mask_predictor(heads.mask_head(pooled))
    side = logits.shape[-1]
    masks = logits.gather(1, (label + 1)[:, None, None, None].expand(-1, 1, side, side))[
        :, 0
    ].sigmoid()
    if network.cqe is None:
        quality = masks.new_ones(len(rows), dtype=torch.float32)
    else:
        quality = network.cqe(pooled, masks).gather(1, label[:, None])[:, 0].float().clamp(0.0, 1.0)
    masks = masks.float()
    if network.config.mask_cut == "quality":
        masks = cut_by_quality(masks, quality)
    padded = (
        masks.new_zeros((batch * n, side, side))
        .index_put((rows,), masks)
        .reshape(batch, n, side, side)
    )
    each = quality.new_zeros((batch * n,)).index_put((rows,), quality).reshape(batch, n)
    return padded * present[:, :, None, None], each * present


def cut_by_quality(masks: Tensor, quality: Tensor) -> Tensor:
    """Rescale mask probabilities so that 0.5 is the cut of the greatest expected IoU.

    A pixel of probability p that joins a mask adds p to its intersection with the object and 1 - p
    to their union. That raises their ratio where p / (1 - p) exceeds it, so the cut lies at q / (1
    + q): at 0.5 for a perfect mask, lower for an uncertain one, whose uncertain rim rather belongs
    to it.

    masks: [n, M, M] probabilities; quality: [n] estimates q of the IoU.
    """
    ratio = quality.clamp(min=_MIN_IOU)[:, None, None]
    return masks / (masks + ratio * (1.0 - masks))
