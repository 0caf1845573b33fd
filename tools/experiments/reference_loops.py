"""Torchvision's detection training and evaluation, rewritten for comparisons."""

import argparse
import contextlib
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from pycocotools import mask as rle
from pycocotools.cocoeval import COCOeval
from torch import nn
from torch.utils.data import DataLoader, Subset
from torchvision.datasets import CocoDetection
from torchvision.models.detection import MaskRCNN
from torchvision.ops import FrozenBatchNorm2d
from torchvision.transforms.v2.functional import horizontal_flip, pil_to_tensor, to_dtype

from cohdc_train.models.frozen_norm import FrozenNorm, plain_convolution


def train(
    module: Any, data: Any, positions: list[int], args: argparse.Namespace, gate: Any
) -> None:
    """Train one epoch as torchvision's references/detection does, rewritten here."""
    network = same_network(module).train()
    split = data.folder.train[0]
    images = Images(split, flip=0.5)
    place = {image_id: i for i, image_id in enumerate(images.coco.ids)}
    positions = [place[split.images[i].id] for i in positions]
    loader = DataLoader(
        Subset(images, positions),
        args.batch,
        collate_fn=lambda batch: tuple(zip(*batch, strict=True)),
    )
    optimizer = torch.optim.SGD(
        [p for p in network.parameters() if p.requires_grad], 1e-3, 0.9, weight_decay=1e-4
    )
    schedule = torch.optim.lr_scheduler.LinearLR(
        optimizer, 1e-3, total_iters=min(1000, len(loader) - 1)
    )
    gate.next()
    for step, (batch, targets) in enumerate(loader, 1):
        losses = network(list(batch), [dict(target) for target in targets])
        total = sum(losses.values())
        if not torch.isfinite(total):
            raise SystemExit(f"reference: loss {total.item()} at step {step}")
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        if step % args.steps == 0:
            gate.next()


def validate(module: Any, data: Any, args: argparse.Namespace, gate: Any) -> None:
    """Predict image by image, paste, encode with pycocotools, COCOeval for boxes and masks."""
    network = same_network(module).eval()
    split = data.folder.val
    images = Images(split, flip=0.0)
    chosen = [image.id for image in split.images[: args.val_images]]
    while gate.next():
        rows: list[dict[str, Any]] = []
        for image_id in chosen:
            image, _ = images[images.coco.ids.index(image_id)]
            with torch.inference_mode():
                (found,) = network([image])
            rows += result_rows(image_id, found, images.category)
        stats = {kind: coco_stats(images, chosen, rows, kind)[0] for kind in ("bbox", "segm")}
    print(f"reference: segm AP {stats['segm']:.3f}, box AP {stats['bbox']:.3f}", flush=True)


def coco_scores(
    images: "Images", chosen: list[int], rows: list[dict[str, Any]]
) -> dict[str, float]:
    """Return mask AP, mask AP50 and box AP by pycocotools; 0 without a detection."""
    if not rows:
        return {"AP": 0.0, "AP50": 0.0, "box_AP": 0.0}
    masks, boxes = (coco_stats(images, chosen, rows, kind) for kind in ("segm", "bbox"))
    return {"AP": masks[0], "AP50": masks[1], "box_AP": boxes[0]}


def coco_stats(
    images: "Images", chosen: list[int], rows: list[dict[str, Any]], kind: str
) -> list[float]:
    """Return pycocotools' twelve figures of boxes ("bbox") or masks ("segm") of some images."""
    other = "bbox" if kind == "segm" else "segmentation"
    truth = images.coco.coco
    with contextlib.redirect_stdout(io.StringIO()):
        own = [{key: value for key, value in row.items() if key != other} for row in rows]
        scored = COCOeval(truth, truth.loadRes(own), kind)
        scored.params.imgIds, scored.params.catIds = chosen, sorted(images.category.values())
        scored.evaluate()
        scored.accumulate()
        scored.summarize()
    return [float(value) for value in scored.stats]


def result_rows(
    image_id: int, found: dict[str, Any], category: dict[int, int]
) -> Iterator[dict[str, Any]]:
    """Make COCO result rows of one image, masks pasted by torchvision."""
    for box, label, score, mask in zip(
        *(found[key] for key in ("boxes", "labels", "scores", "masks")), strict=True
    ):
        x0, y0, x1, y1 = box.tolist()
        encoded = rle.encode(np.array(mask[0, :, :, None] > 0.5, dtype=np.uint8, order="F"))[0]
        encoded["counts"] = encoded["counts"].decode()
        row = {"image_id": image_id, "category_id": category[int(label)], "score": float(score)}
        yield {**row, "bbox": [x0, y0, x1 - x0, y1 - y0], "segmentation": encoded}


