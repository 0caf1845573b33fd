"""`cohdc bench tum`: sequences are found, each run is made once, and the tables hold the scores."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cohdc_train.bench.tum import find_sequences, flatten, format_spread, format_tables
from cohdc_train.cli import main


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Make a folder that holds a link to a rendered sequence."""
    pytest.importorskip("embreex")
    from cohdc_train.synth.sequence import sequence

    sequence(tmp_path / "elsewhere" / "walking_xyz", frames=8, size=(120, 160), people=1)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    return tmp_path / "root"


def bench(root: Path, out: Path, *words: str) -> int:
    return main(["bench", "tum", str(root), "--out", str(out), *words])


def test_linked_sequence_runs_once_in_each_mode(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ("--modes", "[none, masks]", "--seeds", "[0]")
    assert bench(root, out, *words) == 0
    rows = json.loads((out / "benchmark.json").read_text())
    assert [(row["sequence"], row["mode"], row["seed"]) for row in rows] == [
        ("linked/walking_xyz", "none", 0),
        ("linked/walking_xyz", "masks", 0),
    ]
    metrics = out / "linked" / "walking_xyz" / "none_seed0" / "metrics.json"
    assert rows[0]["ate_m_rmse"] == json.loads(metrics.read_text())["ate_m"]["rmse"]
    table = (out / "benchmark.md").read_text()
    assert "### linked/walking_xyz\n" in table
    assert f"| ATE rmse | {rows[0]['ate_m_rmse']:.4f} (" in table
    assert "DynaSLAM" not in table, "published figures are of TUM's own walking_xyz"
    written = metrics.stat().st_mtime_ns
    assert bench(root, out, *words) == 0
    assert metrics.stat().st_mtime_ns == written


def test_failed_run_is_named_and_the_others_are_kept(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--modes", "[none, model]", "--seeds", "[0]", "--model", str(tmp_path / "no.onnx"))
    assert bench(root, tmp_path / "out", *words) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("cohdc bench: 1 of 2 runs failed, the first: linked/walking_xyz model")
    rows = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [row["mode"] for row in rows] == ["none"]


def test_tums_own_sequence_stands_next_to_published_figures() -> None:
    row = {"sequence": "a/rgbd_dataset_freiburg3_walking_xyz", "mode": "none", "seed": 0}
    table = format_tables([{**row, "ate_m_rmse": 0.5, "coverage": 1.0}])
    assert "| none, median (worst) | paper |" in table
    assert "| ATE rmse | 0.5000 (0.5000) | 0.0275 |" in table
    assert "| RPE 1 s rmse | - |  |" in table
    assert "DynaSLAM 0.0150" in table


def test_spread_is_median_and_worst_of_known_values() -> None:
    assert format_spread([1.0, 4.0, 2.0]) == "2.0000 (4.0000)"
    assert format_spread([1.0, None, 0.5], min) == "0.7500 (0.5000, 2 of 3)"
    assert format_spread([None]) == "-"


def test_nested_metrics_get_joined_names() -> None:
    metrics = {"seed": 3, "ate_m": {"rmse": 0.1}, "ms": {"track": {"p50": 2.0}}, "frames": 5}
    assert flatten(metrics) == {"ate_m_rmse": 0.1, "ms_track_p50": 2.0, "frames": 5}


def test_folder_that_is_a_sequence_itself_has_its_own_name(tmp_path: Path) -> None:
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (tmp_path / name).touch()
    assert find_sequences(tmp_path) == {tmp_path.name: tmp_path}


def test_folder_without_sequences_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench(tmp_path, tmp_path / "out") == 1
    message = f"{tmp_path}: no folder with rgb.txt, depth.txt and groundtruth.txt\n"
    assert capsys.readouterr().err == f"cohdc bench: {message}"
    assert not (tmp_path / "out").exists()


def test_command_loads_no_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from cohdc_train.cli import main\n"
        f"code = main(['bench', 'tum', {str(tmp_path)!r}, '--out', 'never'])\n"
        "import cohdc_train.slam.run\n"
        "print(code, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "False"]
