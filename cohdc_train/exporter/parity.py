"""An ONNX file against the network it was written from: the same pictures through both, output by
output.

Which proposals are kept can hinge on the last bit of two equal scores. A picture on which file and
network differ is therefore shown to the network again, by itself and changed by far less than a
grey level: where the network then differs from itself, the picture decides nothing. There may be
few of those.
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

TOLERANCES = {
    "boxes": 1e-2,
    "scores": 1e-4,
    "quality": 1e-3,
    "masks": 1e-3,
}  # boxes in px of the input image
LEAST_MASK_IOU = 0.99  # of an object's pixels in the image, by the file and by the network
MOST_UNDECIDED = 0.25  # of the images
_DISTURBANCES = (0.0, 1e-7, 1e-7, 1e-6, 1e-6, 1e-5, 1e-5)  # of white; a grey level is 4e-3
_MOSAIC = 3  # pictures on each side of the case that holds many objects


@dataclass
class Parity:
    """What a comparison found.

    Attributes:
        max_difference: largest absolute difference per output, boxes in px; infinite where the
            detections differ.
        mask_iou: smallest IoU of an object's pixels in the image; 1 without a detection.
        detections: how many were compared.
        images: how many.
        undecided: images of these that were left out, as the network's own detections hinge on
            rounding.
        cases: size (height, width) px, batch and detections per image of every run.
    """

    max_difference: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TOLERANCES, 0.0))
    mask_iou: float = 1.0
    detections: int = 0
    images: int = 0
    undecided: int = 0
    cases: list[dict[str, Any]] = field(default_factory=list)

    def __or__(self, other: "Parity") -> "Parity":
        """Both together."""
        worst = {
            name: max(self.max_difference[name], other.max_difference[name]) for name in TOLERANCES
        }
        counts = (
            self.detections + other.detections,
            self.images + other.images,
            self.undecided + other.undecided,
        )
        return Parity(
            worst, min(self.mask_iou, other.mask_iou), *counts, [*self.cases, *other.cases]
        )

    def problem(self) -> str | None:
        """The first output that differs by more than it may, in words."""
        if math.isinf(self.max_difference["boxes"]):
            return "finds other objects than torch"
        for name, limit in TOLERANCES.items():
            found = self.max_difference[name]
            if not found <= limit:
                return f"{name} differ from torch by {found:.3g}, allowed {limit:g}"
        if not self.mask_iou >= LEAST_MASK_IOU:
            return f"a mask's IoU with torch's is {self.mask_iou:.3g}, at least {LEAST_MASK_IOU} wanted"
        return None

    def require(self, file: Path) -> None:
        """Raise ExportError naming the file when an output differs by more than it may, or too
        little was decided.
        """
        if (problem := self.problem()) is not None:
            raise ExportError(f"{file}: {problem}")
        if self.undecided > MOST_UNDECIDED * self.images:
            raise ExportError(
                f"{file}: what torch finds hinges on rounding in {self.undecided} of {self.images} images; compare on "
                "pictures such as it was trained on: --images FOLDER"
            )

    def report(self) -> dict[str, Any]:
        """For the report beside the file."""
        return {
            "max_difference": self.max_difference,
            "tolerance": TOLERANCES,
            "mask_iou_min": self.mask_iou,
            "detections_compared": self.detections,
            "images": self.images,
            "images_undecided": self.undecided,
            "most_detections": max((max(case["detections"]) for case in self.cases), default=0),
            "cases": self.cases,
        }


def compare(network: MaskRCNN, path: Path, pictures: Sequence[Image]) -> Parity:
    """Run file and network on batches of 1, 2 and 4 at three sizes, on a black image, and on a
    mosaic of the pictures, which holds as many objects as can be had.
    """
    session = open_session(path)
    detector = Detector(network).eval()
    parity = Parity()
    for batch in _batches(network.config.canvas, pictures):
        with torch.inference_mode():
            expected = [tensor.numpy() for tensor in detector(torch.from_numpy(batch))]
        actual = session.run(list(signature.OUTPUTS), {signature.INPUT: batch})
        for i, image in enumerate(batch):
            truth = [e[i] for e in expected]
            found = _difference(truth, [a[i] for a in actual], image.shape[:2])
            if found.problem() is not None and _hinges_on_rounding(detector, image, truth):
                found = Parity(images=1, undecided=1)
            parity |= found
        counts = expected[-1].tolist()
        parity.cases.append(
            {"size": list(batch.shape[1:3]), "batch": len(batch), "detections": counts}
        )
    return parity


def _hinges_on_rounding(detector: Detector, image: Image, expected: list[NDArray[Any]]) -> bool:
    """Whether the network finds something else in an image [H, W, 3] by itself, without those it
    shared a batch with, or changed by up to a 400th of a grey level."""
    canvas, geometry = letterbox(torch.from_numpy(image)[None], *detector.network.config.canvas)
    generator = torch.Generator().manual_seed(0)
    for disturbance in _DISTURBANCES:
        noise = disturbance * (2 * torch.rand(canvas.shape, generator=generator) - 1)
        with torch.inference_mode():
            found = [tensor[0].numpy() for tensor in detector.on_canvas(canvas + noise, geometry)]
        pairs = _pairs(expected, found)
        if pairs is None or any(np.abs(expected[0][i] - found[0][j]).max() > 1.0 for i, j in pairs):
            return True
    return False


def _batches(canvas: tuple[int, int], pictures: Sequence[Image]) -> list[Image]:
    rows, columns = canvas
    sizes = (
        (rows, columns),
        (columns * 5 // 4, rows * 3 // 2),
        (rows * 2 // 3 + 1, columns * 3 // 4 + 2),
    )
    batches = []
    for (height, width), batch in zip(sizes, (4, 2, 1), strict=True):
        scene = [_resize(pictures[i % len(pictures)], height, width) for i in range(4)]
        batches += [np.stack(scene[i : i + batch]) for i in range(0, 4, batch)]
    tiles = [_resize(pictures[i % len(pictures)], rows, columns) for i in range(_MOSAIC**2)]
    mosaic = np.concatenate(
        [np.concatenate(tiles[i : i + _MOSAIC], axis=1) for i in range(0, len(tiles), _MOSAIC)],
        axis=0,
    )
    return [*batches, np.zeros((1, rows, columns, 3), np.uint8), mosaic[None]]


def _difference(
    expected: list[NDArray[Any]], actual: list[NDArray[Any]], size: tuple[int, int]
) -> Parity:
    """The outputs of one image held against each other.

    Rows of nearly equal score may stand in another order: each is compared with its nearest box of
    the same label.
    """
    pairs = _pairs(expected, actual)
    if pairs is None:
        return Parity(dict.fromkeys(TOLERANCES, math.inf), detections=int(expected[-1]), images=1)
    parity = Parity(detections=len(pairs), images=1)
    fields = dict(zip(signature.OUTPUTS, zip(expected, actual, strict=True), strict=True))
    for name in TOLERANCES:
        truth, value = fields[name]
        padding = [
            float(np.abs(side[len(pairs) :]).max(initial=0.0)) for side in (truth, value)
        ]  # zero on both sides
        rows = [float(np.abs(truth[i] - value[j]).max()) for i, j in pairs]
        parity.max_difference[name] = max([*padding, *rows])
    (boxes, other_boxes), (masks, other_masks) = fields["boxes"], fields["masks"]
    for i, j in pairs:
        mask, other = (
            paste_roi_mask(masks[i], boxes[i], size),
            paste_roi_mask(other_masks[j], other_boxes[j], size),
        )
        union = int((mask | other).sum())
        if union > 100:  # a pixel of a smaller one that flips is rounding, not a difference
            parity.mask_iou = min(parity.mask_iou, int((mask & other).sum()) / union)
    return parity


def _pairs(
    expected: list[NDArray[Any]], actual: list[NDArray[Any]]
) -> list[tuple[int, int]] | None:
    """Rows of the same detection on both sides; None where the detections are not the same."""
    (boxes, labels), (other_boxes, other_labels) = expected[:2], actual[:2]
    count = int(expected[-1])
    if int(actual[-1]) != count:
        return None
    free = list(range(count))
    pairs = []
    for row in range(count):
        same = [j for j in free if other_labels[j] == labels[row]]
        if not same:
            return None
        partner = min(same, key=lambda j: float(np.abs(other_boxes[j] - boxes[row]).max()))
        free.remove(partner)
        pairs.append((row, partner))
    return pairs


def _resize(picture: Image, height: int, width: int) -> Image:
    return np.asarray(
        cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )
