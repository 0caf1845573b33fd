"""A run shown in rerun: recorded without a window, read back by rerun's own tool; and what happens
without it.
"""

import subprocess
import sys
from pathlib import Path

import pytest
from plane_world import write_sequence

from cohdc_train.cli import main


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames with a passer-by."""
    return write_sequence(tmp_path_factory.mktemp("view") / "walk", 10, with_passer_by=True)


def arguments(sequence: Path, out: Path) -> list[str]:
    words = [
        "slam",
        "--sequence",
        str(sequence),
        "--masks",
        str(sequence / "masks"),
        "--out",
        str(out),
    ]
    return [*words, "--features", "400"]


def test_a_recording_holds_camera_image_mask_map_way_and_times(
    sequence: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk comes with the view extra")
    assert (
        main([*arguments(sequence, tmp_path / "run"), "--rrd", str(tmp_path / "rrd" / "run.rrd")])
        == 0
    )
    assert [path.name for path in (tmp_path / "rrd").iterdir()] == ["run.rrd"]
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    recording = str(tmp_path / "rrd" / "run.rrd")
    subprocess.run([*rerun, "verify", recording], check=True, capture_output=True)
    stats = subprocess.run(
        [*rerun, "stats", recording], check=True, capture_output=True, text=True
    ).stdout
    parts = (
        "world/camera/image",
        "world/camera/mask",
        "world/points",
        "world/way",
        "ms/track",
        "ms/segment",
        "inliers",
    )
    for part in parts:
        assert f"\n/{part}: " in stats, part
    for component in (
        "Pinhole:image_from_camera",
        "Transform3D:translation",
        "Points3D:colors",
        "EncodedImage:blob",
    ):
        assert f"\n{component}: " in stats, component


def test_a_recording_of_a_run_that_fails_is_not_left(sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk comes with the view extra")
    words = [*arguments(sequence, tmp_path / "run"), "--rrd", str(tmp_path / "run.rrd")]
    words[words.index("--masks") + 1] = str(sequence / "depth")  # no file of the masks' names
    assert main(words) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", [["--view"], ["--rrd", "run.rrd"]])
def test_without_rerun_the_command_that_installs_it_is_named(
    sequence: Path,
    tmp_path: Path,
    option: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)  # import rerun: ModuleNotFoundError
    monkeypatch.chdir(tmp_path)
    assert main([*arguments(sequence, tmp_path / "run"), *option]) == 1
    error = capsys.readouterr().err
    assert "pip install 'cohdc-train[view]'" in error
    assert len(error.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
