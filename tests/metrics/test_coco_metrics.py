"""Scores against pycocotools, and against answers worked out by hand."""

import contextlib
import io
import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pycocotools import mask as rle
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from cohdc_train.metrics.average_precision import average_precision
from cohdc_train.metrics.coco_metrics import SegmentationMetrics
from cohdc_train.metrics.detection_rows import encode_detections
from cohdc_train.metrics.mask_overlap import calibration, match_masks, overlap_scores

SIZE = (60, 80)


def rle_of(mask: NDArray[Any]) -> dict[str, Any]:
    encoded = rle.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(encoded["size"]), "counts": encoded["counts"].decode()}


def blob(rng: np.random.Generator) -> NDArray[np.uint8]:
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    cy, cx, ry, rx = (
        rng.uniform(10, 50),
        rng.uniform(10, 70),
        rng.uniform(4, 15),
        rng.uniform(4, 20),
    )
    return (((y - cy) / ry) ** 2 + ((x - cx) / rx) ** 2 < 1).astype(np.uint8)


def row_of(mask: NDArray[np.uint8], **more: Any) -> dict[str, Any]:
    shape = rle_of(mask)
    return {"segmentation": shape, "bbox": [float(v) for v in rle.toBbox(shape)], **more}


def random_problem(seed: int) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Make ground truth and jittered detections.

    There is a crowd, a class without objects and an image without objects.
    """
    rng = np.random.default_rng(seed)
    truth: dict[str, Any] = {
        "images": [],
        "annotations": [],
        "categories": [{"id": i, "name": f"c{i}"} for i in (1, 2, 3)],
    }
    results = []
    for image_id in range(1, 9):
        truth["images"].append({"id": image_id, "height": SIZE[0], "width": SIZE[1]})
        for _ in range(int(rng.integers(0, 5))):
            mask, category = blob(rng), int(rng.integers(1, 3))
            row = row_of(
                mask, id=len(truth["annotations"]) + 1, image_id=image_id, category_id=category
            )
            truth["annotations"].append(
                {**row, "area": float(mask.sum()), "iscrowd": int(rng.random() < 0.2)}
            )
            for _ in range(int(rng.integers(0, 3))):
                moved = np.roll(mask, tuple(rng.integers(-4, 5, 2)), (0, 1))
                score = float(rng.random())
                results.append(row_of(moved, image_id=image_id, category_id=category, score=score))
        results.append(
            row_of(blob(rng), image_id=image_id, category_id=1, score=float(rng.random()))
        )
    return truth, results


def reference(truth: dict[str, Any], results: list[dict[str, Any]], kind: str) -> dict[str, float]:
    with contextlib.redirect_stdout(io.StringIO()):
        gt = COCO()
        gt.dataset = {**truth, "info": {}}
        gt.createIndex()
        evaluation = COCOeval(gt, gt.loadRes([dict(r) for r in results]), kind)
        evaluation.evaluate()
        evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, :, 0, -1]
    values = {"AP": precision, "AP50": precision[0], "AP70": precision[4]}
    return {name: float(v[v > -1].mean()) for name, v in values.items()}


@pytest.mark.parametrize("kind", ["segm", "bbox"])
@pytest.mark.parametrize("seed", range(3))
def test_average_precision_equals_pycocotools(seed: int, kind: Any) -> None:
    truth, results = random_problem(seed)
    keys = ("image_id", "category_id", "score", "segmentation" if kind == "segm" else "bbox")
    rows = [{k: r[k] for k in keys} for r in results]
    ours, theirs = average_precision(truth, rows, kind), reference(truth, rows, kind)
    assert 0 < theirs["AP"] < 1
    per_class = [ours.pop(name) for name in ("AP/c1", "AP/c2")]  # c3 has no objects
    assert ours == pytest.approx(theirs, abs=1e-6)
    assert np.mean(per_class) == pytest.approx(theirs["AP"], abs=1e-6)


def band(mask: NDArray[np.uint8], width: int) -> NDArray[np.bool_]:
    """Return the pixels of a mask near one outside of it, or near the image's edge.

    width: rows and columns that are near.
    """
    inner = np.ones(mask.shape, np.bool_)
    padded = np.pad(mask, width)
    for dy in range(2 * width + 1):
        for dx in range(2 * width + 1):
            inner &= padded[dy : dy + mask.shape[0], dx : dx + mask.shape[1]] > 0
    return (mask > 0) & ~inner


@pytest.mark.parametrize("shift", [0, 1, 2, 3, 5])
def test_boundary_ap_takes_the_smaller_of_mask_and_boundary_iou(shift: int) -> None:
    truth, seen = square(20, 15, 30), square(20 + shift, 15, 30)
    edges = [band(mask, 2) for mask in (truth, seen)]  # 2 % of a diagonal of 100 px
    ious = [(a & b).sum() / (a | b).sum() for a, b in ((truth > 0, seen > 0), edges)]
    passed = sum(min(ious) >= threshold for threshold in np.arange(0.5, 1.0, 0.05) - 1e-9)
    row = row_of(seen, image_id=7, category_id=1, score=0.9)
    found = average_precision(truth_of(truth), [row], "boundary")
    assert found["AP"] == pytest.approx(passed / 10)


def test_calibration_compares_quality_with_the_true_iou() -> None:
    truth = truth_of(square(10, 10, 20), square(50, 10, 20))
    moved = [square(10, 10, 20), square(50, 14, 20), square(10, 40, 10), square(50, 10, 20)]
    true = [1.0, 320 / 480, 0.0, 1.0]
    quality, scores = (
        [0.9, 0.7, 0.2, 0.1],
        [0.9, 0.8, 0.7, 0.4],
    )  # the last is not sure enough to count
    rows = [
        row_of(m, image_id=7, category_id=1, score=s, quality=q)
        for m, s, q in zip(moved, scores, quality, strict=True)
    ]
    found = calibration(truth, rows)
    assert found["quality_spearman"] == pytest.approx(1.0)
    assert found["quality_error"] == pytest.approx(np.mean(np.abs(np.subtract(quality, true))[:3]))
    assert all(math.isnan(value) for value in calibration(truth, rows[:2]).values())
    same = [row | {"quality": 1.0} for row in rows]
    assert math.isnan(calibration(truth, same)["quality_spearman"])


def square(x: int, y: int, side: int) -> NDArray[np.uint8]:
    mask = np.zeros(SIZE, np.uint8)
    mask[y : y + side, x : x + side] = 1
    return mask


def truth_of(*masks: NDArray[np.uint8], crowd: bool = False) -> dict[str, Any]:
    rows = [
        {
            **row_of(m),
            "id": i + 1,
            "image_id": 7,
            "category_id": 1,
            "area": float(m.sum()),
            "iscrowd": int(crowd),
        }
        for i, m in enumerate(masks)
    ]
    image = {"id": 7, "height": SIZE[0], "width": SIZE[1]}
    return {"images": [image], "categories": [{"id": 1, "name": "person"}], "annotations": rows}


def detection(
    boxes: list[list[float]], scores: list[float], quality: list[float]
) -> dict[str, torch.Tensor]:
    n = len(boxes)
    return {
        "boxes": torch.tensor(boxes).reshape(n, 4),
        "labels": torch.zeros(n, dtype=torch.int64),
        "scores": torch.tensor(scores),
        "quality": torch.tensor(quality),
        "masks": torch.ones(n, 28, 28),
    }


def test_perfect_and_missed_objects() -> None:
    metrics = SegmentationMetrics(truth_of(square(10, 10, 20), square(50, 10, 20)))
    metrics.update(7, detection([[10.0, 10.0, 30.0, 30.0]], [0.9], [1.0]))
    scores = metrics.compute()
    assert scores["segm_AP"] == pytest.approx(51 / 101)  # precision 1 at recalls 0 .. .5 of 101
    assert scores["box_AP50"] == pytest.approx(51 / 101)
    assert (scores["mIoU"], scores["S90_matched"], scores["S90_all"]) == (0.5, 1.0, 0.5)


def test_next_epoch_scores_like_the_first() -> None:
    truth = truth_of(square(10, 10, 20), square(50, 10, 20))
    metrics, fresh = SegmentationMetrics(truth), SegmentationMetrics(truth)
    metrics.update(7, detection([[10, 10, 30, 30]], [0.9], [1.0]))
    first = metrics.compute()
    metrics.reset()
    second = detection([[50, 10, 70, 30], [12, 10, 32, 30]], [0.8, 0.9], [1.0, 1.0])
    metrics.update(7, second)
    fresh.update(7, second)
    assert metrics.compute() == pytest.approx(fresh.compute(), nan_ok=True)
    assert metrics.compute()["mIoU"] > first["mIoU"]


def test_rescoring_ranks_masks_by_quality_and_leaves_boxes() -> None:
    wrong, right = [50.0, 30.0, 70.0, 50.0], [10.0, 10.0, 30.0, 30.0]
    scores = {}
    for rescore in (False, True):
        metrics = SegmentationMetrics(truth_of(square(10, 10, 20)), rescore)
        metrics.update(7, detection([wrong, right], [0.9, 0.8], [0.1, 0.9]))
        scores[rescore] = metrics.compute()
    assert scores[False]["segm_AP"] == pytest.approx(0.5)
    assert scores[True]["segm_AP"] == pytest.approx(1.0)
    assert scores[True]["box_AP"] == scores[False]["box_AP"] == pytest.approx(0.5)


def test_quality_filter_drops_detections() -> None:
    boxes = [[10.0, 10.0, 30.0, 30.0], [50.0, 10.0, 70.0, 30.0]]
    found = []
    for least in (0.0, 0.9):
        metrics = SegmentationMetrics(
            truth_of(square(10, 10, 20), square(50, 10, 20)), min_quality=least
        )
        metrics.update(7, detection(boxes, [0.9, 0.8], [0.95, 0.85]))
        found.append(metrics.compute())
    assert [scores["segm_AP"] for scores in found] == pytest.approx([1.0, 51 / 101])
    assert [scores["box_AP"] for scores in found] == pytest.approx([1.0, 51 / 101])


def test_detection_matches_one_object_best_score_first() -> None:
    truth = truth_of(square(10, 10, 20))
    rows = [row_of(square(10, 10, 20), image_id=7, category_id=1, score=0.5)]
    rows.append(
        row_of(square(10, 14, 20), image_id=7, category_id=1, score=0.8)
    )  # IoU 2/3 comes first
    assert match_masks(truth, rows) == pytest.approx([320 / 480])
    rows.append(row_of(square(10, 30, 20), image_id=7, category_id=1, score=0.9))  # touches nothing
    assert match_masks(truth, rows) == pytest.approx([320 / 480])


def test_overlap_scores_use_both_denominators() -> None:
    assert overlap_scores(np.array([0.95, 0.9, 0.6, 0.0])) == {
        "mIoU": pytest.approx(2.45 / 4),
        "S90_matched": pytest.approx(1 / 3),
        "S90_all": 0.25,
    }


def test_crowd_only_and_unseen_images_have_no_score() -> None:
    metrics = SegmentationMetrics(truth_of(square(10, 10, 20), crowd=True))
    metrics.update(7, detection([], [], []))
    assert all(math.isnan(value) for value in metrics.compute().values())


def test_no_detection_scores_zero() -> None:
    metrics = SegmentationMetrics(truth_of(square(10, 10, 20)))
    metrics.update(7, detection([], [], []))
    scores = metrics.compute()
    assert (scores["segm_AP"], scores["box_AP"], scores["mIoU"], scores["S90_all"]) == (0, 0, 0, 0)


def test_only_seen_images_count() -> None:
    truth = truth_of(square(10, 10, 20))
    truth["images"].append({"id": 8, "height": SIZE[0], "width": SIZE[1]})
    truth["annotations"].append({**truth["annotations"][0], "id": 2, "image_id": 8})
    metrics = SegmentationMetrics(truth)
    metrics.update(7, detection([[10.0, 10.0, 30.0, 30.0]], [0.9], [1.0]))
    assert metrics.compute()["segm_AP"] == pytest.approx(1.0)


def test_encoding_keeps_the_best_hundred_and_pastes_masks() -> None:
    boxes = [[10.0, 10.0, 30.0, 30.0]] * 120
    rows = encode_detections(7, SIZE, detection(boxes, [i / 120 for i in range(120)], [1.0] * 120))
    assert len(rows) == 100
    assert rows[0]["score"] == pytest.approx(119 / 120)
    assert rows[0]["bbox"] == [10, 10, 20, 20]
    assert rows[0]["segmentation"] == rle_of(square(10, 10, 20))
