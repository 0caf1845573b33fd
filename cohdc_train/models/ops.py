"""Operators that keep the detector exportable: all inner shapes but one are known in advance.

The exception is the number of detections to segment. Each operator is a torch function wrapped as
a custom operator; `cohdc_train.exporter.export` says what it is in ONNX.
"""

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torchvision.ops import nms, roi_align

SAMPLING_RATIO = 2
# FPN's rule: a box of 224 px is pooled from level 4 (stride 16).
CANONICAL_SIDE, CANONICAL_LEVEL = 224, 4


def fitted_size(height: int, width: int, canvas: tuple[int, int]) -> tuple[int, int]:
    """Compute the size of an image fitted into the canvas; its aspect is kept to a pixel.

    Integers only. canvas: (height, width) px. Returns (height, width) px.
    """
    rows, columns = canvas
    if rows * width <= columns * height:
        return rows, max(1, (2 * width * rows + height) // (2 * height))
    return max(1, (2 * height * columns + width) // (2 * width)), columns


@torch.library.custom_op("cohdc::letterbox", mutates_args=())
def letterbox(images: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """Resize images into the top left of a black canvas (bilinear, antialiased).

    images: uint8 [B, H, W, 3]. Returns float32 [B, 3, rows, columns] in 0..1 and float32 [4]:
    height and width of the content in canvas px, then image px per canvas px along y and x.
    """
    height, width = images.shape[1:3]
    size = fitted_size(height, width, (rows, columns))
    x = images.permute(0, 3, 1, 2).contiguous().float()
    x = F.interpolate(x, size, mode="bilinear", align_corners=False, antialias=True) / 255
    geometry = torch.tensor(
        [size[0], size[1], height / size[0], width / size[1]], device=images.device
    )
    return F.pad(x, (0, columns - size[1], 0, rows - size[0])).contiguous(), geometry


@letterbox.register_fake
def _(images: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    canvas = images.new_empty((images.shape[0], 3, rows, columns), dtype=torch.float32)
    return canvas, images.new_empty((4,), dtype=torch.float32)


@torch.library.custom_op("cohdc::nms_keep", mutates_args=())
def nms_keep(boxes: Tensor, scores: Tensor, iou_threshold: float, score_threshold: float) -> Tensor:
    """Suppress overlapping boxes greedily, each image by itself.

    boxes: float32 [B, n, 4] xyxy; scores: float32 [B, n]. Returns bool [B, n]: kept, and with a
    score above the threshold.
    """
    if boxes.is_cuda:  # where every call waits for the device
        return nms_keep_batched(boxes, scores, iou_threshold, score_threshold)
    keep = torch.zeros_like(scores, dtype=torch.bool)
    for i in range(boxes.shape[0]):
        candidates = torch.nonzero(scores[i] > score_threshold)[:, 0]
        kept = nms(boxes[i, candidates], scores[i, candidates], iou_threshold)
        keep[i, candidates[kept]] = True
    return keep


@nms_keep.register_fake
def _(boxes: Tensor, scores: Tensor, iou_threshold: float, score_threshold: float) -> Tensor:
    return torch.empty_like(scores, dtype=torch.bool)


def nms_keep_batched(
    boxes: Tensor, scores: Tensor, iou_threshold: float, score_threshold: float
) -> Tensor:
    """Suppress overlapping boxes of all images in one call, as `nms_keep` does image by image.

    Images are moved apart for that; no coordinate is below 0.
    """
    keep = torch.zeros_like(scores, dtype=torch.bool)
    candidates = torch.nonzero(scores.flatten() > score_threshold)[:, 0]
    apart = (candidates // boxes.shape[1])[:, None] * (boxes.max() + 1)
    kept = nms(boxes.flatten(0, 1)[candidates] + apart, scores.flatten()[candidates], iou_threshold)
    keep.view(-1)[candidates[kept]] = True
    return keep


@torch.library.custom_op("cohdc::roi_pool_levels", mutates_args=())
def roi_pool_levels(
    features: list[Tensor], boxes: Tensor, images: Tensor, strides: list[int], side: int
) -> Tensor:
    """Pool each box by RoIAlign from the pyramid level of its size (Lin et al. 2017, eq. 1).

    Args:
        features: [B, C, H / s, W / s] for each stride s.
        boxes: float32 [R, 4] xyxy, canvas px.
        images: int64 [R], the image that each box belongs to.
        strides: of the levels.
        side: cells of the result.

    Returns:
        [R, C, side, side].
    """
    rois = torch.cat([images[:, None].to(boxes.dtype), boxes], dim=1)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    level = torch.floor(CANONICAL_LEVEL + torch.log2(area.sqrt() / CANONICAL_SIDE + 1e-8) + 1e-6)
    pooled = features[0].new_zeros((boxes.shape[0], features[0].shape[1], side, side))
    first = strides[0].bit_length() - 1
    level = level.clamp(first, first + len(features) - 1) - first
    for i, feature in enumerate(features):
        chosen = torch.nonzero(level == i)[:, 0]
        # in float32: a bfloat16 coordinate above 256 px is off by up to 1 px
        cells = roi_align(
            feature.float(), rois[chosen].float(), (side, side), 1.0 / strides[i], SAMPLING_RATIO
        )
        pooled[chosen] = cells.to(feature.dtype)
    return pooled


@roi_pool_levels.register_fake
def _(
    features: list[Tensor], boxes: Tensor, images: Tensor, strides: list[int], side: int
) -> Tensor:
    return features[0].new_empty((boxes.shape[0], features[0].shape[1], side, side))


@torch.library.custom_op("cohdc::rows_to_segment", mutates_args=())
def rows_to_segment(present: Tensor) -> Tensor:
    """Return the indices of the True rows of bool [R], int64 [K] in rising order.

    The first row is always one of them, so that K is never 0.
    """
    wanted = present.clone()
    wanted[0] = True
    return torch.nonzero(wanted)[:, 0]


@rows_to_segment.register_fake
def _(present: Tensor) -> Tensor:
    count = torch.library.get_ctx().new_dynamic_size(min=1)
    return present.new_empty((count,), dtype=torch.int64)
