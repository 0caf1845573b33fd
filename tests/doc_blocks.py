"""Fenced blocks of Markdown pages, and the `cohdc` commands in them."""

import functools
import importlib
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import option_reference

from cohdc_train.cli import COMMANDS, main
from cohdc_train.errors import CohdcError
from cohdc_train.presets import config_path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"

_BLOCK = re.compile(
    r"(?:^<!-- (?P<marker>[^\n]*?) -->\n)?^```(?P<language>[a-z]*)\n(?P<text>.*?)^```$",
    flags=re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    """A fenced block, and the comment in the line above it, such as `run: slow`."""

    language: str
    marker: str
    text: str


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page, in their order."""
    found = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(m["language"], m["marker"] or "", m["text"]) for m in found]


def split_command(line: str) -> list[str]:
    """Return the words after `cohdc` in one shell command; empty when it is another program."""
    words = shlex.split(line, comments=True)
    if not words or Path(words[0]).name != "cohdc":
        return []
    redirections = [i for i, word in enumerate(words) if word.startswith((">", "2>"))]
    return words[1 : redirections[0]] if redirections else words[1:]


def commands(text: str) -> list[list[str]]:
    """Return the words after `cohdc` of every command in a text.

    Commands stand in fenced or indented blocks, and in inline code that has options. Continued
    lines are joined; comments and redirections are dropped.
    """
    fenced = re.findall(r"```[a-z]*\n(.*?)```", text, flags=re.DOTALL)
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    lines = fenced + re.findall(r"^(?: {4}|\t)(.*)$", prose, flags=re.MULTILINE)
    for inline in re.findall(r"`([^`]+)`", prose):
        command = " ".join(inline.split())
        if command.startswith("cohdc ") and " -" in command:
            lines.append(command)
    found = []
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|\|\||[;|]", line):
            if "cohdc" in part and (words := split_command(part)):
                found.append(words)
    return found


def silenced(component: Any) -> Any:
    """Return a verb, or a group of verbs, that looks the same to the parser and does nothing."""
    if isinstance(component, dict):
        return {name: silenced(function) for name, function in component.items()}

    @functools.wraps(component)
    def nothing(*args: object, **kwargs: object) -> None:
        return None

    return nothing


def check(words: list[str]) -> int:
    """Give a command to `cohdc` without running its verb; returns the exit code."""
    verb = COMMANDS.get(words[0]) if words else None
    if verb is None:
        return main(words)
    module = importlib.import_module(f"cohdc_train.{verb.module}")
    try:
        with mock.patch.object(module, verb.attribute, silenced(getattr(module, verb.attribute))):
            return main(words)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 2


@functools.cache
def fit_parser() -> Any:
    """Return the parser of `cohdc fit`, which Lightning builds in seconds."""
    return option_reference.parser_of("fit")


def check_fit(words: list[str]) -> int:
    """Parse the words after `cohdc fit`, without files of the reader; returns the exit code."""
    arguments = list(words)
    while arguments and not arguments[0].startswith("-"):
        arguments.pop(0)  # folders of data
    kept: list[str] = []
    for word in arguments:
        if kept and kept[-1] == "--config":
            try:
                word = str(config_path(word))
            except CohdcError:  # a file of the reader
                kept.pop()
                continue
        kept.append(word)
    try:
        fit_parser().parse_args(kept)
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 2
    return 0
