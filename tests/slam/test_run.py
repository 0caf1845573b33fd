"""The command: its files, its errors, and that torch stays away."""

import csv
import json
import subprocess
import sys
from collections import Counter
from dataclasses import fields, is_dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from plane_world import CAMERA_YAML, slam_config, write_sequence
from threadpoolctl import threadpool_info, threadpool_limits

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.files import MANIFEST, files_below
from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import RecordedSequence
from cohdc_train.slam.run import RENAMED_OPTIONS, RunOptions, run_slam, slam
from cohdc_train.trajectory.trajectory import Trajectory

SIX = {"rmse", "mean", "median", "std", "min", "max"}
FRAMES = 36


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a TUM folder with a person who walks by."""
    return write_sequence(tmp_path_factory.mktemp("walk"), FRAMES, with_passer_by=True)


@pytest.fixture(scope="module")
def masked(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the output folder of a run with masks from the command line."""
    out = tmp_path_factory.mktemp("out") / "run"
    arguments = [
        "slam",
        str(sequence),
        "--out",
        str(out),
        "--masks",
        str(sequence / "masks"),
    ]
    assert (
        main([*arguments, "--settings.features.max_keypoints", "500", "--settings.seed", "1"]) == 0
    )
    return out


def test_metrics_hold_what_a_script_reads(masked: Path) -> None:
    metrics = json.loads((masked / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES
    assert metrics["coverage"] == 1.0
    assert metrics["seed"] == 1
    assert metrics["without_depth"] == 0
    assert metrics["loops"] == 0
    assert set(metrics["ms"]) == {"segment", "track", "map"}
    assert 0 < metrics["ms"]["track"]["p50"] <= metrics["ms"]["track"]["p95"]
    for key in ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m"):
        assert set(metrics[key]) == SIX
    assert metrics["ate_m"]["rmse"] < 0.006


def test_run_writes_trajectory_table_config_and_images(masked: Path, sequence: Path) -> None:
    names = {path.name for path in masked.iterdir()}
    tables = {"trajectory.txt", "metrics.json", "frames.csv", "config.yaml", MANIFEST}
    assert names == tables | {"map.ply", "map.png", "pictures", "report.html"}
    assert [path.name for path in masked.parent.iterdir()] == ["run"], "no temporary folder is left"
    trajectory, truth = (
        Trajectory.load_tum(masked / "trajectory.txt"),
        Trajectory.load_tum(sequence / "groundtruth.txt"),
    )
    np.testing.assert_array_equal(trajectory.timestamps, truth.timestamps)
    with (masked / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == FRAMES
    assert rows[0]["stamp"] == "100.000000"
    assert rows[0]["keyframe"] == "1"
    assert all(0.2 < float(row["culled_share"]) < 0.6 for row in rows)
    assert all(0 < int(row["inliers"]) <= int(row["matches"]) for row in rows)
    assert any(int(row["inliers"]) < int(row["matches"]) for row in rows)
    config = yaml.safe_load((masked / "config.yaml").read_text())
    assert config["sequence"] == str(sequence)
    assert config["settings"]["features"]["max_keypoints"] == 500
    assert SlamConfig.from_yaml(masked / "config.yaml") == slam_config(500, seed=1)


def test_config_of_a_run_repeats_it_to_the_byte(masked: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    assert main(["slam", "--config", str(masked / "config.yaml"), "--out", str(again)]) == 0
    for name in ("trajectory.txt", "map.ply", "config.yaml"):
        assert (again / name).read_bytes() == (masked / name).read_bytes(), name
    assert untimed_rows(again) == untimed_rows(masked)


def untimed_rows(folder: Path) -> list[dict[str, str]]:
    """Return the rows of frames.csv without times."""
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if not k.endswith("_ms")} for row in rows]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--features=300", "no option --features; it is --settings.features.max_keypoints now"),
        ("--culling.dilate=3", "it is --settings.masks.dilation_px now"),
        ("--method.loops=false", "it is --settings.loops.enabled now"),
        ("--idle=3", "it is --idle_timeout now"),
        ("--view", "it is --viewer now"),
        ("--cloud", "it is --dense_cloud now"),
        ("--seed=1", "it is --settings.seed now"),
        ("--settings.loops.enabeld=false", "did you mean --settings.loops.enabled?"),
        ("--realtim", "did you mean --realtime?"),
    ],
)
def test_unknown_option_ends_with_one_line_that_suggests_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, message: str
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["slam", str(tmp_path), "--out", str(tmp_path / "out"), option])
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("cohdc slam: no option --")
    assert line.endswith(message)


