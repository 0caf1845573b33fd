"""The progress bar and the timer of a training."""

from types import SimpleNamespace
from typing import Any

import pytest

from cohdc_train.train import step_timer
from cohdc_train.train.progress_bar import FitProgressBar, epoch_text
from cohdc_train.train.step_timer import StepTimer


@pytest.mark.parametrize(
    ("max_epochs", "text"), [(12, "epoch 3 of 12"), (-1, "epoch 3"), (None, "epoch 3")]
)
def test_epochs_count_from_one_and_have_a_total_only_where_there_is_one(
    max_epochs: int | None, text: str
) -> None:
    assert epoch_text(2, max_epochs) == text


def test_bar_shows_few_metrics_by_short_names() -> None:
    bar = FitProgressBar()
    logged = {"train/loss": 1.25, "lr/heads": 0.0012, "val/segm_AP50": 0.5, "other": 1.0}
    trainer: Any = SimpleNamespace(progress_bar_metrics=logged, loggers=[])
    assert bar.get_metrics(trainer, None) == {  # type: ignore[arg-type]
        "loss": "1.250",
        "AP50": "0.500",
        "lr": "1.2e-03",
    }


def test_timer_measures_first_step_and_gaps_without_validation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = {"now": 100.0}
    monkeypatch.setattr(step_timer.time, "monotonic", lambda: clock["now"])
    timer = StepTimer(100.0)
    nothing: Any = None
    assert timer.line() == ""

    def pass_time(seconds: float) -> None:
        clock["now"] += seconds

    pass_time(7.5)
    for _ in range(2):
        for batch in range(3):
            timer.on_train_batch_start(nothing, nothing, nothing, batch)
            pass_time(0.5)
            timer.on_train_batch_end(nothing, nothing, nothing, nothing, batch)
        pass_time(1.0)
        timer.on_validation_start(nothing, nothing)
        pass_time(60.0)
        timer.on_validation_end(nothing, nothing)
        pass_time(1.0)
    assert timer.first_step_s == 8.0
    assert timer.epoch_gaps_s == [2.0]
    assert timer.line() == (
        "time: 8.0 s to the first step, 2.0 s between epochs (without validation)"
    )
