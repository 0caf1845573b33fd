"""The page of trainings: curves, classes, and what the log of a resumed training holds."""

from pathlib import Path

import pytest
from report_runs import Page, write_log, write_training

from cohdc_train.errors import DataError
from cohdc_train.report import report
from cohdc_train.report.training_run import read_training_run


def open_page(page: Path) -> Page:
    """Read a page, which must be small enough to be sent around."""
    assert page.stat().st_size < 5_000_000
    return Page(page.read_text("utf-8"))


def test_page_of_a_training_opens_with_the_best_validation(tmp_path: Path) -> None:
    page = open_page(report([write_training(tmp_path / "street")]))
    assert page.facts["Mask AP"] == "0.400"
    assert page.facts["Mask AP at IoU 0.5"] == "0.800"
    assert page.facts["Steps"] == "40"
    assert page.facts["Network"] == "hdc"
    assert page.facts["Canvas"] == "320 × 240 px"
    assert page.facts["Seed"] == "7"
    assert page.heads == ["Training", "Classes", "Scores", "Sample predictions", "Options"]
    assert page.captions[:4] == ["Learning curve", "Losses", "Learning rate", "Mask AP per class"]
    assert "Images predicted worst" in page.captions


def test_names_of_classes_are_escaped(tmp_path: Path) -> None:
    names = ("<b>car</b>", 'a "quoted" & odd name', "$x^2$")
    page = report([write_training(tmp_path / "run", names)])
    assert "<b>car" not in page.read_text("utf-8")
    cells = open_page(page).cells
    assert [cell for cell in cells if cell in names] == ["$x^2$", names[1], names[0]]


def test_comparison_of_trainings_names_the_options_that_differ(tmp_path: Path) -> None:
    runs = [write_training(tmp_path / name) for name in ("one", "two")]
    config = runs[1] / "config.yaml"
    config.write_text(config.read_text().replace("lr: 0.001", "lr: 0.004"))
    page = open_page(report(runs, out=tmp_path / "page.html"))
    assert page.heads[:3] == ["Trainings side by side", "Training", "Classes"]
    assert "Options that differ" in page.heads
    start = page.cells.index("model.optimizer.lr")
    assert page.cells[start : start + 3] == ["model.optimizer.lr", "0.001", "0.004"]


def test_log_of_a_resumed_training_goes_on(tmp_path: Path) -> None:
    folder = write_training(tmp_path / "run")
    later = [{"epoch": 4, "step": 49, "val/segm_AP": 0.9}, {"epoch": 4, "step": 54}]
    write_log(folder / "logs" / "version_1" / "metrics.csv", later)
    run = read_training_run("run", folder)
    assert run.best_step() == 49
    assert run.series["val/segm_AP"][:, 0].tolist() == [9, 19, 29, 39, 49]


def test_log_of_another_training_in_the_folder_is_skipped(tmp_path: Path) -> None:
    folder = write_training(tmp_path / "run")
    write_log(folder / "logs" / "version_1" / "metrics.csv", [{"epoch": 0, "step": 9, "a": 1}])
    assert list(read_training_run("run", folder).series) == ["a"]


def test_training_without_a_validation_has_a_page(tmp_path: Path) -> None:
    log = tmp_path / "run" / "logs" / "version_0" / "metrics.csv"
    write_log(log, [{"epoch": 0, "step": 9, "train/loss": 1.5}])
    page = open_page(report([tmp_path / "run"]))
    assert "10 steps in 1 epoch; no validation yet." in page.text
    assert page.captions == ["Losses"]


def test_log_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    log = write_training(tmp_path / "run") / "logs" / "version_0" / "metrics.csv"
    log.write_text("step,loss\n3,abc\n")
    with pytest.raises(DataError, match=r"metrics\.csv: cannot be read as a log"):
        report([tmp_path / "run"])
