"""tools/experiments/late_masks.py: real time without a clock, so that results repeat."""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import slam_config, write_sequence
from tool_loader import load_tool

from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.run import slam


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_tool("experiments/late_masks.py")


def square(frame: int) -> NDArray[np.bool_]:
    """Return a mask whose place tells the frame that it was made for."""
    mask = np.zeros((240, 640), dtype=np.bool_)
    mask[100:140, 60 * frame + 20 : 60 * frame + 60] = True
    return mask


@pytest.mark.parametrize(("late", "made_for"), [(0, range(8)), (2, [0, 0, 0, 1, 1, 3, 3, 5])])
def test_mask_is_that_of_the_latest_finished_frame(
    tool: ModuleType, late: int, made_for: list[int]
) -> None:
    """The scene is static, so that a mask stays in its place."""
    gray = np.random.default_rng(0).integers(0, 255, (240, 640, 1)).astype(np.uint8)
    rgb, depth = gray.repeat(3, axis=2), np.full((240, 640), 2.0, dtype=np.float32)
    masks = tool.LateMasks(lambda view: (square(int(view.name)), 0.0), late)
    for frame, wanted in enumerate(made_for):
        mask = masks(RGBDFrame(frame / 30, rgb, depth, name=str(frame)))
        assert np.flatnonzero(mask[120, 40::60][:8]).tolist() == [wanted], frame


def test_run_without_delay_and_flow_equals_the_synchronous_run(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = write_sequence(tmp_path / "plane", 12, with_passer_by=True)
    words = [
        "--sequences",
        str(sequence),
        "--out",
        str(tmp_path / "out"),
        "--features",
        "400",
        "--late",
        "0",
        "2",
    ]
    monkeypatch.setattr(sys, "argv", ["late_masks", *words, "--settings", "flow.enabled=false"])
    tool.main()
    rows = json.loads((tmp_path / "out" / "late_masks.json").read_text())
    assert [(row["sequence"], row["late"], row["features"]) for row in rows] == [
        ("plane", 0, 400),
        ("plane", 2, 400),
    ]
    run = slam(sequence, out=tmp_path / "run", masks=sequence / "masks", settings=slam_config(400))
    assert rows[0]["ate_m"] == pytest.approx(run["ate_m"]["rmse"], rel=1e-3)
    assert (
        f"| plane | 0 | {rows[0]['ate_m']:.4f} |"
        in (tmp_path / "out" / "late_masks.md").read_text()
    )


@pytest.mark.parametrize("gone", ["groundtruth.txt", "rgb.txt"])
def test_unusable_sequence_is_an_error_of_one_line(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: str
) -> None:
    (write_sequence(tmp_path / "plane", 4) / gone).unlink()
    monkeypatch.setattr(
        sys, "argv", ["late_masks", "--sequences", str(tmp_path / "plane"), "--out", str(tmp_path)]
    )
    with pytest.raises(SystemExit, match=gone) as stopped:
        tool.main()
    assert "\n" not in str(stopped.value)
