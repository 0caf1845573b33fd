"""tools/experiments/carried_masks.py measures how well masks are propagated."""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from plane_world import write_sequence
from tool_loader import load_tool


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_tool("experiments/carried_masks.py")


def run(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, root: Path, frames: int, *steps: str
) -> None:
    write_sequence(root / "plane", frames, with_passer_by=True)
    words = ["--sequences", str(root / "plane"), "--out", str(root / "out"), "--steps", *steps]
    monkeypatch.setattr(sys, "argv", ["carried_masks", *words])
    tool.main()


def test_table_holds_covered_share_of_people_and_of_the_rest(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tool, monkeypatch, tmp_path, 24, "1", "10")
    one, ten = json.loads((tmp_path / "out" / "carried_masks.json").read_text())
    assert (one["frames"], ten["frames"]) == (1, 10)
    for row in (one, ten):
        assert row["covered"] > 0.97, "without propagation it would cover .85"
        assert 0 <= row["others"] < 0.01
    assert (
        f"| plane | 10 | {ten['iou']:.3f} |" in (tmp_path / "out" / "carried_masks.md").read_text()
    )


def test_overlap_counts_pixels(tool: ModuleType) -> None:
    truth, mask = np.zeros((2, 10, 10), dtype=np.bool_)
    truth[:4, :5] = True
    mask[2:6, :5] = True
    assert tool.overlap(mask, truth) == (10 / 30, 10 / 20, 10 / 80)


def test_sequence_shorter_than_the_steps_is_an_error(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        SystemExit, match="plane: of 4 frames none with anybody in it has 4 after it"
    ):
        run(tool, monkeypatch, tmp_path, 4, "1", "4")


def test_steps_below_one_are_an_error(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit, match="1 or more, not 0"):
        run(tool, monkeypatch, tmp_path, 4, "0", "4")
