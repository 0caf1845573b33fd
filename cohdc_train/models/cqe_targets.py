"""Targets of the CQE head: the overlap of a predicted mask with its whole object (paper 2.1.2)."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 torch's own name for it
from torch import Tensor

from cohdc_train.models.gt_masks import GroundTruthMasks

QualityTarget = Literal["iou", "ciou", "boundary_iou", "min"]
BAND = 0.02  # width of Boundary IoU's band, as a share of the image's diagonal


@torch.no_grad()
def cqe_targets(
    masks: Tensor,
    boxes: Tensor,
    truth: GroundTruthMasks,
    matched: Tensor,
    kind: QualityTarget = "iou",
    bands: Sequence[int] = (),
) -> Tensor:
    """Compute the overlap of predicted masks with their whole objects, also outside of the box.

    Args:
        masks: [K, M, M] probabilities.
        boxes: [K, 4] xyxy, canvas px.
        truth: masks of the objects.
        matched: [K] index of each box's object.
        kind: what is computed:
            - "iou": mask IoU, counted on the box's M x M grid, in whose cells the whole object's
              area is expressed too;
            - "ciou": (1 + CIoU) / 2 clipped, the paper's S_iou, and 0 where the masks do not meet;
            - "boundary_iou": IoU of the two masks' inner bands (Cheng et al. 2021), on canvas px;
            - "min": the smaller of mask IoU and Boundary IoU, both on canvas px: what Boundary AP
              matches by.
        bands: width of each band, px, for the last two kinds.

    Returns:
        [K] in 0..1.
    """
    if kind in ("boundary_iou", "min"):
        return _canvas_overlap(masks, boxes, truth, matched, kind == "min", bands)
    side = masks.shape[-1]
    predicted = (masks > 0.5).to(boxes.dtype)
    inside = (truth.coverage(boxes, matched, (side, side)) >= 0.5).to(boxes.dtype)
    box_area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    object_area = truth.areas()[matched] * side**2 / box_area.clamp(min=1.0)
    intersection = (predicted * inside).sum(dim=(1, 2))
    union = predicted.sum(dim=(1, 2)) + object_area - intersection
    iou: Tensor = (intersection / union.clamp(min=1e-6)).clamp(0.0, 1.0)
    if kind == "iou" or not len(masks):
        return iou
    cell = (boxes[:, 2:] - boxes[:, :2]) / side
    extent = MaskExtent.from_masks(predicted).to_canvas(cell, boxes[:, :2])
    object_extent = _object_extents(truth, boxes.dtype).select(matched)
    score = 0.5 * (1 + ciou(iou, extent, object_extent))
    return torch.where(iou > 0, score.clamp(0.0, 2.0), 0.0)


def boundary_band_px(height: int, width: int) -> int:
    """Return the width of Boundary IoU's band in an image of height x width px; at least 1 px."""
    return max(1, round(BAND * math.hypot(height, width)))


def boundary_iou(a: Tensor, b: Tensor, band: int) -> Tensor:
    """Compute the IoU of the bands along the contours of two masks (Cheng et al. 2021).

    A band is the mask without its erosion by `band` steps of 3 x 3, under a border of zeros: the
    image's edge is a contour too.

    a, b: [H, W] bool. Returns a scalar, 0 where both are empty.
    """
    return _iou(a & ~_erode(a, band), b & ~_erode(b, band))


def _erode(mask: Tensor, steps: int) -> Tensor:
    outside = F.pad((~mask).float()[None, None], (steps,) * 4, value=1.0)
    grown = F.max_pool2d(F.max_pool2d(outside, (2 * steps + 1, 1), 1), (1, 2 * steps + 1), 1)
    return grown[0, 0] < 0.5


def _iou(a: Tensor, b: Tensor) -> Tensor:
    return (a & b).sum() / (a | b).sum().clamp(min=1)


def _canvas_overlap(
    masks: Tensor,
    boxes: Tensor,
    truth: GroundTruthMasks,
    matched: Tensor,
    smaller: bool,
    bands: Sequence[int],
) -> Tensor:
    """Compute [K] Boundary IoU, pixel by pixel around both masks.

    smaller: return the smaller of it and mask IoU instead.
    """
    extents = _object_extents(truth, boxes.dtype)
    scores = boxes.new_zeros(len(boxes))
    for k, (mask, box, g, band) in enumerate(zip(masks, boxes, matched, bands, strict=True)):
        # The region holds the box and the whole object.
        low = torch.minimum(box[:2], extents.low[g]).floor()
        high = torch.maximum(box[2:], extents.high[g]).ceil()
        width, height = (int(v) for v in (high - low).clamp(min=1))
        region = torch.cat([low, low + low.new_tensor([width, height])])[None]

        # RoIAlign repeats the raster's edge, so the object is cut at its frame.
        in_frame = _box_mask(truth.frames[g] - low.repeat(2), height, width)
        coverage = truth.coverage(region, g[None], (height, width), samples=1)[0]
        true = (coverage >= 0.5) & in_frame
        predicted = _paste_mask(mask, box - low.repeat(2), height, width)
        score = boundary_iou(predicted, true, band)
        scores[k] = torch.minimum(score, _iou(predicted, true)) if smaller else score
    return scores