class Images:
    """CocoDetection with polygons turned into masks, as (float image, target)."""

    def __init__(self, split: Any, flip: float) -> None:
        """Open a split; flip: probability of a horizontal flip."""
        self.coco = CocoDetection(str(split.images[0].path.parent), str(split.annotations))
        ids = {row["name"]: row["id"] for row in self.coco.coco.cats.values()}
        self.category = {i: ids[name] for i, name in enumerate(split.class_names, 1)}
        self.flip = flip

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.coco)

    def __getitem__(self, index: int) -> tuple[Any, dict[str, Any]]:
        """Load an image and its target."""
        pixels, rows = self.coco[index]
        label = {number: i for i, number in self.category.items()}
        rows = [row for row in rows if row["iscrowd"] == 0 and row["category_id"] in label]
        width, height = pixels.size
        boxes = torch.tensor([row["bbox"] for row in rows], dtype=torch.float32).reshape(-1, 4)
        boxes[:, 2:] += boxes[:, :2]
        boxes[:, 0::2].clamp_(0, width)
        boxes[:, 1::2].clamp_(0, height)
        shapes = [row["segmentation"] for row in rows]
        shapes = [[s] if isinstance(s, dict) else rle.frPyObjects(s, height, width) for s in shapes]
        drawn = [
            torch.as_tensor(rle.decode(shape), dtype=torch.uint8).any(dim=2) for shape in shapes
        ]
        stacked = (
            torch.stack(drawn) if drawn else torch.zeros((0, height, width), dtype=torch.uint8)
        )
        labels = torch.tensor([label[row["category_id"]] for row in rows], dtype=torch.int64)
        keep = (boxes[:, 2:] > boxes[:, :2]).all(dim=1)
        image, boxes, stacked = pil_to_tensor(pixels), boxes[keep], stacked[keep]
        if self.flip and torch.rand(1) < self.flip:
            image, stacked = horizontal_flip(image), stacked.flip(-1)
            boxes[:, [0, 2]] = width - boxes[:, [2, 0]]
        return to_dtype(image, torch.float32, scale=True), {
            "boxes": boxes,
            "labels": labels[keep],
            "masks": stacked,
        }


def with_torchvision_norms(network: torch.nn.Module) -> torch.nn.Module:
    """Replace every frozen norm of a network by torchvision's own, in place."""
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, nn.Conv2d):
                plain_convolution(child)
            if isinstance(child, FrozenNorm):
                norm = FrozenBatchNorm2d(child.weight.numel(), child.eps)
                norm.load_state_dict(child.state_dict())
                setattr(module, name, norm)
    return network


def same_network(module: Any) -> Any:
    """Build torchvision's Mask R-CNN of the same parts and weights, resizing to the canvas."""
    ours, config = module.network, module.network_config
    with_torchvision_norms(ours)
    heads = ours.roi_heads
    ours.backbone.out_channels = config.fpn_channels
    return MaskRCNN(
        ours.backbone,
        **{"rpn_anchor_generator": ours.rpn.anchor_generator, "rpn_head": ours.rpn.head},
        **{
            "box_roi_pool": heads.box_roi_pool,
            "box_head": heads.box_head,
            "box_predictor": heads.box_predictor,
        },
        **{
            "mask_roi_pool": heads.mask_roi_pool,
            "mask_head": heads.mask_head,
            "mask_predictor": heads.mask_predictor,
        },
        **{
            "rpn_pre_nms_top_n_train": 2 * config.proposals[0],
            "rpn_post_nms_top_n_train": config.proposals[0],
        },
        **{
            "rpn_pre_nms_top_n_test": 2 * config.proposals[1],
            "rpn_post_nms_top_n_test": config.proposals[1],
        },
        **{"box_score_thresh": config.score_threshold, "box_nms_thresh": config.nms_iou},
        **{"box_detections_per_img": config.detections, "box_batch_size_per_image": config.rois},
        fixed_size=(config.canvas[1], config.canvas[0]),
    )
