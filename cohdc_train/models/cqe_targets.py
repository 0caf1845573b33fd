"""What the CQE head regresses: how well a predicted mask covers its whole ground-truth mask (paper
2.1.2).
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 torch's own name for it
from torch import Tensor

from cohdc_train.models.gt_masks import TrueMasks

Goal = Literal["iou", "ciou", "boundary_iou", "min"]
BAND = 0.02  # width of Boundary IoU's band, as a share of the image's diagonal


@torch.no_grad()
def cqe_targets(
    masks: Tensor,
    boxes: Tensor,
    truth: TrueMasks,
    matched: Tensor,
    kind: Goal = "iou",
    bands: Sequence[int] = (),
) -> Tensor:
    """How well each predicted mask covers its whole ground-truth mask, also what of it lies outside
    the box.

    masks: [K, M, M] probabilities; boxes: [K, 4] xyxy, canvas px; matched: [K] index of each box's
    object; bands: px, of each, for the last two kinds. Returns [K] in 0..1:
    - "iou": mask IoU, counted on the box's M x M grid, in whose cells the whole object's area is
      expressed too;
    - "ciou": (1 + CIoU) / 2 clipped, the paper's S_iou, and 0 where the masks do not meet;
    - "boundary_iou": IoU of the two masks' inner bands (Cheng et al. 2021), on canvas px;
    - "min": the smaller of mask IoU and Boundary IoU, both on canvas px: what Boundary AP matches
      by.
    """
    if kind in ("boundary_iou", "min"):
        return _on_canvas(masks, boxes, truth, matched, kind == "min", bands)
    side = masks.shape[-1]
    inside = (truth.within(boxes, matched, (side, side)) >= 0.5).to(boxes.dtype)
    predicted = (masks > 0.5).to(boxes.dtype)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    whole = truth.areas()[matched] * side**2 / area.clamp(min=1.0)
    intersection = (predicted * inside).sum(dim=(1, 2))
    union = predicted.sum(dim=(1, 2)) + whole - intersection
    iou: Tensor = (intersection / union.clamp(min=1e-6)).clamp(0.0, 1.0)
    if kind == "iou" or not len(masks):
        return iou
    cell = (boxes[:, 2:] - boxes[:, :2]) / side
    shape = Shape.of(predicted).placed(cell, boxes[:, :2])
    other = (
        Shape.of(truth.rasters.to(boxes.dtype))
        .placed(truth.cells(), truth.frames[:, :2])
        .chosen(matched)
    )
    return torch.where(iou > 0, 0.5 * (1 + ciou(iou, shape, other)).clamp(0.0, 2.0), 0.0)


def band_of(height: int, width: int) -> int:
    """Width, px, of Boundary IoU's band in an image of height x width px; at least 1."""
    return max(1, round(BAND * math.hypot(height, width)))


def boundary_iou(a: Tensor, b: Tensor, band: int) -> Tensor:
    """IoU of what lies within `band` px of the contour, inside the mask; the image's edge is
    contour too.

    a, b: [H, W] bool. Returns a scalar, 0 where both are empty. (Cheng et al. 2021: the mask less
    its erosion by `band` steps of 3 x 3, under a border of zeros.)
    """
    return _iou(*(m & ~_eroded(m, band) for m in (a, b)))


def _eroded(mask: Tensor, steps: int) -> Tensor:
    outside = F.pad((~mask).float()[None, None], (steps,) * 4, value=1.0)
    grown = F.max_pool2d(F.max_pool2d(outside, (2 * steps + 1, 1), 1), (1, 2 * steps + 1), 1)
    return grown[0, 0] < 0.5


def _iou(a: Tensor, b: Tensor) -> Tensor:
    return (a & b).sum() / (a | b).sum().clamp(min=1)


def _on_canvas(
    masks: Tensor,
    boxes: Tensor,
    truth: TrueMasks,
    matched: Tensor,
    lesser: bool,
    bands: Sequence[int],
) -> Tensor:
    """[K] Boundary IoU, or with `lesser` the smaller of it and mask IoU, pixel by pixel around both
    masks.
    """
    shapes = Shape.of(truth.rasters.to(boxes.dtype)).placed(truth.cells(), truth.frames[:, :2])
    scores = boxes.new_zeros(len(boxes))
    for k, (mask, box, g, band) in enumerate(zip(masks, boxes, matched, bands, strict=True)):
        low = torch.minimum(box[:2], shapes.low[g]).floor()
        high = torch.maximum(box[2:], shapes.high[g]).ceil()
        width, height = (int(v) for v in (high - low).clamp(min=1))
        region = torch.cat([low, low + low.new_tensor([width, height])])[None]
        inside = _within_box(
            truth.frames[g] - low.repeat(2), height, width
        )  # RoIAlign repeats the raster's edge
        true = (truth.within(region, g[None], (height, width), samples=1)[0] >= 0.5) & inside
        predicted = _pasted(mask, box - low.repeat(2), height, width)
        score = boundary_iou(predicted, true, band)
        scores[k] = torch.minimum(score, _iou(predicted, true)) if lesser else score
    return scores


def _pasted(mask: Tensor, box: Tensor, height: int, width: int) -> Tensor:
    """bool [height, width]: an RoI mask [M, M] laid over its box (xyxy, px), bilinear between
    cells' centres.
    """
    axes = []
    for start, end, count in ((box[0], box[2], width), (box[1], box[3], height)):
        axes.append(
            (torch.arange(count, device=box.device) + 0.5 - start)
            / (end - start).clamp(min=1e-6)
            * 2
            - 1
        )
    y, x = torch.meshgrid(axes[1], axes[0], indexing="ij")
    grid = torch.stack([x, y], dim=-1)[None].to(mask.dtype)
    sampled = F.grid_sample(mask[None, None], grid, "bilinear", "border", align_corners=False)[0, 0]
    return (sampled > 0.5) & _within_box(box, height, width)


def _within_box(box: Tensor, height: int, width: int) -> Tensor:
    """bool [height, width]: pixels whose centre lies inside a box (xyxy, px)."""
    x, y = (torch.arange(count, device=box.device) + 0.5 for count in (width, height))
    return ((y >= box[1]) & (y < box[3]))[:, None] & (x >= box[0]) & (x < box[2])


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
    """Complete IoU of masks: IoU - rho^2 / c^2 - alpha v (Zheng et al. 2020, with the masks'
    centroids).

    rho: distance of the centroids; c: diagonal of the smallest box around both; v: how far the
    aspect ratios of their tight boxes differ, alpha = v / (1 - IoU + v). iou: [K]. Returns [K],
    above -1.5 and at most 1.
    """
    distance = (a.centre - b.centre).square().sum(dim=1)
    around = (torch.maximum(a.high, b.high) - torch.minimum(a.low, b.low)).square().sum(dim=1)
    angles = [torch.atan2(*(s.high - s.low).unbind(dim=1)) for s in (a, b)]
    v = 4 / math.pi**2 * (angles[0] - angles[1]).square()
    return iou - distance / around.clamp(min=1e-6) - v * v / (1 - iou + v).clamp(min=1e-6)