def test_every_renamed_option_names_one_that_exists() -> None:
    options = {f"--{field.name}" for field in fields(RunOptions)}
    for section in fields(SlamConfig):
        value = getattr(SlamConfig(), section.name)
        names = [f".{field.name}" for field in fields(value)] if is_dataclass(value) else [""]
        options |= {f"--settings.{section.name}{name}" for name in names}
    assert {new for old, new in RENAMED_OPTIONS.items() if old != "--sequence"} <= options


def test_help_has_a_group_per_section_and_a_short_usage(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["slam", "--help"])
    text = capsys.readouterr().out
    assert text.splitlines()[0] == "usage: cohdc slam sequence --out OUT [options]"
    for section in fields(SlamConfig):
        assert f"\n  --settings.{section.name} " in text


def test_print_config_shows_the_options_and_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["slam", str(tmp_path), "--out", str(tmp_path / "out"), "--settings.seed", "7"]
    with pytest.raises(SystemExit) as stopped:
        main([*words, "--print_config"])
    assert stopped.value.code == 0
    shown = tmp_path / "shown.yaml"
    shown.write_text(capsys.readouterr().out)
    assert SlamConfig.from_yaml(shown) == SlamConfig(seed=7)
    assert not (tmp_path / "out").exists()


def test_images_show_masked_keypoints(masked: Path) -> None:
    names = [path.name for path in (masked / "pictures").iterdir()]
    kinds = Counter(name.rpartition("_")[2] for name in names)
    assert kinds.pop("worst.jpg") >= 1
    assert kinds == {"before.jpg": 6, "after.jpg": 6}
    before = cv2.imread(str(masked / "pictures" / "100.000000_before.jpg"))
    after = cv2.imread(str(masked / "pictures" / "100.000000_after.jpg"))
    assert before.shape == after.shape == (240, 320, 3)
    assert (before != after).any()


def test_without_masks_or_geometry_the_passer_by_spoils_it(
    sequence: Path,
    masked: Path,
    tmp_path: Path,
) -> None:
    good = json.loads((masked / "metrics.json").read_text())["ate_m"]["rmse"]
    metrics = slam(
        sequence,
        out=tmp_path,
        settings=slam_config(500, free_space__enabled=False, motion_segmentation__enabled=False),
    )
    assert metrics["ate_m"]["rmse"] > 5 * good
    assert metrics["ms"]["segment"]["p95"] == 0
    assert len(list((tmp_path / "pictures").glob("*_before.jpg"))) == 6
    assert not list((tmp_path / "pictures").glob("*_after.jpg"))


