"""Scores of instance segmentation: COCO AP of boxes, masks and their boundaries, mIoU, the paper's
S > 90 (section 3.1, Table 4), and how well CQE's quality tells the true IoU."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from faster_coco_eval import COCO, COCOeval_faster
from numpy.typing import NDArray
from pycocotools import mask as rle
from scipy.stats import spearmanr
from torch import Tensor

from cohdc_train.masks import roi_window
from cohdc_train.metrics.rle import boundary_rle, to_rle, window_boundary, window_rle
from cohdc_train.types import Row

MATCH_IOU = 0.5  # mask IoU from which a detection counts as having found an object
HIGH_QUALITY = 0.9  # S > 90
CERTAIN = 0.5  # class score from which a detection counts for the quality's calibration
IOUS = np.linspace(0.5, 0.95, 10)  # COCO's thresholds
RECALLS = np.linspace(0.0, 1.0, 101)  # COCO's recalls, at which it takes the precision
_MAX_DETECTIONS = 100  # per image, COCO's

Kind = Literal["segm", "boundary", "bbox"]


def encode(image_id: int, size: tuple[int, int], detections: Mapping[str, Tensor]) -> list[Row]:
    """COCO result rows of one image, best score first.

    size: (height, width) px; detections: `boxes` [n, 4] xyxy px of the image, `labels` [n] 0-based,
    `scores` [n], `quality` [n], `masks` [n, M, M] RoI probabilities. A row has image_id,
    category_id from 1, score, quality, bbox xywh, and as compressed RLE segmentation, the pasted
    mask, and boundary, the band along its contour.
    """
    arrays = {name: value.detach().float().cpu().numpy() for name, value in detections.items()}
    rows = []
    for i in np.argsort(-arrays["scores"], kind="stable")[:_MAX_DETECTIONS]:
        x0, y0, x1, y1 = (float(v) for v in arrays["boxes"][i])
        window, corner = roi_window(arrays["masks"][i], arrays["boxes"][i], size)
        rows.append(
            {
                "image_id": image_id,
                "category_id": int(arrays["labels"][i]) + 1,
                "score": float(arrays["scores"][i]),
                "quality": float(arrays["quality"][i]),
                "bbox": [x0, y0, x1 - x0, y1 - y0],
                "segmentation": window_rle(window, corner, size),
                "boundary": window_rle(window_boundary(window, size), corner, size),
            }
        )
    return rows


@dataclass(frozen=True)
class Results:
    """What one validation found, over every process: what its scores, and pictures of it, are made
    of.

    Attributes:
        truth: the ground truth's COCO dict, with the images seen.
        rows: `encode`'s rows of all detections.
        kept: those of `rows` that the scores count, by `min_quality`.
        precision: [IOUS, RECALLS, C] of masks, as `precision_table` gives it.
        scores: name -> value.
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
        min_quality: detections of a lower quality are left out of every score but the quality's own
            calibration; the paper's filter is .9.
    """

    def __init__(
        self, ground_truth: Mapping[str, Any], rescore: bool = True, min_quality: float = 0.0
    ) -> None:
        self.ground_truth = ground_truth
        self.rescore = rescore
        self.min_quality = min_quality
        self._seen: dict[int, list[Row]] = {}
        self._boundaries: dict[int, Any] = {}  # of annotations, by id: the same in every epoch
        self._sizes = {
            int(i["id"]): (int(i["height"]), int(i["width"])) for i in ground_truth["images"]
        }

    def update(self, image_id: int, detections: Mapping[str, Tensor]) -> None:
        """Take the detections of one image (see `encode`); a second visit of the same image
        replaces the first.
        """
        self._seen[image_id] = encode(image_id, self._sizes[image_id], detections)

    def reset(self) -> None:
        """Forget the detections, to score another network on the same ground truth."""
        self._seen = {}

    def compute(self) -> dict[str, float]:
        """The scores of `results`."""
        return self.results().scores

    def results(self) -> Results:
        """Score every image seen by any process; every process must call it.

        {segm,boundary,box}_{AP,AP50,AP70}, mIoU, S90_matched, S90_all, quality_{spearman,error},
        and with several classes segm_AP/NAME of each that has objects. A score whose denominator is
        empty (no object, no match) is nan.
        """
        seen = _gather(self._seen)
        truth = _restrict(self.ground_truth, seen)
        for row in truth["annotations"]:
            if row["id"] not in self._boundaries:
                self._boundaries[row["id"]] = boundary_rle(
                    row["segmentation"], self._sizes[row["image_id"]]
                )
            row["boundary"] = self._boundaries[row["id"]]
        everything = [row for image_id in sorted(seen) for row in seen[image_id]]
        rows = [row for row in everything if row["quality"] >= self.min_quality]
        boxes = [{k: row[k] for k in ("image_id", "category_id", "score", "bbox")} for row in rows]
        masks = [_mask_row(row, self.rescore) for row in rows]
        precision = precision_table(truth, masks, "segm")
        scores = {f"segm_{name}": value for name, value in _averages(truth, precision).items()}
        kinds: tuple[tuple[str, Kind, list[Row]], ...] = (
            ("boundary", "boundary", masks),
            ("box", "bbox", boxes),
        )
        for prefix, kind, results in kinds:
            averages = average_precision(truth, results, kind)
            scores.update(
                {f"{prefix}_{name}": value for name, value in averages.items() if "/" not in name}
            )
        scores |= overlap_scores(match_masks(truth, masks)) | calibration(truth, everything)
        return Results(truth, everything, rows, precision, scores)


def average_precision(
    ground_truth: Mapping[str, Any], results: Sequence[Row], kind: Kind
) -> dict[str, float]:
    """COCO's AP (IoU .5:.95), AP50 (the paper's mAP@.5) and AP70 (mAP@.7), mean over the classes
    that have objects.

    With several classes also AP/NAME of each that has objects. "boundary" takes the smaller of mask
    IoU and Boundary IoU (Cheng et al. 2021, band of 2 % of the image's diagonal). Crowd objects are
    ignored as COCO does; at most 100 detections per image. nan without any object.
    """
    return _averages(ground_truth, precision_table(ground_truth, results, kind))


def precision_table(
    ground_truth: Mapping[str, Any], results: Sequence[Row], kind: Kind
) -> NDArray[np.float64]:
    """COCO's precision [IOUS, RECALLS, C]: the best that is reached at this recall or a higher one;
    -1 in a class without objects. Arguments as in `average_precision`."""
    sizes = {image["id"]: (image["height"], image["width"]) for image in ground_truth["images"]}
    annotations, found = (
        [dict(row) for row in rows] for rows in (ground_truth["annotations"], results)
    )
    for row in [*annotations, *found] if kind == "boundary" else []:
        row["boundary"] = row.get("boundary") or boundary_rle(
            row["segmentation"], sizes[row["image_id"]]
        )
    truth = COCO(
        {
            **{key: list(ground_truth[key]) for key in ("images", "categories")},
            "annotations": annotations,
        }
    )
    evaluation = _Evaluation(truth, truth.loadRes(found), kind, print_function=_silent)
    evaluation.evaluate()
    evaluation.accumulate()
    return np.asarray(evaluation.eval["precision"])[:, :, :, 0, -1]  # all areas, all detections


def _averages(ground_truth: Mapping[str, Any], precision: NDArray[np.float64]) -> dict[str, float]:
    names = category_names(ground_truth)
    per_class = {
        f"AP/{name}": mean_valid(precision[:, :, i])
        for i, name in enumerate(names)
        if len(names) > 1
    }
    return {
        **{name: value for name, value in per_class.items() if not np.isnan(value)},
        "AP": mean_valid(precision),
        "AP50": mean_valid(precision[np.isclose(IOUS, 0.5)]),
        "AP70": mean_valid(precision[np.isclose(IOUS, 0.7)]),
    }


def match_masks(ground_truth: Mapping[str, Any], results: Iterable[Row]) -> NDArray[np.float64]:
    """Mask IoU of every object with the detection that found it: [objects without crowd], 0 where
    none did.

    As COCO matches at IoU >= .5: in each image and class, detections from the best score down take
    the free object they overlap most.
    """
    found: dict[tuple[int, int], list[Row]] = defaultdict(list)
    for row in results:
        found[row["image_id"], row["category_id"]].append(row)
    objects = _objects(ground_truth)
    return np.concatenate(
        [np.zeros(0), *(_match(shapes, found[key]) for key, shapes in objects.items())]
    )


def calibration(ground_truth: Mapping[str, Any], rows: Iterable[Row]) -> dict[str, float]:
    """How well `quality` tells the true mask IoU, over `quality_pairs`.

    quality_spearman: rank correlation; quality_error: mean absolute difference. nan where there are
    fewer than three, or all the same.
    """
    quality, true = quality_pairs(ground_truth, rows).T
    if len(quality) < 3:
        return {"quality_spearman": np.nan, "quality_error": np.nan}
    ranked = np.ptp(quality) > 0 and np.ptp(true) > 0
    return {
        "quality_spearman": float(spearmanr(quality, true).statistic) if ranked else np.nan,
        "quality_error": float(np.abs(quality - true).mean()),
    }


def quality_pairs(ground_truth: Mapping[str, Any], rows: Iterable[Row]) -> NDArray[np.float64]:
    """[n, 2] quality and true mask IoU of the detections of class score .5 and more (`encode`'s
    rows).

    The true IoU is the largest with an object of the same image and class, crowds left out; 0
    without one.
    """
    objects = _objects(ground_truth)
    pairs = []
    for row in rows:
        if row["score"] >= CERTAIN:
            shapes = objects.get((row["image_id"], row["category_id"]), [])
            overlap = (
                rle.iou([row["segmentation"]], shapes, [0] * len(shapes)) if shapes else np.zeros(1)
            )
            pairs.append((row["quality"], float(np.max(overlap))))
    return np.array(pairs).reshape(-1, 2)


def _objects(ground_truth: Mapping[str, Any]) -> dict[tuple[int, int], list[Any]]:
    """(image id, category id) -> compressed RLE of its objects that are no crowd."""
    sizes = {image["id"]: (image["height"], image["width"]) for image in ground_truth["images"]}
    objects: dict[tuple[int, int], list[Any]] = defaultdict(list)
    for row in ground_truth["annotations"]:
        if not row["iscrowd"]:
            shape = to_rle(row["segmentation"], sizes[row["image_id"]])
            objects[row["image_id"], row["category_id"]].append(shape)
    return objects


def overlap_scores(overlaps: NDArray[np.float64]) -> dict[str, float]:
    """mIoU and S > 90 of `match_masks`' result.

    mIoU: mean over all objects, missed ones counting 0. S90_matched: share of the objects found
    whose mask IoU exceeds .9; S90_all: the same over all objects. The paper gives no denominator,
    hence both.
    """
    if not len(overlaps):
        return {"mIoU": np.nan, "S90_matched": np.nan, "S90_all": np.nan}
    high = int((overlaps > HIGH_QUALITY).sum())
    matched = int((overlaps > 0).sum())
    return {
        "mIoU": float(overlaps.mean()),
        "S90_matched": high / matched if matched else np.nan,
        "S90_all": high / len(overlaps),
    }


def _match(shapes: list[Any], rows: list[Row]) -> NDArray[np.float64]:
    """IoU of each object of one image and class with its detection, 0 where there is none."""
    best = np.zeros(len(shapes))
    if not rows:
        return best
    rows = sorted(rows, key=lambda row: -row["score"])
    overlaps = np.asarray(rle.iou([row["segmentation"] for row in rows], shapes, [0] * len(shapes)))
    for overlap in overlaps:
        free = np.where(best > 0, 0.0, overlap)
        j = int(free.argmax())
        if free[j] >= MATCH_IOU:
            best[j] = free[j]
    return best


def _mask_row(row: Row, rescore: bool) -> Row:
    score = row["score"] * row["quality"] if rescore else row["score"]
    return {
        **{k: row[k] for k in ("image_id", "category_id", "segmentation", "boundary")},
        "score": score,
    }


def _restrict(ground_truth: Mapping[str, Any], seen: Mapping[int, Any]) -> dict[str, Any]:
    """The part of a COCO dict that belongs to the images seen."""
    return {
        "images": [image for image in ground_truth["images"] if image["id"] in seen],
        "categories": ground_truth["categories"],
        "annotations": [
            dict(row) for row in ground_truth["annotations"] if row["image_id"] in seen
        ],
    }


def _gather(seen: dict[int, list[Row]]) -> dict[int, list[Row]]:
    """Every process' images; the sampler hands some out twice, to make the shares equal, and they
    count once.
    """
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return seen
    parts: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(parts, seen)
    return {image_id: rows for part in parts for image_id, rows in part.items()}


def category_names(ground_truth: Mapping[str, Any]) -> list[str]:
    """Names of a COCO dict's categories, by id."""
    return [
        str(row["name"]) for row in sorted(ground_truth["categories"], key=lambda row: row["id"])
    ]


def mean_valid(precision: NDArray[np.float64]) -> float:
    """Mean over the classes that have objects; nan where there is none."""
    valid = precision[precision > -1]  # -1 marks classes without objects
    return float(valid.mean()) if valid.size else np.nan


class _Evaluation(COCOeval_faster):  # type: ignore[misc]  # faster-coco-eval is not typed
    """Takes the boundaries that rows bring; faster-coco-eval traces them over the whole image, for
    every epoch anew.
    """

    def _prepare(self) -> None:
        bounded, self.params.compute_boundary = self.params.compute_boundary, False
        super()._prepare()
        self.params.compute_boundary = bounded


def _silent(*_: object) -> None:
    """faster-coco-eval reports its progress through this."""
