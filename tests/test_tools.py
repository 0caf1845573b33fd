"""tools/: what is run from a checkout; each study is named by the page that it reproduces."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = ROOT / "tools" / "experiments"
SOURCES = sorted(EXPERIMENTS.glob("*.py"))
SCRIPTS = [file for file in SOURCES if file.read_text(encoding="utf-8").startswith("#!")]
HELPERS = [file for file in SOURCES if file not in SCRIPTS]


def test_tools_holds_experiments_and_ros2_only() -> None:
    names = {path.name for path in (ROOT / "tools").iterdir()} - {"__pycache__"}
    assert names == {"experiments", "ros2"}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_study_is_named_by_a_page(script: Path) -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    cards = (ROOT / "cohdc_train" / "shipped").glob("*.md")
    name = f"tools/experiments/{script.name}"
    texts = [page.read_text(encoding="utf-8") for page in (*pages, *cards)]
    named = any(name in text for text in texts)
    is_part_of_golden = script.name == "golden_flow.py"
    assert named or is_part_of_golden


@pytest.mark.parametrize("helper", HELPERS, ids=lambda path: path.name)
def test_module_is_imported_by_a_study(helper: Path) -> None:
    imported = set()
    for file in SOURCES:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module or "")
    assert helper.stem in imported
