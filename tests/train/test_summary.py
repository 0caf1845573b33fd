"""Hints at the end of a training."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from cohdc_train.data.annotations import CocoImage, CocoObject
from cohdc_train.models import NetworkConfig
from cohdc_train.train.sanity import suggest_rate
from cohdc_train.train.summary import TrainingFacts, hints, summary_lines


def image(side: float) -> CocoImage:
    """Return an image of the canvas' size with one square object."""
    thing = CocoObject(1, 1, (0.0, 0.0, side, side), side**2, [], False)
    return CocoImage(1, Path("photos/one.jpg"), 320, 416, (thing,))


HEALTHY = TrainingFacts(
    scores={"segm_AP": 0.3, "segm_AP50": 0.6, "segm_AP/person": 0.4, "segm_AP/car": 0.2},
    class_counts={"person": 20, "car": 10},
    losses=[2.0] * 50 + [1.0] * 50,
    network=NetworkConfig(norm="frozen"),
    batch_size=4,
    random_weights=False,
    images=[image(100.0)],
    canvas=(320, 416),
)


def test_healthy_training_gets_no_hint() -> None:
    assert hints(HEALTHY) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"scores": {**HEALTHY.scores, "segm_AP50": 0.001}},
            ["AP50 is 0.001 after 100 steps", "--overfit 8"],
        ),
        (
            {"scores": {**HEALTHY.scores, "segm_AP50": 0.001}, "random_weights": True},
            ["from random weights on 1 images", "--pretrained auto"],
        ),
        ({"losses": [2.0] * 100}, ["the loss did not fall", "--lr_find"]),
        ({"scores": {**HEALTHY.scores, "segm_AP/car": 0.0}}, ["never detected: car (10 objects)"]),
        (
            {"images": [image(10.0)]},
            ["100% of the objects are smaller than 16 px", "--data.canvas"],
        ),
        (
            {"network": NetworkConfig(norm="batch"), "batch_size": 2},
            ["batches of 2", "--data.batch_size"],
        ),
    ],
)
def test_each_fault_has_its_hint(changes: dict[str, Any], words: list[str]) -> None:
    (hint,) = hints(dataclasses.replace(HEALTHY, **changes))
    for word in words:
        assert word in hint


def test_summary_names_scores_files_and_next_command(tmp_path: Path) -> None:
    (tmp_path / "best.ckpt").touch()
    (tmp_path / "logs").mkdir()
    assert summary_lines(HEALTHY, tmp_path) == [
        "best.ckpt: mask AP 0.300, AP50 0.600 on the validation split",
        "mask AP per class: person 0.400, car 0.200",
        f"files in {tmp_path}: best.ckpt, logs",
        f"next: cohdc export {tmp_path / 'best.ckpt'} --images photos",
    ]


def test_summary_names_a_better_checkpoint_of_an_earlier_session(tmp_path: Path) -> None:
    (first, *_) = summary_lines(HEALTHY, tmp_path, best_ap=0.335)
    assert first == "best.ckpt: mask AP 0.335, of an earlier session; this one reached 0.300"
    (same, *_) = summary_lines(HEALTHY, tmp_path, best_ap=0.3)
    assert same.startswith("best.ckpt: mask AP 0.300, AP50")


@pytest.mark.parametrize(
    ("losses", "suggestion"),
    [
        ([2.0] * 50 + [1.0] + [3.0] * 49, 0.1 * 50 / 10),
        ([2.0] * 100, None),
        ([2.0] * 50 + [1.9] + [3.0] * 49, None),
        ([2.0, 1.0], None),
    ],
)
def test_range_test_suggests_a_tenth_of_the_best_rate(
    losses: list[float], suggestion: float | None
) -> None:
    rates = [0.1 * step for step in range(len(losses))]
    found = suggest_rate(rates, losses)
    assert found == (None if suggestion is None else pytest.approx(suggestion))
