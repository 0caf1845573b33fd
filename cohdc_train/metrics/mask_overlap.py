"""Scores from mask IoU: mIoU, the paper's S > 90, and the calibration of the predicted quality."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle
from scipy.stats import spearmanr

from cohdc_train.metrics.rle import to_rle
from cohdc_train.types import Row

MATCH_IOU = 0.5  # mask IoU from which a detection counts as having found an object
MIN_SCORE = 0.5  # class score from which a detection counts for the quality's calibration
HIGH_QUALITY = 0.9  # S > 90


def match_greedily(
    overlaps: NDArray[np.float64],
    allowed: NDArray[np.bool_] | None = None,
    matched: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Match detections to objects as COCO does: the best score first takes what it overlaps most.

    A match needs a mask IoU of at least MATCH_IOU; each detection and each object is matched once.

    Args:
        overlaps: [D, G] mask IoU of detections, best score first, and objects.
        allowed: [D, G] pairs that may match; None allows all.
        matched: [G] result of an earlier call, whose matches stay.

    Returns:
        [G] index of each object's detection, -1 where there is none.
    """
    result = np.full(overlaps.shape[1], -1, np.int64) if matched is None else matched.copy()
    for i, overlap in enumerate(overlaps):
        is_free = result < 0
        if allowed is not None:
            is_free &= allowed[i]
        candidates = np.where(is_free, overlap, 0.0)
        if i not in result and candidates.max(initial=0.0) >= MATCH_IOU:
            result[candidates.argmax()] = i
    return result


def mask_ious(
    detections: Sequence[Row], shapes: Sequence[Any], crowd: bool = False
) -> NDArray[np.float64]:
    """Compute [D, G] mask IoU; with a crowd the share of the detection that lies in it.

    Args:
        detections: COCO result rows.
        shapes: compressed RLEs.
        crowd: whether the shapes are crowds.
    """
    if not detections or not shapes:
        return np.zeros((len(detections), len(shapes)))
    masks = [row["segmentation"] for row in detections]
    return np.asarray(rle.iou(masks, list(shapes), [int(crowd)] * len(shapes)), np.float64)


def match_masks(ground_truth: Mapping[str, Any], results: Iterable[Row]) -> NDArray[np.float64]:
    """Compute the mask IoU of each object with its detection, by `match_greedily` in each class.

    Args:
        ground_truth: COCO dict.
        results: COCO result rows.

    Returns:
        [objects without crowds] mask IoU, 0 where no detection matches.
    """
    detections: dict[tuple[int, int], list[Row]] = defaultdict(list)
    for row in sorted(results, key=lambda row: -row["score"]):
        detections[row["image_id"], row["category_id"]].append(row)
    ious = [np.zeros(0)]
    for key, shapes in _objects(ground_truth).items():
        overlaps = mask_ious(detections[key], shapes)
        matched = match_greedily(overlaps)
        is_found = matched >= 0
        iou = np.zeros(len(shapes))
        iou[is_found] = overlaps[matched[is_found], np.flatnonzero(is_found)]
        ious.append(iou)
    return np.concatenate(ious)


def overlap_scores(overlaps: NDArray[np.float64]) -> dict[str, float]:
    """Compute mIoU and S > 90 of the IoUs that `match_masks` returns.

    mIoU is the mean over all objects, and a missed one counts 0. S90_matched is the share of the
    found objects whose mask IoU exceeds .9, S90_all the share of all objects: the paper gives no
    denominator.
    """
    if not len(overlaps):
        return {"mIoU": np.nan, "S90_matched": np.nan, "S90_all": np.nan}
    num_high = int((overlaps > HIGH_QUALITY).sum())
    num_matched = int((overlaps > 0).sum())
    return {
        "mIoU": float(overlaps.mean()),
        "S90_matched": num_high / num_matched if num_matched else np.nan,
        "S90_all": num_high / len(overlaps),
    }


def calibration(ground_truth: Mapping[str, Any], rows: Iterable[Row]) -> dict[str, float]:
    """Compare the predicted quality with the true mask IoU, over `quality_pairs`.

    Returns:
        quality_spearman, the rank correlation, and quality_error, the mean absolute difference. nan
        where there are fewer than three pairs, or all are equal.
    """
    quality, true_iou = quality_pairs(ground_truth, rows).T
    if len(quality) < 3:
        return {"quality_spearman": np.nan, "quality_error": np.nan}
    varies = np.ptp(quality) > 0 and np.ptp(true_iou) > 0
    return {
        "quality_spearman": float(spearmanr(quality, true_iou).statistic) if varies else np.nan,
        "quality_error": float(np.abs(quality - true_iou).mean()),
    }


def quality_pairs(ground_truth: Mapping[str, Any], rows: Iterable[Row]) -> NDArray[np.float64]:
    """Return predicted quality and true mask IoU of the detections with a score of at least .5.

    The true IoU is the largest with an object of the same image and class, without crowds; 0 where
    there is no object.

    Returns:
        [n, 2] quality, true mask IoU.
    """
    objects = _objects(ground_truth)
    pairs = []
    for row in rows:
        if row["score"] >= MIN_SCORE:
            shapes = objects.get((row["image_id"], row["category_id"]), [])
            pairs.append((row["quality"], float(mask_ious([row], shapes).max(initial=0.0))))
    return np.array(pairs).reshape(-1, 2)


def _objects(ground_truth: Mapping[str, Any]) -> dict[tuple[int, int], list[Any]]:
    """Return the compressed RLEs of objects without crowds, by (image id, category id)."""
    sizes = {image["id"]: (image["height"], image["width"]) for image in ground_truth["images"]}
    objects: dict[tuple[int, int], list[Any]] = defaultdict(list)
    for row in ground_truth["annotations"]:
        if not row["iscrowd"]:
            shape = to_rle(row["segmentation"], sizes[row["image_id"]])
            objects[row["image_id"], row["category_id"]].append(shape)
    return objects
