"""The command: its files, its errors, and that torch stays away."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from plane_world import CAMERA_YAML, write_sequence
from threadpoolctl import threadpool_info, threadpool_limits

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.files import MANIFEST, files_below
from cohdc_train.segmenter import Detections
from cohdc_train.slam.config import Culling, Method
from cohdc_train.slam.dynamics.mask_sources import SegmenterMasks
from cohdc_train.slam.frame import View
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.io.sources import Recorded
from cohdc_train.slam.run import run_source, slam
from cohdc_train.trajectory.trajectory import Trajectory

SIX = {"rmse", "mean", "median", "std", "min", "max"}
FRAMES = 36


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM folder with a passer-by."""
    return write_sequence(tmp_path_factory.mktemp("walk"), FRAMES, with_passer_by=True)


@pytest.fixture(scope="module")
def masked(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder a run with masks leaves, run by the command line."""
    out = tmp_path_factory.mktemp("out") / "run"
    arguments = [
        "slam",
        "--sequence",
        str(sequence),
        "--out",
        str(out),
        "--masks",
        str(sequence / "masks"),
    ]
    assert main([*arguments, "--features", "500", "--seed", "1", "--culling.dilate", "7"]) == 0
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


def test_a_run_leaves_trajectory_table_config_and_pictures(masked: Path, sequence: Path) -> None:
    names = {path.name for path in masked.iterdir()}
    tables = {"trajectory.txt", "metrics.json", "frames.csv", "config.yaml", MANIFEST}
    assert names == tables | {"map.ply", "map.png", "pictures"}
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
    config = yaml.safe_load((masked / "config.yaml").read_text())
    assert config["culling"] == {
        "dynamic_classes": None,
        "score": 0.5,
        "quality": 0.0,
        "dilate": 7,
        "doubt": None,
    }
    assert config["camera"]["fx"] == 260
    assert config["seed"] == 1


def test_pictures_show_what_was_culled(masked: Path) -> None:
    names = sorted(path.name for path in (masked / "pictures").iterdir())
    assert len(names) == 12
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
        sequence=sequence,
        out=tmp_path,
        features=500,
        method=Method(geometry=False, static_weights=False),
    )
    assert metrics["ate_m"]["rmse"] > 5 * good
    assert metrics["ms"]["segment"]["p95"] == 0
    assert len(list((tmp_path / "pictures").iterdir())) == 6


def test_run_keeps_files_it_did_not_write(
    sequence: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("pictures/holiday.jpg", "cloud.ply", "config.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"mine: {name}")
    arguments = ["slam", "--sequence", str(sequence), "--out", str(tmp_path), "--cloud"]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    names = "config.yaml, pictures, cloud.ply"
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
    slam(sequence=write_sequence(long, 8), out=out, features=200, cloud=True)
    pictures = set(files_below(out / "pictures"))
    assert (out / "cloud.ply").is_file()
    (out / "pictures" / "holiday.jpg").write_text("mine")
    slam(sequence=write_sequence(short, 2), out=out, features=200)
    assert json.loads((out / "metrics.json").read_text())["frames"] == 2
    assert not (out / "cloud.ply").exists()
    assert set(files_below(out / "pictures")) < pictures | {"holiday.jpg"}
    assert {(out / name).read_text() for name in ("mine.txt", "pictures/holiday.jpg")} == {"mine"}
    (out / "cloud.ply").write_text("mine")
    assert main(["slam", "--sequence", str(short), "--out", str(out), "--cloud"]) == 1
    assert "holds cloud.ply, not written" in capsys.readouterr().err
    assert (out / "cloud.ply").read_text() == "mine"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda root: (root / "rgb.txt").unlink(), "rgb.txt: cannot be read"),
        (lambda root: (root / "depth.txt").write_text("1.0\n"), "depth.txt:1: expected"),
        (lambda root: (root / "camera.yaml").unlink(), "cannot tell the camera"),
        (
            lambda root: (root / "camera.yaml").write_text("fx: 1\n fy: 2\n"),
            "camera.yaml:2: broken yaml",
        ),
        (
            lambda root: (root / "camera.yaml").write_text(CAMERA_YAML.replace("320", "640")),
            "the camera says 640x240",
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
        "--sequence",
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
        slam(sequence=tmp_path, out=tmp_path / "o", model=tmp_path / "m.onnx", masks=tmp_path)


def test_a_missing_sequence_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone: no such folder"):
        slam(sequence=tmp_path / "gone", out=tmp_path / "out")


def test_out_must_not_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(DataError, match="is a file"):
        slam(sequence=tmp_path, out=tmp_path / "out")


def test_out_must_be_writable(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="out: cannot be written"):
        slam(sequence=tmp_path, out=tmp_path / "file" / "out")


@pytest.mark.parametrize(("name", "value"), [("seed", -1), ("features", 0), ("features", -5)])
def test_numbers_that_cannot_be_are_told(tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(DataError, match=f"{name} is {value}"):
        slam(sequence=tmp_path, out=tmp_path / "out", **{name: value})  # type: ignore[arg-type]


def test_a_truth_of_another_time_costs_the_scores_not_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_sequence(tmp_path / "room", 4)
    (root / "groundtruth.txt").write_text(
        "7.0 0 0 0 0 0 0 1\n7.1 0 0 0 0 0 0 1\n7.2 0 0 0 0 0 0 1\n"
    )
    metrics = slam(sequence=root, out=tmp_path / "out", features=200)
    assert metrics["tracked"] == 4
    assert "ate_m" not in metrics
    assert "no scores: 0 of 4 poses lie within" in capsys.readouterr().err
    assert (tmp_path / "out" / "trajectory.txt").is_file()


class TwoClasses:
    """Stands for a segmenter: one person in the left half of whatever it sees."""

    class_names = ("person", "chair")

    def __init__(self, quality: float = 1.0, cut_by_quality: bool = False) -> None:
        self.quality = np.full(1, quality, dtype=np.float32)
        self.cut_by_quality = cut_by_quality

    def __call__(self, rgb: np.ndarray) -> Detections:
        height, width = rgb.shape[:2]
        box = np.array([[0, 0, width / 2, height]], dtype=np.float32)
        one = np.ones(1, dtype=np.float32)
        mask = np.ones((1, 28, 28), dtype=np.float32)
        return Detections(
            box,
            np.zeros(1, dtype=np.int64),
            one,
            self.quality,
            mask,
            (height, width),
            self.class_names,
        )


def test_a_model_masks_the_classes_that_are_asked_for() -> None:
    view = View(
        0.0,
        "0",
        "0",
        np.zeros((240, 320, 3), dtype=np.uint8),
        np.zeros((240, 320), dtype=np.float32),
    )
    model = TwoClasses()
    assert SegmenterMasks(model, Culling(dilate=0))(view).mean() == 0.5  # type: ignore[arg-type]
    chairs = SegmenterMasks(model, Culling(dynamic_classes=["chair"]))  # type: ignore[arg-type]
    assert not chairs(view).any()
    with pytest.raises(DataError, match="'dog' is not one of the model's: person, chair"):
        SegmenterMasks(model, Culling(dynamic_classes=["dog"]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("cut_by_quality", "doubt", "px"),
    [(False, None, 20), (True, None, 10), (True, 1.0, 20), (False, 0.0, 10)],
)
def test_a_doubtful_contour_grows_more_unless_its_cut_has_seen_to_that(
    cut_by_quality: bool, doubt: float | None, px: int
) -> None:
    view = View(
        0.0,
        "0",
        "0",
        np.zeros((240, 320, 3), dtype=np.uint8),
        np.zeros((240, 320), dtype=np.float32),
    )
    masks = SegmenterMasks(TwoClasses(0.0, cut_by_quality), Culling(dilate=10, doubt=doubt))  # type: ignore[arg-type]
    assert masks(view)[120].sum() == 160 + px
    assert masks.outline(view)[1] == px


def threads() -> set[int]:
    """Of the libraries that do linear algebra."""
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_linear_algebra_has_one_thread_while_it_runs(sequence: Path, tmp_path: Path) -> None:
    seen = set()
    with threadpool_limits(2, "blas"):
        source = Recorded(sequence, choose_camera(sequence, None)[0])
        run_source(
            source, out=tmp_path / "out", features=300, on_pose=lambda pose: seen.update(threads())
        )
        assert seen == {1}
        assert threads() == {2}, "they are given back"


def test_torch_is_never_imported() -> None:
    code = (
        "import sys, cohdc_train.slam.run, cohdc_train.segmenter; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
