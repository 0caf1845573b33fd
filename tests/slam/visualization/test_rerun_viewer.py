"""Recording of a run for rerun, read with rerun's own tool; and runs without rerun."""

import subprocess
import sys
from pathlib import Path

import pytest
from plane_world import write_sequence

from cohdc_train.cli import main


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a sequence of ten frames with a passer-by."""
    return write_sequence(tmp_path_factory.mktemp("view") / "walk", 10, with_passer_by=True)


def arguments(sequence: Path, out: Path) -> list[str]:
    """Return the command line of a small run with masks."""
    words = [
        "slam",
        str(sequence),
        "--masks",
        str(sequence / "masks"),
        "--out",
        str(out),
    ]
    return [*words, "--settings.features.max_keypoints", "400"]


def test_recording_holds_camera_image_mask_map_path_and_times(
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
        "world/trajectory",
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


def test_recording_of_a_failed_run_is_removed(sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk comes with the view extra")
    words = [*arguments(sequence, tmp_path / "run"), "--rrd", str(tmp_path / "run.rrd")]
    words[words.index("--masks") + 1] = str(
        sequence / "depth"
    )  # has no files with the names of the masks
    assert main(words) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", [["--viewer"], ["--rrd", "run.rrd"]])
def test_missing_rerun_is_an_error_with_the_install_command(
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
