"""The whole demo, tiny: render, fine-tune, export, run SLAM three times, report."""

import json
from pathlib import Path

import pytest

from cohdc_train.cli import main
from cohdc_train.demo import command, demo, steps
from cohdc_train.demo.plan import DEFAULT, FULL, QUICK, DemoPlan
from cohdc_train.errors import CohdcError
from cohdc_train.files import MANIFEST, files_below
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 12
TINY = DemoPlan(
    train_images=4, val_images=2, frames=FRAMES, minutes=0.02, expected_s=QUICK.expected_s
)
pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a demo of a few images and frames by the command line; return its folder."""
    out = tmp_path_factory.mktemp("demo") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "QUICK", TINY)
        assert main(["demo", "--out", str(out), "--quick", "--seed", "3"]) == 0
    return out


def test_summary_has_scores_of_both_networks_and_of_three_runs(finished: Path) -> None:
    summary = json.loads((finished / "summary.json").read_text())
    for key in ("mask_ap", "mask_ap50"):
        assert set(summary[key]) == {"shipped", "fine_tuned"}
        assert all(0 <= value <= 1 for value in summary[key].values())
    assert set(summary["ate_m"]) == {"plain", "geometry", "masks"}
    assert all(0 < error < 1 for error in summary["ate_m"].values())
    assert all(0 < share <= 1 for share in summary["coverage"].values())
    assert set(summary["seconds"]) == set(DEFAULT.expected_s)
    assert summary["seed"] == 3


def test_each_step_leaves_its_files(finished: Path) -> None:
    files = [
        "data/instances_train.json",
        "sequence/groundtruth.txt",
        "train/best.ckpt",
        "train/config.yaml",
        "model.onnx",
        "model.onnx.json",
        "slam/plain/trajectory.txt",
        "slam/geometry/metrics.json",
        "slam/masks/metrics.json",
        "demo.webp",
        "result.png",
        "report.html",
    ]
    assert [name for name in files if not (finished / name).is_file()] == []
    trajectory = Trajectory.load_tum(finished / "slam" / "masks" / "trajectory.txt")
    assert 3 <= len(trajectory.timestamps) <= FRAMES


def test_plain_run_uses_neither_geometry_nor_masks(finished: Path) -> None:
    config = (finished / "slam" / "plain" / "config.yaml").read_text()
    assert config.count("enabled: false") == len(steps.PLAIN)
    assert "model: null" in config


def test_report_needs_no_other_file(finished: Path) -> None:
    page = (finished / "report.html").read_text()
    assert 'src="http' not in page
    assert "Translation error (ATE)" in page
    for name in steps.RUNS.values():
        assert name in page


def test_second_call_keeps_finished_steps(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (finished / "summary.json").read_text()
    monkeypatch.setattr(command, "QUICK", TINY)
    for name in ("render", "score_shipped", "train", "export_model", "run_slam_three_times"):
        monkeypatch.setattr(steps, name, None)  # a call would fail
    summary = demo(finished, quick=True, seed=3)
    assert (finished / "summary.json").read_text() == before
    printed = capsys.readouterr().out
    assert printed.count("done before") == len(TINY.expected_s)
    assert f"{100 * summary['ate_m']['masks']:.1f} cm" in printed


def test_progress_names_step_and_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(steps, "render", stop)
    with pytest.raises(KeyboardInterrupt):
        demo(tmp_path / "out")
    total = sum(DEFAULT.expected_s.values())
    left = f"about {total // 60:.0f} min {total % 60:02.0f} s left"
    assert f"[1/6] Render photographs and a sequence ({left})" in capsys.readouterr().out


def test_quick_is_shorter_than_default_and_full_longer() -> None:
    quick, default, full = (sum(plan.expected_s.values()) for plan in (QUICK, DEFAULT, FULL))
    assert quick < default < full
    assert quick <= 160
    assert default <= 300


def test_quick_and_full_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(CohdcError, match="give --quick or --full, not both"):
        demo(tmp_path / "out", quick=True, full=True)


def test_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(CohdcError, match="not from a former demo"):
        demo(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_foreign_demo_json_does_not_give_the_folder_away(tmp_path: Path) -> None:
    (tmp_path / "demo.json").write_text("mine")
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(CohdcError, match=r"holds demo\.json, not written by a former cohdc demo"):
        demo(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"
    assert (tmp_path / "demo.json").read_text() == "mine"


def test_demo_with_other_options_removes_only_the_files_of_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(out: Path, *_: object) -> None:
        (out / "data" / "images").mkdir(parents=True, exist_ok=True)
        (out / "data" / "images" / "a.png").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(steps, "render", stop)
    for seed in range(2):
        with pytest.raises(KeyboardInterrupt):
            demo(tmp_path, seed=seed)
        (tmp_path / "thesis.txt").write_text("years of work")
    (tmp_path / "data" / "mine.png").write_text("mine")
    with pytest.raises(CohdcError, match=r"holds data/mine\.png, not written"):
        demo(tmp_path, seed=2)
    names = ["data/images/a.png", "data/mine.png", "demo.json", "thesis.txt"]
    assert [name for name in files_below(tmp_path) if name != MANIFEST] == names
