"""Parity of an ONNX file and its network: the same images through both, output by output.

Which proposals are kept can depend on the last bit of two equal scores. An image on which file and
network differ is therefore shown to the network again, alone and changed by far less than a gray
level. Where the network then differs from itself, the image is ambiguous and decides nothing. Few
images may be ambiguous.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cohdc_train import signature
from cohdc_train.errors import ExportError
from cohdc_train.masks import paste_roi_mask
from cohdc_train.models import Detector, MaskRCNN
from cohdc_train.models.ops import letterbox
from cohdc_train.segmenter.segmenter import open_session
from cohdc_train.types import Image

Outputs = list[NDArray[Any]]  # of one image, in the order of signature.OUTPUTS

# Largest differences; boxes in px of the input image.
TOLERANCES = {"boxes": 1e-2, "scores": 1e-4, "quality": 1e-3, "masks": 1e-3}
MIN_MASK_IOU = 0.99  # of an object's pixels in the image, by the file and by the network
MAX_AMBIGUOUS_RATIO = 0.25  # of the images
_MIN_UNION_PX = 100  # in a smaller mask a pixel that flips is rounding, not a difference
_NOISE = (0.0, 1e-7, 1e-7, 1e-6, 1e-6, 1e-5, 1e-5)  # of white; a gray level is 4e-3
_MOSAIC = 3  # images on each side of the case that holds many objects


@dataclass
class Parity:
    """Result of a comparison.

    Attributes:
        max_difference: largest absolute difference per output, boxes in px; infinite where the
            detections differ.
        mask_iou: smallest IoU of an object's pixels in the image; 1 without a detection.
        detections: number of detections that were compared.
        images: number of images.
        ambiguous: number of images that were skipped, as the network's own detections depend on
            rounding.
        cases: size (height, width) px, batch and detections per image of every run.
    """

    max_difference: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TOLERANCES, 0.0))
    mask_iou: float = 1.0
    detections: int = 0
    images: int = 0
    ambiguous: int = 0
    cases: list[dict[str, Any]] = field(default_factory=list)

    def __or__(self, other: "Parity") -> "Parity":
        """Join two results: the worst differences, and the sums of the counts."""
        worst = {
            name: max(self.max_difference[name], other.max_difference[name]) for name in TOLERANCES
        }
        return Parity(
            max_difference=worst,
            mask_iou=min(self.mask_iou, other.mask_iou),
            detections=self.detections + other.detections,
            images=self.images + other.images,
            ambiguous=self.ambiguous + other.ambiguous,
            cases=[*self.cases, *other.cases],
        )

    def problem(self) -> str | None:
        """Describe the first output that differs by more than it may; None when all agree."""
        if math.isinf(self.max_difference["boxes"]):
            return "finds other objects than torch"
        for name, limit in TOLERANCES.items():
            difference = self.max_difference[name]
            if not difference <= limit:
                return f"{name} differ from torch by {difference:.3g}, allowed {limit:g}"
        if not self.mask_iou >= MIN_MASK_IOU:
            iou = f"a mask's IoU with torch's is {self.mask_iou:.3g}"
            return f"{iou}, at least {MIN_MASK_IOU} wanted"
        return None

    def require(self, file: Path) -> None:
        """Raise ExportError when an output differs too much, or too many images are ambiguous."""
        if (problem := self.problem()) is not None:
            raise ExportError(f"{file}: {problem}")
        if self.ambiguous > MAX_AMBIGUOUS_RATIO * self.images:
            count = f"{self.ambiguous} of {self.images} images"
            raise ExportError(
                f"{file}: torch's detections depend on rounding in {count}; "
                "compare on images such as it was trained on: --images FOLDER"
            )

    def report(self) -> dict[str, Any]:
        """Return the values for the report that goes with the file."""
        return {
            "max_difference": self.max_difference,
            "tolerance": TOLERANCES,
            "mask_iou_min": self.mask_iou,
            "detections_compared": self.detections,
            "images": self.images,
            "images_undecided": self.ambiguous,
            "most_detections": max((max(case["detections"]) for case in self.cases), default=0),
            "cases": self.cases,
        }


def compare(network: MaskRCNN, path: Path, images: Sequence[Image]) -> Parity:
    """Run file and network on the same images, and compare their outputs.

    Cases are batches of 1, 2 and 4 at three sizes, a black image, and a mosaic of the images, which
    holds as many objects as possible.

    Args:
        network: in evaluation mode.
        path: the ONNX file.
        images: uint8 [H, W, 3] each.
    """
    session = open_session(path)
    detector = Detector(network).eval()
    parity = Parity()
    for batch in _batches(network.config.canvas, images):
        with torch.inference_mode():
            expected = [tensor.numpy() for tensor in detector(torch.from_numpy(batch))]
        actual = session.run(list(signature.OUTPUTS), {signature.INPUT: batch})
        for i, image in enumerate(batch):
            truth, value = [e[i] for e in expected], [a[i] for a in actual]
            result = _compare_outputs(truth, value, image.shape[:2])
            if result.problem() is not None and _is_ambiguous(detector, image, truth):
                result = Parity(images=1, ambiguous=1)
            parity |= result
        size, counts = list(batch.shape[1:3]), expected[-1].tolist()
        parity.cases.append({"size": size, "batch": len(batch), "detections": counts})
    return parity


def _is_ambiguous(detector: Detector, image: Image, expected: Outputs) -> bool:
    """Check whether the network finds other objects in an image after changes below a gray level.

    The image also runs alone, without those it shared a batch with.

    Args:
        detector: the network.
        image: uint8 [H, W, 3].
        expected: outputs of the network in the batch.
    """
    canvas, geometry = letterbox(torch.from_numpy(image)[None], *detector.network.config.canvas)
    generator = torch.Generator().manual_seed(0)
    for amplitude in _NOISE:
        noise = amplitude * (2 * torch.rand(canvas.shape, generator=generator) - 1)
        with torch.inference_mode():
            outputs = [tensor[0].numpy() for tensor in detector.on_canvas(canvas + noise, geometry)]
        pairs = _match_detections(expected, outputs)
        if pairs is None:
            return True
        boxes, other_boxes = expected[0], outputs[0]
        if any(np.abs(boxes[i] - other_boxes[j]).max() > 1.0 for i, j in pairs):
            return True
    return False


def _batches(canvas: tuple[int, int], images: Sequence[Image]) -> list[Image]:
    """Make the batches of all cases: uint8 [B, H, W, 3] each."""
    rows, columns = canvas
    sizes = (
        (rows, columns),
        (columns * 5 // 4, rows * 3 // 2),
        (rows * 2 // 3 + 1, columns * 3 // 4 + 2),
    )
    batches = []
    for (height, width), batch in zip(sizes, (4, 2, 1), strict=True):
        scene = [_resize(images[i % len(images)], height, width) for i in range(4)]
        batches += [np.stack(scene[i : i + batch]) for i in range(0, 4, batch)]

    tiles = [_resize(images[i % len(images)], rows, columns) for i in range(_MOSAIC**2)]
    strips = [np.concatenate(tiles[i : i + _MOSAIC], axis=1) for i in range(0, len(tiles), _MOSAIC)]
    mosaic = np.concatenate(strips, axis=0)
    return [*batches, np.zeros((1, rows, columns, 3), np.uint8), mosaic[None]]


def _compare_outputs(expected: Outputs, actual: Outputs, size: tuple[int, int]) -> Parity:
    """Compare the outputs of one image.

    Rows of nearly equal score may be in another order: each is compared with its nearest box of the
    same label.

    Args:
        expected: outputs of the network.
        actual: outputs of the file.
        size: (height, width) of the image, px.
    """
    pairs = _match_detections(expected, actual)
    if pairs is None:
        infinite = dict.fromkeys(TOLERANCES, math.inf)
        return Parity(infinite, detections=int(expected[-1]), images=1)
    parity = Parity(detections=len(pairs), images=1)
    fields = dict(zip(signature.OUTPUTS, zip(expected, actual, strict=True), strict=True))
    for name in TOLERANCES:
        truth, value = fields[name]
        padding = [float(np.abs(rows[len(pairs) :]).max(initial=0.0)) for rows in (truth, value)]
        differences = [float(np.abs(truth[i] - value[j]).max()) for i, j in pairs]
        parity.max_difference[name] = max([*padding, *differences])

    (boxes, other_boxes), (masks, other_masks) = fields["boxes"], fields["masks"]
    for i, j in pairs:
        mask = paste_roi_mask(masks[i], boxes[i], size)
        other = paste_roi_mask(other_masks[j], other_boxes[j], size)
        union = int((mask | other).sum())
        if union > _MIN_UNION_PX:
            parity.mask_iou = min(parity.mask_iou, int((mask & other).sum()) / union)
    return parity


def _match_detections(expected: Outputs, actual: Outputs) -> list[tuple[int, int]] | None:
    """Pair the rows of the same detection; None where the detections are not the same."""
    (boxes, labels), (other_boxes, other_labels) = expected[:2], actual[:2]
    count = int(expected[-1])
    if int(actual[-1]) != count:
        return None
    free = list(range(count))
    pairs = []
    for i in range(count):
        same = [j for j in free if other_labels[j] == labels[i]]
        if not same:
            return None
        distances = [float(np.abs(other_boxes[j] - boxes[i]).max()) for j in same]
        nearest = same[int(np.argmin(distances))]
        free.remove(nearest)
        pairs.append((i, nearest))
    return pairs


def _resize(image: Image, height: int, width: int) -> Image:
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8)
