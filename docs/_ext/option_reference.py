"""Write the option reference and the Python reference from the code.

The pages come from the parsers that `cohdc` itself builds, and from `cohdc_train.__all__`.
Nothing about an option or a name is repeated here, so the pages cannot disagree with the code.
"""

import re
from argparse import SUPPRESS
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import jsonargparse

import cohdc_train
from cohdc_train.cli import COMMANDS, main

FOREIGN_GROUPS = ("trainer", "checkpoint")  # groups that Lightning defines and documents


class ParserBuilt(BaseException):
    """Carry a verb's parser out of `main` before it parses anything."""

    def __init__(self, parser: jsonargparse.ArgumentParser) -> None:
        super().__init__()
        self.parser = parser


def parser_of(verb: str) -> jsonargparse.ArgumentParser:
    """Return the parser that `cohdc VERB` builds, without running the verb."""

    def carry_out(parser: jsonargparse.ArgumentParser, *args: Any, **kwargs: Any) -> None:
        raise ParserBuilt(parser)

    with mock.patch.object(jsonargparse.ArgumentParser, "parse_args", carry_out):
        try:
            main([verb])
        except ParserBuilt as built:
            return built.parser
    raise RuntimeError(f"cohdc {verb} built no parser")


def subcommands(parser: jsonargparse.ArgumentParser) -> dict[str, jsonargparse.ArgumentParser]:
    """Return the parsers of a group of verbs by name; empty for a single verb."""
    for action in parser._actions:
        if type(action).__name__ == "ActionSubCommands":
            return dict(action.choices)
    return {}


def options(group: Any) -> list[Any]:
    """Return the actions of an argument group that a user sets."""
    hidden = ("ActionLink", "_ActionConfigLoad", "_ActionHelpClassPath", "ActionSubCommands")
    shown = []
    for action in group._group_actions:
        name = (action.option_strings or [action.dest])[0]
        if action.help == SUPPRESS or type(action).__name__ in hidden:
            continue
        if name in ("-h", "--help", "--print_config"):
            continue
        shown.append(action)
    return shown


def plain(text: str) -> str:
    """Return text on one line, with reStructuredText literals as Markdown code."""
    words = " ".join(str(text).replace("%%", "%").split())
    words = words.replace("``", "`")
    parts = re.split(r"(`[^`]*`)", words)
    escaped = [part if part.startswith("`") else escape(part) for part in parts]
    return "".join(escaped)


def escape(text: str) -> str:
    """Escape what Markdown would read as markup."""
    return re.sub(r"([\\*_<>\[\]{}|#$])", r"\\\1", text)


def type_of(action: Any) -> str:
    """Return an option's type in short, as jsonargparse prints it; empty where it has none."""
    hint = getattr(action, "_typehint", None)
    if hint is None:
        return ""
    if isinstance(hint, type) and not hasattr(hint, "__args__"):
        return hint.__name__
    text = str(hint).replace("typing.", "").replace("collections.abc.", "")
    text = re.sub(r"(?:\w+\.)+(\w+)", r"\1", text)
    text = text.replace("NoneType", "None")
    return text if len(text) <= 90 else ""


def value_of(default: Any) -> str:
    """Return a default as it is written on the command line."""
    if default is None:
        return "none"
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, list | tuple):
        return str(default).replace("(", "[").replace(",)", "]").replace(")", "]")
    return str(default)


def sentence(text: str) -> str:
    """Return text with a capital letter and a period."""
    if not text:
        return ""
    period = "" if text.endswith((".", ")", ":")) else "."
    return f"{text[:1].upper()}{text[1:]}{period}"


def entry(action: Any) -> str:
    """Return one option as a Markdown definition."""
    names = [name for name in action.option_strings if not name.endswith("+")]
    names = [name for name in names if not name.startswith("--no_")]
    title = " ".join(f"`{name}`" for name in names) or f"`{action.dest.upper()}`"
    facts = []
    if kind := type_of(action):
        facts.append(f"`{kind}`")
    if not action.option_strings or action.required:
        facts.append("required")
    elif action.default is not SUPPRESS:
        facts.append(f"default `{value_of(action.default)}`")
    text = plain(action.help or "")
    text = sentence(text)
    details = f" ({', '.join(facts)})" if facts else ""
    return f"{title}{details}\n: {text or 'See above.'}"


