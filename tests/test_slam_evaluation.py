"""tools/experiments/slam_evaluation.py: renders once, runs what is missing, reports."""

import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
from slam_settings import parse_settings
from tool_loader import load_tool

from cohdc_train.errors import DataError

pytest.importorskip("embreex")


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_tool("experiments/slam_evaluation.py")


@pytest.fixture(scope="module")
def folder(tool: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluation")
    call(tool, folder, "--modes", "none", "movers")
    return folder


def call(tool: ModuleType, folder: Path, *more: str) -> None:
    words = [
        "--root",
        str(folder / "set"),
        "--out",
        str(folder / "out"),
        "--quick",
        "--sequences",
        "rolling_cart",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["slam_evaluation", *words, *more])
        tool.main()


def rows(folder: Path) -> list[dict[str, object]]:
    found: list[dict[str, object]] = json.loads((folder / "out" / "evaluation.json").read_text())
    return found


def test_rows_and_table(folder: Path) -> None:
    assert [(row["sequence"], row["mode"], row["seed"]) for row in rows(folder)[:2]] == [
        ("rolling_cart", "none", 0),
        ("rolling_cart", "movers", 0),
    ]
    for row in rows(folder)[:2]:
        metrics = json.loads(
            (folder / "out" / "rolling_cart" / f"{row['mode']}_seed0" / "metrics.json").read_text()
        )
        assert row["ate_m"] == metrics["ate_m"]["rmse"]
        assert row["coverage"] == metrics["coverage"] == 1
        assert row["settings"] == {}
    table = (folder / "out" / "evaluation.md").read_text()
    assert f"| rolling_cart | {rows(folder)[0]['ate_m']:.4f} (" in table
    assert "100 %" in table


def test_what_is_there_is_neither_rendered_nor_run_again(
    tool: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("made again")

    before = rows(folder)
    monkeypatch.setattr(tool, "run_slam", refuse)
    monkeypatch.setattr(tool, "sequence", refuse)
    call(tool, folder, "--modes", "none", "movers")
    assert rows(folder) == before
    with pytest.raises(AssertionError, match="made again"):
        call(tool, folder, "--modes", "none", "--seeds", "1")
    with pytest.raises(AssertionError, match="made again"):
        call(tool, folder, "--modes", "none", "--settings", "loops.enabled=false")


def test_other_code_drops_old_rows(tool: ModuleType, folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps([{"code": "old"}, {"code": "new"}]))
    assert tool.kept(path, "new") == [{"code": "new"}]
    assert tool.kept(tmp_path / "nothing.json", "new") == []


def test_settings_are_checked() -> None:
    assert parse_settings(["loops.enabled=false"]) == {"loops.enabled": False}
    with pytest.raises(DataError, match=r"no option loop; did you mean loops\?"):
        parse_settings(["loop.enabled=false"])
    with pytest.raises(DataError, match=r"loops\.enabled is 'perhaps', not bool"):
        parse_settings(["loops.enabled=perhaps"])


def test_a_set_of_another_size_is_not_taken_for_this_one(tool: ModuleType, folder: Path) -> None:
    with pytest.raises(SystemExit, match="rendered with other options"):
        tool.render(folder / "set" / "rolling_cart", tool.KINDS["rolling_cart"], 9, tool.QUICK_SIZE)


def test_the_set_has_a_dozen_kinds_with_seeds_of_their_own(tool: ModuleType) -> None:
    assert len(tool.KINDS) == 12
    assert len({kind.seed for kind in tool.KINDS.values()}) == 12
    for kind in tool.KINDS.values():
        kind.scene.check(kind.motion, kind.people)


def test_a_lost_run_is_told(tool: ModuleType) -> None:
    lost = {"ate_m": None, "coverage": 0.1}
    assert tool.cell([lost]) == "lost, 10 %"
    assert tool.cell([lost, {"ate_m": 0.25, "coverage": 1.0}]) == "0.2500 (0.2500), 10 %"
