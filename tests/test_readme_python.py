"""README's Python block runs as it stands."""

import re
from pathlib import Path
from typing import Any

import pytest
from plane_world import write_sequence

ROOT = Path(__file__).resolve().parents[1]


def test_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    write_sequence(tmp_path / "recording", 4)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(example, names)
    assert names["result"].is_tracked
    assert len(names["trajectory"]) == 4
    assert (tmp_path / "trajectory.txt").is_file()
