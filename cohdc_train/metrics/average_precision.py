"""COCO's average precision of boxes, masks and mask boundaries."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from faster_coco_eval import COCO, COCOeval_faster
from numpy.typing import NDArray

from cohdc_train.metrics.rle import boundary_rle
from cohdc_train.types import Row

IOUS = np.linspace(0.5, 0.95, 10)  # COCO's thresholds
RECALLS = np.linspace(0.0, 1.0, 101)  # COCO's recalls, at which it takes the precision

IouType = Literal["segm", "boundary", "bbox"]


def average_precision(
    ground_truth: Mapping[str, Any], results: Sequence[Row], iou_type: IouType
) -> dict[str, float]:
    """Compute COCO's AP (IoU .5:.95), AP50 and AP70, mean over the classes that have objects.

    AP50 and AP70 are the paper's mAP@.5 and mAP@.7. Crowd objects are ignored as COCO does, and at
    most 100 detections per image count.

    Args:
        ground_truth: COCO dict with `images`, `categories` and `annotations`.
        results: COCO result rows.
        iou_type: "segm" matches by mask IoU, "bbox" by box IoU, and "boundary" by the smaller of
            mask IoU and Boundary IoU (Cheng et al. 2021, band of 2 % of the image's diagonal).

    Returns:
        AP, AP50, AP70, and with several classes AP/NAME of each that has objects. nan without any
        object.
    """
    return averages(ground_truth, precision_table(ground_truth, results, iou_type))


def precision_table(
    ground_truth: Mapping[str, Any], results: Sequence[Row], iou_type: IouType
) -> NDArray[np.float64]:
    """Compute COCO's precision for each IoU, recall and class.

    Args:
        ground_truth: COCO dict with `images`, `categories` and `annotations`.
        results: COCO result rows.
        iou_type: as in `average_precision`.

    Returns:
        [IOUS, RECALLS, C] best precision at this recall or a higher one; -1 in a class without
        objects.
    """
    annotations = [dict(row) for row in ground_truth["annotations"]]
    detections = [dict(row) for row in results]
    if iou_type == "boundary":
        _add_boundaries([*annotations, *detections], ground_truth)
    content = {key: list(ground_truth[key]) for key in ("images", "categories")}
    truth = COCO({**content, "annotations": annotations})
    evaluation = _Evaluation(truth, truth.loadRes(detections), iou_type, print_function=_silent)
    evaluation.evaluate()
    evaluation.accumulate()
    return np.asarray(evaluation.eval["precision"])[:, :, :, 0, -1]  # all areas, all detections


def averages(ground_truth: Mapping[str, Any], precision: NDArray[np.float64]) -> dict[str, float]:
    """Average a precision table: AP, AP50, AP70, and AP/NAME of each of several classes.

    Args:
        ground_truth: COCO dict, for the names of the classes.
        precision: [IOUS, RECALLS, C] as `precision_table` returns it.
    """
    names = category_names(ground_truth)
    scores = {}
    if len(names) > 1:
        per_class = {f"AP/{name}": mean_valid(precision[:, :, i]) for i, name in enumerate(names)}
        scores = {name: value for name, value in per_class.items() if not np.isnan(value)}
    scores["AP"] = mean_valid(precision)
    scores["AP50"] = mean_valid(precision[np.isclose(IOUS, 0.5)])
    scores["AP70"] = mean_valid(precision[np.isclose(IOUS, 0.7)])
    return scores


def mean_valid(precision: NDArray[np.float64]) -> float:
    """Average over the classes that have objects; nan where there is none."""
    valid = precision[precision > -1]  # -1 marks classes without objects
    return float(valid.mean()) if valid.size else np.nan


def category_names(ground_truth: Mapping[str, Any]) -> list[str]:
    """Return the names of a COCO dict's categories, by id."""
    categories = sorted(ground_truth["categories"], key=lambda row: row["id"])
    return [str(row["name"]) for row in categories]


def _add_boundaries(rows: Sequence[Row], ground_truth: Mapping[str, Any]) -> None:
    """Compute the boundary of each row that has none yet, in place."""
    sizes = {image["id"]: (image["height"], image["width"]) for image in ground_truth["images"]}
    for row in rows:
        if not row.get("boundary"):
            row["boundary"] = boundary_rle(row["segmentation"], sizes[row["image_id"]])


class _Evaluation(COCOeval_faster):  # type: ignore[misc]  # faster-coco-eval is not typed
    """COCO evaluation on boundaries that the rows bring.

    faster-coco-eval itself traces them over the whole image, again in every epoch.
    """

    def _prepare(self) -> None:
        computes_boundary = self.params.compute_boundary
        self.params.compute_boundary = False
        super()._prepare()
        self.params.compute_boundary = computes_boundary


def _silent(*_: object) -> None:
    """Drop what faster-coco-eval prints of its progress."""
