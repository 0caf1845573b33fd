"""Scores of instance segmentation over a validation: AP, mIoU, S > 90, calibration of the quality.

The scores are those of the paper's section 3.1 and Table 4, with COCO's definitions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cohdc_train.metrics.average_precision import (
    IouType,
    average_precision,
    averages,
    precision_table,
)
from cohdc_train.metrics.detection_rows import encode_detections
from cohdc_train.metrics.mask_overlap import calibration, match_masks, overlap_scores
from cohdc_train.metrics.rle import boundary_rle
from cohdc_train.types import Row


@dataclass(frozen=True)
class Results:
    """Detections of one validation, over all processes, and their scores.

    Attributes:
        truth: the ground truth's COCO dict, with the images seen.
        rows: rows of all detections, from `encode_detections`.
        kept: those of `rows` that the scores count, by `min_quality`.
        precision: [IOUS, RECALLS, C] of masks, as `precision_table` returns it.
        scores: values by name.
    """

    truth: Mapping[str, Any]
    rows: list[Row]
    kept: list[Row]
    precision: NDArray[np.float64]
    scores: dict[str, float]


class SegmentationMetrics:
    """Collects detections image by image and scores them against a COCO dict.

    Args:
        ground_truth: `images`, `categories` with ids 1..C, `annotations`; only the images that were
            seen are scored.
        rescore: mask AP ranks by score * quality (Mask Scoring R-CNN) instead of by score; box AP
            never does.
        min_quality: detections of a lower quality are dropped from all scores but the calibration
            of the quality itself; the paper's filter is .9.
    """

    def __init__(
        self, ground_truth: Mapping[str, Any], rescore: bool = True, min_quality: float = 0.0
    ) -> None:
        """Start without detections."""
        self.ground_truth = ground_truth
        self.rescore = rescore
        self.min_quality = min_quality
        self._seen: dict[int, list[Row]] = {}
        self._boundaries: dict[int, Any] = {}  # of annotations, by id: equal in every epoch
        self._sizes = {
            int(image["id"]): (int(image["height"]), int(image["width"]))
            for image in ground_truth["images"]
        }

    def update(self, image_id: int, detections: Mapping[str, Tensor]) -> None:
        """Store the detections of one image; a second call for an image replaces the first.

        Args:
            image_id: id of the image in the ground truth.
            detections: as `encode_detections` takes them.
        """
        self._seen[image_id] = encode_detections(image_id, self._sizes[image_id], detections)

    def reset(self) -> None:
        """Forget the detections, to score another network on the same ground truth."""
        self._seen = {}

    def compute(self) -> dict[str, float]:
        """Return the scores of `results`."""
        return self.results().scores

    def results(self) -> Results:
        """Score all images that any process has seen; every process must call it.

        Scores are {segm,boundary,box}_{AP,AP50,AP70}, mIoU, S90_matched, S90_all,
        quality_{spearman,error}, and with several classes segm_AP/NAME of each that has objects. A
        score with an empty denominator (no object, no match) is nan.
        """
        seen = _gather(self._seen)
        truth = self._truth_of(seen)
        rows = [row for image_id in sorted(seen) for row in seen[image_id]]
        kept = [row for row in rows if row["quality"] >= self.min_quality]
        masks = [_mask_row(row, self.rescore) for row in kept]

        precision = precision_table(truth, masks, "segm")
        scores = {f"segm_{name}": value for name, value in averages(truth, precision).items()}
        scores |= _class_mean_scores(truth, masks, "boundary", "boundary")
        scores |= _class_mean_scores(truth, [_box_row(row) for row in kept], "bbox", "box")
        scores |= overlap_scores(match_masks(truth, masks))
        scores |= calibration(truth, rows)
        return Results(truth, rows, kept, precision, scores)

    def _truth_of(self, seen: Mapping[int, Any]) -> dict[str, Any]:
        """Return the part of the ground truth that belongs to the images seen, with boundaries."""
        annotations = []
        for row in self.ground_truth["annotations"]:
            if row["image_id"] not in seen:
                continue
            if row["id"] not in self._boundaries:
                size = self._sizes[row["image_id"]]
                self._boundaries[row["id"]] = boundary_rle(row["segmentation"], size)
            annotations.append({**row, "boundary": self._boundaries[row["id"]]})
        return {
            "images": [image for image in self.ground_truth["images"] if image["id"] in seen],
            "categories": self.ground_truth["categories"],
            "annotations": annotations,
        }


def _class_mean_scores(
    truth: Mapping[str, Any], rows: Sequence[Row], iou_type: IouType, prefix: str
) -> dict[str, float]:
    """Return prefix_AP, prefix_AP50 and prefix_AP70, without those of single classes."""
    scores = average_precision(truth, rows, iou_type)
    return {f"{prefix}_{name}": value for name, value in scores.items() if "/" not in name}


def _mask_row(row: Row, rescore: bool) -> Row:
    fields = {key: row[key] for key in ("image_id", "category_id", "segmentation", "boundary")}
    score = row["score"] * row["quality"] if rescore else row["score"]
    return {**fields, "score": score}


def _box_row(row: Row) -> Row:
    return {key: row[key] for key in ("image_id", "category_id", "score", "bbox")}


def _gather(seen: dict[int, list[Row]]) -> dict[int, list[Row]]:
    """Collect the images of all processes.

    The sampler hands some images out twice, to make the shares equal; they count once.
    """
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return seen
    parts: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(parts, seen)
    return {image_id: rows for part in parts for image_id, rows in part.items()}
