"""What README says can be done: its commands parse, its links lead somewhere."""

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from jsonargparse import auto_parser

from cohdc_train.cli import VERBS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LIGHTNING = ("fit", "validate")  # Lightning parses these two by itself


def commands(text: str) -> list[list[str]]:
    """The words after `cohdc` of every command in a text's code blocks, fenced or indented.

    Continued lines are joined; comments, redirections and the words before `cohdc` (a path, `.venv/bin/`) are dropped.
    """
    fenced = re.findall(r"```[a-z]*\n(.*?)```", text, flags=re.DOTALL)
    plain = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    blocks = fenced + re.findall(r"^(?: {4}|\t)(.*)$", plain, flags=re.MULTILINE)
    found = []
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|\|\||[;|]", line):
            words = shlex.split(part, comments=True)
            starts = [i for i, word in enumerate(words) if word == "cohdc" or word.endswith("/cohdc")]
            if starts:
                words = words[starts[0] + 1 :]
                stop = [i for i, word in enumerate(words) if word.startswith((">", "2>"))]
                found.append(words[: stop[0]] if stop else words)
    return found


def check(words: list[str]) -> None:
    """Parse a command as `cohdc` would, without running it. Raises AssertionError or SystemExit when it is wrong."""
    if not words or words[0].startswith("-"):
        assert words in ([], ["--help"], ["-h"], ["--version"])
        return
    assert words[0] in VERBS, f"no verb {words[0]}"
    verb = VERBS[words[0]]
    component = getattr(importlib.import_module(f"cohdc_train.{verb.module}"), verb.attribute)
    auto_parser(component, as_positional=True).parse_args(words[1:])


COMMANDS = commands(README)


@pytest.mark.parametrize(
    "words", [words for words in COMMANDS if words[:1] not in [[v] for v in LIGHTNING]], ids=" ".join
)
def test_command_parses(words: list[str]) -> None:
    if "--help" not in words:
        check(words)


@pytest.mark.slow
@pytest.mark.parametrize("words", [words for words in COMMANDS if words[:1] in [[v] for v in LIGHTNING]], ids=" ".join)
def test_training_command_parses(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cohdc_train", *words, "--print_config"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_links_lead_to_files() -> None:
    links = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", README)
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_commands_are_found_in_blocks() -> None:
    text = (
        "Say cohdc fly in prose.\n```sh\npython3 -m venv .venv && .venv/bin/cohdc demo --quick true  # minutes\n"
        "cohdc evaluate a.txt \\\n  b.txt > log\n```\n\n    cohdc --help\n"
    )
    assert commands(text) == [["demo", "--quick", "true"], ["evaluate", "a.txt", "b.txt"], ["--help"]]


@pytest.mark.parametrize("line", ["fly", "evaluate one.txt", "evaluate a b --spin 3", "--helpp", "predict x --model m"])
def test_wrong_command_is_caught(line: str) -> None:
    with pytest.raises((AssertionError, SystemExit)):
        check(line.split())


def test_right_command_passes() -> None:
    check(["evaluate", "a.txt", "b.txt", "--out", "scores.json"])
    check(["predict", "images", "--model", "m.onnx", "--out", "folder", "--score", "0.3"])
