"""The whole way, tiny: render, train, export, SLAM without and with the file, report."""

import json
import math

import pytest

from cohdc_train import demo as demo_module
from cohdc_train.cli import main
from cohdc_train.demo import Plan, demo
from cohdc_train.errors import CohdcError
from cohdc_train.files import MANIFEST, files_below
from cohdc_train.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A demo of a few images and frames through the command line; its folder."""
    out = tmp_path_factory.mktemp("demo") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            demo_module, "QUICK", Plan(train_images=16, val_images=3, frames=12, epochs=1)
        )
        assert main(["demo", "--out", str(out), "--quick", "--seed", "3"]) == 0
    return out


def test_the_summary_holds_numbers_a_script_can_read(finished):
    summary = json.loads((finished / "summary.json").read_text())
    for name in ("segm_ap50", "ate_without_m", "ate_with_m", "coverage", "seconds"):
        assert math.isfinite(summary[name]), name
    assert 0 <= summary["segm_ap50"] <= 1
    assert summary["coverage_without"] == 1.0
    assert (
        0 < summary["coverage"] <= 1
    )  # a network of a few steps may take the whole room for people
    assert summary["seconds"] == pytest.approx(sum(summary["steps"].values()), abs=0.06)
    assert summary["seed"] == 3


def test_every_stage_left_its_files(finished):
    files = [
        "data/instances_train.json",
        "sequence/groundtruth.txt",
        "train/best.ckpt",
        "train/config.yaml",
        "model.onnx",
        "model.onnx.json",
        "without/trajectory.txt",
        "with/metrics.json",
        "predictions/predictions.json",
        "report.html",
    ]
    assert [name for name in files if not (finished / name).is_file()] == []
    assert len(Trajectory.load_tum(finished / "without" / "trajectory.txt").timestamps) == 12
    coverage = json.loads((finished / "summary.json").read_text())["coverage"]
    assert coverage == 1.0
    assert len(Trajectory.load_tum(finished / "with" / "trajectory.txt").timestamps) == 12


def test_the_report_needs_no_other_file(finished):
    page = (finished / "report.html").read_text()
    assert page.count("data:image/") >= 10
    assert 'src="http' not in page
    assert "Translation error (ATE)" in page


def test_a_folder_of_something_else_is_not_touched(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(CohdcError, match="not from a former demo"):
        demo(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_a_users_demo_json_does_not_give_the_folder_away(tmp_path):
    (tmp_path / "demo.json").write_text("mine")
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(CohdcError, match=r"holds demo\.json, not written by a former cohdc demo"):
        demo(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"
    assert (tmp_path / "demo.json").read_text() == "mine"


def test_second_demo_removes_only_the_files_of_the_first(tmp_path, monkeypatch):
    def stop(out, *_):
        (out / "data" / "images").mkdir(parents=True)
        (out / "data" / "images" / "a.png").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_module, "_render", stop)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            demo(tmp_path)
        (tmp_path / "thesis.txt").write_text("years of work")
    (tmp_path / "data" / "mine.png").write_text("mine")
    with pytest.raises(CohdcError, match=r"holds data/mine\.png, not written"):
        demo(tmp_path)
    names = ["data/images/a.png", "data/mine.png", "demo.json", "thesis.txt"]
    assert [name for name in files_below(tmp_path) if name != MANIFEST] == names
