"""Length of a training, its validations, its precision."""

from datetime import timedelta
from typing import Any

import pytest
import torch

from cohdc_train.train.budget import default_epochs, training_limits, validation_interval
from cohdc_train.train.trainer import auto_precision


def limits(
    epochs: int | None = None, minutes: float | None = None, **trainer: Any
) -> dict[str, Any]:
    return training_limits(
        {"max_epochs": None, "max_steps": -1, "max_time": None, **trainer}, epochs, minutes
    )


def test_minutes_and_epochs_are_trainer_limits() -> None:
    assert limits() == {"max_epochs": None, "max_steps": -1, "max_time": None}
    assert limits(minutes=6) == {
        "max_epochs": -1,
        "max_steps": -1,
        "max_time": timedelta(minutes=6),
    }
    assert limits(epochs=3)["max_epochs"] == 3
    assert limits(max_steps=50) == {"max_epochs": -1, "max_steps": 50, "max_time": None}
    assert limits(minutes=6, max_epochs=12)["max_epochs"] == 12


@pytest.mark.parametrize(("epochs", "minutes"), [(0, None), (None, 0.0), (None, -1.0)])
def test_budget_that_is_not_positive_is_refused(epochs: int | None, minutes: float | None) -> None:
    with pytest.raises(ValueError, match=r"--epochs 0: at least 1|--minutes .*: must be above 0"):
        limits(epochs, minutes)


def test_small_sets_get_more_epochs() -> None:
    assert [default_epochs(n) for n in (1, 40, 322, 100_000)] == [300, 150, 19, 12]


@pytest.mark.parametrize("time", [timedelta(minutes=8), "00:00:08:00", {"minutes": 8}])
def test_validations_follow_the_clock(time: Any) -> None:
    interval = validation_interval({"max_epochs": -1, "max_steps": -1, "max_time": time})
    assert interval == {"val_check_interval": timedelta(minutes=4), "check_val_every_n_epoch": None}


@pytest.mark.parametrize(("minutes", "count"), [(1, 2), (6, 2), (20, 4), (60, 8), (600, 8)])
def test_longer_trainings_validate_more_often(minutes: int, count: int) -> None:
    limits = {"max_epochs": -1, "max_steps": -1, "max_time": timedelta(minutes=minutes)}
    assert validation_interval(limits)["val_check_interval"] * count == timedelta(minutes=minutes)


def test_validations_follow_steps_and_epochs() -> None:
    steps = validation_interval({"max_epochs": -1, "max_steps": 400, "max_time": None})
    assert steps == {"val_check_interval": 100, "check_val_every_n_epoch": None}
    epochs = [
        validation_interval({"max_epochs": n, "max_steps": -1, "max_time": None})
        for n in (1, 12, 300)
    ]
    assert [interval["check_val_every_n_epoch"] for interval in epochs] == [1, 3, 75]


@pytest.mark.parametrize(("has_bf16", "expected"), [(True, "bf16-mixed"), (False, "32-true")])
def test_precision_follows_the_processor(
    has_bf16: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has_bf16})
    assert auto_precision("cpu") == expected