def test_run_keeps_files_it_did_not_write(
    sequence: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("pictures/holiday.jpg", "cloud.ply", "config.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"mine: {name}")
    arguments = ["slam", str(sequence), "--out", str(tmp_path), "--dense_cloud"]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    names = ", ".join(("config.yaml", "pictures", "cloud.ply"))
    assert f"{tmp_path}: holds {names}, not written by a former cohdc slam" in line
    assert "give another --out" in line
    assert files_below(tmp_path) == ["cloud.ply", "config.yaml", "pictures/holiday.jpg"]
    for name in files_below(tmp_path):
        assert (tmp_path / name).read_text() == f"mine: {name}"


def test_second_run_replaces_its_files_removes_stale_ones_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, long, short = tmp_path / "out", tmp_path / "long", tmp_path / "short"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    slam(write_sequence(long, 8), out=out, settings=slam_config(200), dense_cloud=True)
    images = {name for name in files_below(out / "pictures") if "worst" not in name}
    assert (out / "cloud.ply").is_file()
    (out / "pictures" / "holiday.jpg").write_text("mine")
    slam(write_sequence(short, 2), out=out, settings=slam_config(200))
    assert json.loads((out / "metrics.json").read_text())["frames"] == 2
    assert not (out / "cloud.ply").exists()
    left = {name for name in files_below(out / "pictures") if "worst" not in name}
    assert left < images | {"holiday.jpg"}
    assert {(out / name).read_text() for name in ("mine.txt", "pictures/holiday.jpg")} == {"mine"}
    (out / "cloud.ply").write_text("mine")
    assert main(["slam", str(short), "--out", str(out), "--dense_cloud"]) == 1
    assert "holds cloud.ply, not written" in capsys.readouterr().err
    assert (out / "cloud.ply").read_text() == "mine"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: (root / "rgb.txt").unlink(), "rgb.txt: cannot be read"),
        (lambda root: (root / "depth.txt").write_text("1.0\n"), "depth.txt:1: expected"),
        (lambda root: (root / "camera.yaml").unlink(), "does not tell the camera"),
        (
            lambda root: (root / "camera.yaml").write_text("fx: 1\n fy: 2\n"),
            "camera.yaml:2: broken YAML",
        ),
        (
            lambda root: (root / "camera.yaml").write_text(CAMERA_YAML.replace("320", "640")),
            "but the camera is 640x240",
        ),
        (
            lambda root: next((root / "masks").iterdir()).unlink(),
            "masks/100.000000.png: cannot be read",
        ),
        (
            lambda root: (root / "groundtruth.txt").write_text("1 2 3\n"),
            "groundtruth.txt:1: 3 numbers",
        ),
    ],
    ids=[
        "no list",
        "broken list",
        "no camera",
        "broken camera",
        "wrong size",
        "mask missing",
        "broken truth",
    ],
)
def test_a_users_error_is_one_line_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: object, said: str
) -> None:
    root = write_sequence(tmp_path / "room", 1)
    assert callable(change)
    change(root)
    arguments = [
        "slam",
        str(root),
        "--out",
        str(tmp_path / "out"),
        "--masks",
        str(root / "masks"),
    ]
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["room"]


def test_model_and_masks_together_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not both"):
        slam(tmp_path, out=tmp_path / "o", model=tmp_path / "m.onnx", masks=tmp_path)


def test_a_missing_sequence_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone: no such folder"):
        slam(tmp_path / "gone", out=tmp_path / "out")


def test_out_must_not_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(DataError, match="is a file"):
        slam(tmp_path, out=tmp_path / "out")


def test_out_must_be_writable(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="out: cannot be written"):
        slam(tmp_path, out=tmp_path / "file" / "out")


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("settings.seed", -1, "0 or more"),
        ("settings.features.max_keypoints", 0, "1 or more"),
        ("settings.features.max_keypoints", 49, "tracking.min_points_to_initialize, 50, or more"),
        ("idle_timeout", 0, "above 0"),
    ],
)
def test_number_out_of_range_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, value: int, allowed: str
) -> None:
    words = ["slam", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, f"--{name}", str(value)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    option = name.removeprefix("settings.") if name.count(".") > 1 else name
    assert line == f"cohdc slam: {option} is {value}; allowed: {allowed}"


def test_a_truth_of_another_time_costs_the_scores_not_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_sequence(tmp_path / "room", 4)
    (root / "groundtruth.txt").write_text(
        "7.0 0 0 0 0 0 0 1\n7.1 0 0 0 0 0 0 1\n7.2 0 0 0 0 0 0 1\n"
    )
    metrics = slam(root, out=tmp_path / "out", settings=slam_config(200))
    assert metrics["tracked"] == 4
    assert "ate_m" not in metrics
    assert "no scores: 0 of 4 poses lie within" in capsys.readouterr().err
    assert (tmp_path / "out" / "trajectory.txt").is_file()


def threads() -> set[int]:
    """Of the libraries that do linear algebra."""
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_linear_algebra_has_one_thread_while_it_runs(sequence: Path, tmp_path: Path) -> None:
    seen = set()
    with threadpool_limits(2, "blas"):
        source = RecordedSequence(sequence, choose_camera(sequence, None)[0])
        run_slam(
            source,
            tmp_path / "out",
            settings=slam_config(300),
            on_pose=lambda _: seen.update(threads()),
        )
        assert seen == {1}
        assert threads() == {2}, "they are given back"


def test_torch_is_never_imported() -> None:
    code = (
        "import sys, cohdc_train.slam.run, cohdc_train.segmenter; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
