"""README: its commands parse, its links lead to files."""

import re

import pytest
from doc_blocks import ROOT, check, check_fit, commands

README = (ROOT / "README.md").read_text(encoding="utf-8")
LIGHTNING = ("fit",)  # Lightning parses it by itself


README_COMMANDS = commands(README)


@pytest.mark.parametrize(
    "words",
    [words for words in README_COMMANDS if words[:1] not in [[v] for v in LIGHTNING]],
    ids=" ".join,
)
def test_command_parses(words: list[str]) -> None:
    assert check(words) == 0


@pytest.mark.parametrize(
    "words",
    [words for words in README_COMMANDS if words[:1] in [[v] for v in LIGHTNING]],
    ids=" ".join,
)
def test_training_command_parses(words: list[str]) -> None:
    assert check_fit(words[1:]) == 0


def test_wrong_training_command_is_caught() -> None:
    assert check_fit(["DATA", "--minuets", "3"]) == 2
    assert check_fit(["DATA", "--epochs", "many"]) == 2


def test_links_lead_to_files() -> None:
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", README)
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_commands_are_found_in_blocks() -> None:
    text = (
        "Say cohdc fly or `cohdc fly`, then `cohdc env --help`.\n    data -> cohdc fit -> file\n\n"
        "```sh\npython3 -m venv .venv && .venv/bin/cohdc demo --quick true  # minutes\n"
        "cohdc evaluate a.txt \\\n  b.txt > log\n```\n\n    cohdc --help\n"
    )
    expected = ["demo --quick true", "evaluate a.txt b.txt", "--help", "env --help"]
    assert [" ".join(words) for words in commands(text)] == expected


@pytest.mark.parametrize(
    "line", ["fly", "evaluate one.txt", "evaluate a b --spin 3", "--helpp", "predict x --model m"]
)
def test_wrong_command_is_caught(line: str) -> None:
    assert check(line.split()) == 2


def test_right_command_passes() -> None:
    assert check(["evaluate", "a.txt", "b.txt", "--out", "scores.json"]) == 0
    assert (
        check(["predict", "images", "--model", "m.onnx", "--out", "folder", "--score", "0.3"]) == 0
    )
    assert check(["synth", "sequence", "folder"]) == 0
    assert check(["slam", "--help"]) == 0
