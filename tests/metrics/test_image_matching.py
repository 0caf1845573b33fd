"""Matches of objects and detections, on squares whose answers are worked out by hand."""

from typing import Any

import numpy as np
import pytest
import torch
from test_coco_metrics import detection, square, truth_of

from cohdc_train.metrics.coco_metrics import Results, SegmentationMetrics
from cohdc_train.metrics.matching import ImageMatch, best_and_worst, confusion_matrix, match_images

LEFT, RIGHT, EMPTY = [10.0, 10.0, 30.0, 30.0], [50.0, 10.0, 70.0, 30.0], [10.0, 38.0, 30.0, 58.0]
LOWER = [10.0, 14.0, 30.0, 34.0]  # overlaps LEFT by 16 of 24 rows


def results_of(
    truth: dict[str, Any], boxes: Any, scores: Any, labels: Any = None, quality: Any = None
) -> Results:
    """Score detections that fill their boxes, in image 7.

    labels: 0-based, of the first class unless given.
    """
    names = [{"id": 1, "name": "person"}, {"id": 2, "name": "car"}, {"id": 3, "name": "dog"}]
    metrics = SegmentationMetrics({**truth, "categories": names})
    found = detection(boxes, scores, quality or [0.9] * len(boxes))
    metrics.update(
        7, found | {"labels": torch.tensor(labels or [0] * len(boxes), dtype=torch.int64)}
    )
    return metrics.results()


def two(second: int = 1) -> dict[str, Any]:
    """Return squares at LEFT and at RIGHT; second: class of the one on the right."""
    truth = truth_of(square(10, 10, 20), square(50, 10, 20))
    truth["annotations"][1]["category_id"] = second
    return truth


def only(results: Results) -> ImageMatch:
    (match,) = match_images(results)
    return match


def test_image_scores_iou_over_objects_and_false_detections() -> None:
    assert only(results_of(two(), [LEFT, RIGHT], [0.9, 0.9])).score == pytest.approx(1.0)
    assert only(results_of(two(), [LEFT], [0.9])).score == pytest.approx(1 / 2)
    assert only(results_of(two(), [LOWER, RIGHT, EMPTY], [0.9, 0.8, 0.7])).score == pytest.approx(
        (2 / 3 + 1) / 3
    )
    assert only(results_of(two(), [LOWER, LEFT], [0.9, 0.8])).score == pytest.approx((2 / 3) / 3), (
        "the surest first"
    )
    assert only(results_of(two(), [], [])).score == 0


def test_doubtful_detections_do_not_count() -> None:
    match = only(results_of(two(), [LEFT, RIGHT, EMPTY], [0.9, 0.49, 0.4]))
    assert (len(match.detections), match.detection_of.tolist()) == (1, [0, -1])


def test_wrong_class_is_a_miss_and_a_false_detection() -> None:
    match = only(results_of(two(second=2), [LEFT, RIGHT], [0.9, 0.8], labels=[0, 2]))
    assert (match.detection_of.tolist(), match.is_correct.tolist()) == ([0, 1], [True, False])
    assert match.score == pytest.approx(1 / 3)


def test_own_class_matches_before_a_higher_score() -> None:
    match = only(results_of(two(), [LEFT, LOWER], [0.9, 0.6], labels=[1, 0]))
    assert match.detection_of.tolist() == [1, -1]
    assert match.score == pytest.approx((2 / 3) / 3)


def test_detections_in_a_crowd_are_dropped() -> None:
    truth = two()
    truth["annotations"][1]["iscrowd"] = 1
    match = only(results_of(truth, [RIGHT, LEFT], [0.9, 0.8]))
    assert (len(match.objects), len(match.crowds), len(match.detections)) == (1, 1, 1)
    assert match.detection_of.tolist() == [0]
    assert match.score == pytest.approx(1.0)
    other = only(results_of(truth, [RIGHT, LEFT], [0.9, 0.8], labels=[1, 0]))
    assert len(other.detections) == 2, "a car among a crowd of people is a false one"


def test_confusion_counts_hits_misses_false_ones_and_other_classes() -> None:
    truth = two(second=2)
    boxes, labels = [LEFT, RIGHT, EMPTY], [0, 2, 1]
    matches = match_images(results_of(truth, boxes, [0.9, 0.8, 0.7], labels))
    expected = np.zeros((4, 4), np.int64)
    expected[0, 0] = expected[1, 2] = expected[3, 1] = (
        1  # person found, car taken for a dog, a car where nothing is
    )
    np.testing.assert_array_equal(confusion_matrix(matches, 3), expected)
    nothing = confusion_matrix(match_images(results_of(truth, [], [])), 3)
    assert (nothing[0, 3], nothing[1, 3], nothing.sum()) == (1, 1, 2)


def test_ranking_has_no_image_twice_and_none_without_score() -> None:
    def match(image_id: int, objects: int, false: int) -> ImageMatch:
        rows = [{"category_id": 1}] * objects
        found = np.full(objects, -1, np.int64)
        return ImageMatch(
            image_id, rows, [], [{"category_id": 1}] * false, found, np.zeros((false, objects))
        )

    empty, missed, crowded, false = match(1, 0, 0), match(2, 1, 0), match(3, 5, 1), match(4, 0, 1)
    found = ImageMatch(
        5, [{"category_id": 1}], [], [{"category_id": 1}], np.array([0]), np.array([[0.8]])
    )
    best, worst = best_and_worst([empty, missed, crowded, false, found], 2)
    assert [m.image_id for m in best] == [5, 4]
    assert [m.image_id for m in worst] == [3, 2]
    assert [[m.image_id for m in part] for part in best_and_worst([found, empty], 6)] == [[5], [5]]