def group_title(group: Any, shown: list[Any]) -> str:
    """Return a heading: the option prefix that the group shares, and what the group is."""
    first = (shown[0].option_strings or [""])[0]
    prefix = first.rpartition(".")[0]
    words = plain(group.title or "")
    words = words[:1].upper() + words[1:]
    if prefix.lstrip("-") in FOREIGN_GROUPS:
        words = "Lightning's own options"
    return f"`{prefix}.*`: {words}" if prefix else words


def group_pages(parser: jsonargparse.ArgumentParser, level: int) -> Iterator[str]:
    """Yield the argument groups of a parser as Markdown sections."""
    for group in parser._action_groups:
        shown = options(group)
        if not shown:
            continue
        yield f"{'#' * level} {group_title(group, shown)}"
        yield from (entry(action) for action in shown)


def verb_page(verb: str) -> str:
    """Return the page of one verb."""
    parser = parser_of(verb)
    parts = [f"# cohdc {verb}", sentence(plain(COMMANDS[verb].summary))]
    members = subcommands(parser)
    if not members:
        parts += group_pages(parser, 2)
    for name, member in members.items():
        parts.append(f"## cohdc {verb} {name}")
        if member.description:
            parts.append(plain(member.description))
        parts += group_pages(member, 3)
    return "\n\n".join(parts) + "\n"


def options_index() -> str:
    """Return the page that lists the verbs."""
    rows = [
        f"| [`cohdc {verb}`]({verb}.md) | {plain(COMMANDS[verb].summary)} |" for verb in COMMANDS
    ]
    table = "\n".join(["| verb | what it does |", "|---|---|", *rows])
    toctree = "\n".join(["```{toctree}", ":hidden:", "", *COMMANDS, "```"])
    text = (
        "Every option of every verb, with its help and its default. These pages are generated "
        "from the parsers when the site is built.\n\n"
        "Any of these options can stand in a YAML file that `--config` reads. "
        "`--print_config` after other options prints the file that repeats them."
    )
    return f"# Options\n\n{text}\n\n{table}\n\n{toctree}\n"


def api_page() -> str:
    """Return the page of the public Python names."""
    parts = [
        "# Python",
        "These names are the public interface: `from cohdc_train import Segmenter`. "
        "They load when they are used, so `import cohdc_train` needs no torch.",
    ]
    for name in sorted(set(cohdc_train.__all__) - {"__version__"}, key=str.lower):
        directive = "autoclass" if isinstance(getattr(cohdc_train, name), type) else "autofunction"
        members = "   :members:\n" if directive == "autoclass" else ""
        parts.append(f"## {name}")
        parts.append(f"```{{eval-rst}}\n.. {directive}:: cohdc_train.{name}\n{members}```")
    return "\n\n".join(parts) + "\n"


def write_if_changed(path: Path, text: str) -> None:
    """Write a page, and leave it untouched where nothing changed, so that builds stay short."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def write_pages(app: Any) -> None:
    """Write all generated pages below docs/reference/."""
    folder = Path(app.srcdir) / "reference"
    pages = {f"{verb}.md": verb_page(verb) for verb in COMMANDS}
    pages["index.md"] = options_index()
    for stale in (folder / "options").glob("*.md"):
        if stale.name not in pages:
            stale.unlink()
    for name, text in pages.items():
        write_if_changed(folder / "options" / name, text)
    write_if_changed(folder / "python.md", api_page())


def quiet_markup(app: Any, what: str, name: str, obj: Any, opts: Any, lines: list[str]) -> None:
    """Escape lone asterisks and bars in docstrings, which are not reStructuredText."""
    for i, line in enumerate(lines):
        if line.startswith((":", "..", "*")):
            continue
        lines[i] = re.sub(r"(?<!\*)\*(?![*\s])", r"\\*", line).replace("|", r"\|")


def setup(app: Any) -> dict[str, Any]:
    """Connect to Sphinx."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", quiet_markup)
    return {"version": "1", "parallel_read_safe": True}
