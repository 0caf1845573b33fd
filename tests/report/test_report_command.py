"""`cohdc report`: what it takes for a run, and where the page goes."""

import json
from pathlib import Path

import pytest
from report_runs import Page, trajectory, write_slam_run, write_training, write_truth

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.report import Table, report
from cohdc_train.report.command import labels_of
from cohdc_train.trajectory.evaluate import evaluate

BENCH_ROW = {"name": "HDC-Net", "ap": 0.31, "fps_ort": 12.5, "ap_int8": None, "model_mb": 9.4}


def test_several_runs_are_given_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_slam_run(tmp_path / "a")
    write_slam_run(tmp_path / "b")
    assert main(["report", "a", "b", "--title", "Two"]) == 0
    assert capsys.readouterr().out == "report: report.html\n"
    page = Page((tmp_path / "report.html").read_text("utf-8"))
    assert page.heads[0] == "Runs side by side"


def test_runs_of_different_kinds_have_parts_of_one_page(tmp_path: Path) -> None:
    runs = [write_slam_run(tmp_path / "walk"), write_training(tmp_path / "street")]
    page = Page(report(runs, out=tmp_path / "page.html").read_text("utf-8"))
    assert [head for head in page.heads if ": " in head] == ["SLAM run: walk", "Training: street"]


def test_file_of_evaluate_has_its_errors_and_trajectory(tmp_path: Path) -> None:
    truth = write_truth(tmp_path)
    trajectory(0.01, range(9)).save_tum(tmp_path / "estimate.txt")
    evaluate(truth, tmp_path / "estimate.txt", tmp_path / "scores.json")
    page = Page(report([tmp_path / "scores.json"]).read_text("utf-8"))
    assert {"Trajectory", "Errors"} <= set(page.heads)
    assert page.facts["Poses matched"] == "51"
    (tmp_path / "estimate.txt").unlink()
    page = Page(report([tmp_path / "scores.json"]).read_text("utf-8"))
    assert page.heads == ["Errors"]


def test_scores_of_validate_are_shown_by_class(tmp_path: Path) -> None:
    scores = {"segm_AP": 0.5, "segm_AP50": 0.75, "segm_AP/<cat>": 0.25, "mIoU": 0.61}
    (tmp_path / "scores.json").write_text(json.dumps(scores))
    page = Page(report([tmp_path]).read_text("utf-8"))
    assert page.facts == {"Mask AP": "0.500", "Mask AP at IoU 0.5": "0.750"}
    assert page.heads == ["Scores", "Classes", "Mask AP of every class"]
    assert page.cells[-2:] == ["<cat>", "0.250"]


def test_table_of_bench_is_shown_with_names_and_units(tmp_path: Path) -> None:
    rows = [BENCH_ROW, {**BENCH_ROW, "name": "ResNet50", "ap": 0.29}]
    (tmp_path / "table4.json").write_text(json.dumps(rows))
    page = report([tmp_path]).read_text("utf-8")
    assert '<td class="best">0.310</td>' in page
    assert "Speed, ONNX, images/s" in Page(page).text
    (tmp_path / "table4.json").write_text("{}")
    with pytest.raises(DataError, match=r"table4\.json: is no table of cohdc bench"):
        report([tmp_path])


def test_report_keeps_a_page_it_did_not_write(tmp_path: Path) -> None:
    run = write_slam_run(tmp_path / "run")
    (run / "report.html").write_text("mine")
    with pytest.raises(DataError, match=r"holds report\.html, not written by"):
        report([run])
    assert (run / "report.html").read_text() == "mine"
    (run / "report.html").unlink()
    assert report([run]).read_bytes() == report([run]).read_bytes()


def test_what_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is no run; give a folder of cohdc slam"):
        report([tmp_path])
    with pytest.raises(DataError, match="gone: no such file or folder"):
        report([tmp_path / "gone"])
    with pytest.raises(DataError, match="give at least one"):
        report([])
    run = write_slam_run(tmp_path / "run")
    with pytest.raises(DataError, match="is given twice"):
        report([run, tmp_path / "." / "run"], out=tmp_path / "page.html")
    with pytest.raises(DataError, match="is a folder; --out names the page"):
        report([run], out=tmp_path)


def test_labels_are_as_short_as_they_stay_different() -> None:
    paths = [Path("/runs/a/seed0"), Path("/runs/b/seed0")]
    assert labels_of(paths) == ["a/seed0", "b/seed0"]
    assert labels_of(paths[:1]) == ["seed0"]


def test_uneven_table_is_refused() -> None:
    with pytest.raises(ValueError, match="2 cells"):
        Table("t", ["a", "b"], [["1"]])
