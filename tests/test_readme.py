"""README: its commands parse, its links lead to files."""

import functools
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from cohdc_train.cli import COMMANDS, main

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LIGHTNING = ("fit",)  # Lightning parses it by itself


def commands(text: str) -> list[list[str]]:
    """List the words after `cohdc` of every command in a text's code blocks and sentences.

    A sentence may mention `cohdc COMMAND`; with options it is a command. Continued lines are
    joined, comments and redirections dropped. A line counts when it, or what follows && or ;,
    begins with cohdc or a path to it.
    """
    fenced = re.findall(r"```[a-z]*\n(.*?)```", text, flags=re.DOTALL)
    plain = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    blocks = fenced + re.findall(r"^(?: {4}|\t)(.*)$", plain, flags=re.MULTILINE)
    blocks += [
        said
        for said in re.findall(r"`([^`]+)`", plain)
        if said.startswith("cohdc ") and " -" in said
    ]
    found = []
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|\|\||[;|]", line):
            words = shlex.split(part, comments=True)
            if words and Path(words[0]).name == "cohdc":
                stop = [i for i, word in enumerate(words) if word.startswith((">", "2>"))]
                found.append(words[1 : stop[0]] if stop else words[1:])
    return found


def stilled(component: Any) -> Any:
    """Wrap a command, or a group of them: the same signature, and no effect."""
    if isinstance(component, dict):
        return {name: stilled(function) for name, function in component.items()}

    @functools.wraps(component)
    def nothing(*args: object, **kwargs: object) -> None:
        return None

    return nothing


def check(words: list[str]) -> int:
    """Parse a command of `cohdc` without running it; returns the exit code."""
    verb = COMMANDS.get(words[0]) if words else None
    if verb is None:
        return main(words)
    module = importlib.import_module(f"cohdc_train.{verb.module}")
    try:
        with mock.patch.object(module, verb.attribute, stilled(getattr(module, verb.attribute))):
            return main(words)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 2


README_COMMANDS = commands(README)


@pytest.mark.parametrize(
    "words",
    [words for words in README_COMMANDS if words[:1] not in [[v] for v in LIGHTNING]],
    ids=" ".join,
)
def test_command_parses(words: list[str]) -> None:
    assert check(words) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [words for words in README_COMMANDS if words[:1] in [[v] for v in LIGHTNING]],
    ids=" ".join,
)
def test_training_command_parses(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cohdc_train", *words, "--print_config"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]


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