def _paste_mask(mask: Tensor, box: Tensor, height: int, width: int) -> Tensor:
    """Paste an RoI mask [M, M] over its box (xyxy, px), bilinear between the cells' centers.

    Returns bool [height, width].
    """
    axes = []
    for start, end, count in ((box[0], box[2], width), (box[1], box[3], height)):
        pixel_centers = torch.arange(count, device=box.device) + 0.5
        axes.append((pixel_centers - start) / (end - start).clamp(min=1e-6) * 2 - 1)
    y, x = torch.meshgrid(axes[1], axes[0], indexing="ij")
    grid = torch.stack([x, y], dim=-1)[None].to(mask.dtype)
    sampled = F.grid_sample(mask[None, None], grid, "bilinear", "border", align_corners=False)[0, 0]
    return (sampled > 0.5) & _box_mask(box, height, width)


def _box_mask(box: Tensor, height: int, width: int) -> Tensor:
    """Return bool [height, width]: pixels whose center lies inside a box (xyxy, px)."""
    x, y = (torch.arange(count, device=box.device) + 0.5 for count in (width, height))
    return ((y >= box[1]) & (y < box[3]))[:, None] & (x >= box[0]) & (x < box[2])


class MaskExtent(NamedTuple):
    """Place of masks: centroid and tight box.

    Attributes:
        center: [K, 2] centroid x, y.
        low: [K, 2] upper left corner x, y of the tight box.
        high: [K, 2] lower right corner x, y of the tight box.
    """

    center: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def from_masks(cls, masks: Tensor) -> "MaskExtent":
        """Measure masks [K, H, W] of 0 and 1, in cells; all zeros for an empty mask."""
        center, low, high = [], [], []
        for line in (masks.sum(dim=1), masks.sum(dim=2)):  # cells per column, per row
            place = torch.arange(line.shape[1], device=line.device, dtype=line.dtype)
            center.append((line * (place + 0.5)).sum(dim=1) / line.sum(dim=1).clamp(min=1))
            hit = line > 0
            low.append(torch.where(hit, place, float(line.shape[1])).amin(dim=1) * hit.any(dim=1))
            high.append(torch.where(hit, place + 1, 0.0).amax(dim=1))
        return cls(torch.stack(center, 1), torch.stack(low, 1), torch.stack(high, 1))

    def to_canvas(self, cell: Tensor, origin: Tensor) -> "MaskExtent":
        """Convert cells to px.

        cell, origin: [K, 2] width and height of a cell, and the grid's upper left corner.
        """
        return MaskExtent(*(part * cell + origin for part in self))

    def select(self, index: Tensor) -> "MaskExtent":
        """Return the extents at `index` [N]."""
        return MaskExtent(*(part[index] for part in self))


def _object_extents(truth: GroundTruthMasks, dtype: torch.dtype) -> MaskExtent:
    """Return the extents of all objects, canvas px."""
    extents = MaskExtent.from_masks(truth.rasters.to(dtype))
    return extents.to_canvas(truth.cells(), truth.frames[:, :2])


def ciou(iou: Tensor, a: MaskExtent, b: MaskExtent) -> Tensor:
    """Compute the complete IoU of masks: IoU - rho^2 / c^2 - alpha v (Zheng et al. 2020).

    rho: distance of the masks' centroids; c: diagonal of the smallest box around both; v: how far
    the aspect ratios of their tight boxes differ, alpha = v / (1 - IoU + v).

    iou: [K]. Returns [K], above -1.5 and at most 1.
    """
    distance = (a.center - b.center).square().sum(dim=1)
    around = (torch.maximum(a.high, b.high) - torch.minimum(a.low, b.low)).square().sum(dim=1)
    angles = [torch.atan2(*(s.high - s.low).unbind(dim=1)) for s in (a, b)]
    v = 4 / math.pi**2 * (angles[0] - angles[1]).square()
    return iou - distance / around.clamp(min=1e-6) - v * v / (1 - iou + v).clamp(min=1e-6)
