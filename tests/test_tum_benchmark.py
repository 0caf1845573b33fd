"""tools/tum_benchmark: finds the sequences below a folder, linked ones too, runs each once, writes
rows and tables.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("embreex")

TOOL = Path(__file__).parents[1] / "tools" / "tum_benchmark"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    from cohdc_train.synth.sequence import sequence

    sequence(tmp_path / "elsewhere" / "walking_xyz", frames=8, size=(120, 160), people=1)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    return tmp_path / "root"


def call(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, TOOL, *words], capture_output=True, text=True)


def test_a_linked_sequence_is_run_once_for_each_mode(root: Path, tmp_path: Path) -> None:
    words = (
        "--root",
        str(root),
        "--out",
        str(tmp_path / "out"),
        "--modes",
        "none",
        "masks",
        "--seeds",
        "0",
    )
    done = call(*words)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [(row["sequence"], row["mode"], row["seed"]) for row in rows] == [
        ("linked/walking_xyz", "none", 0),
        ("linked/walking_xyz", "masks", 0),
    ]
    metrics = tmp_path / "out" / "linked" / "walking_xyz" / "none_seed0" / "metrics.json"
    assert rows[0]["ate_m_rmse"] == json.loads(metrics.read_text())["ate_m"]["rmse"]
    table = (tmp_path / "out" / "benchmark.md").read_text()
    assert "### linked/walking_xyz\n" in table
    assert f"| ATE rmse | {rows[0]['ate_m_rmse']:.4f} (" in table
    assert "DynaSLAM" not in table, "what was published is of TUM's own walking_xyz"
    made = metrics.stat().st_mtime_ns
    assert call(*words).returncode == 0
    assert metrics.stat().st_mtime_ns == made


def test_published_figures_stand_beside_tums_own_sequence(root: Path, tmp_path: Path) -> None:
    (root / "linked").unlink()
    (root / "rgbd_dataset_freiburg3_walking_xyz").symlink_to(tmp_path / "elsewhere" / "walking_xyz")
    done = call(
        "--root", str(root), "--out", str(tmp_path / "out"), "--modes", "none", "--seeds", "0"
    )
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "out" / "benchmark.md").read_text()
    assert "| none, median (worst) | paper |" in table
    assert "| 0.0275 |" in table
    assert "DynaSLAM 0.0150" in table


def test_a_folder_without_sequences_is_one_line(tmp_path: Path) -> None:
    done = call("--root", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 1
    assert done.stderr == f"{tmp_path}: no folder with rgb.txt, depth.txt and groundtruth.txt\n"
