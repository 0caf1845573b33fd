"""Command line of the package: `cohdc COMMAND [options]`.

A command's module is imported when the command is called, so that `cohdc --help` costs nothing.
"""

import functools
import importlib
import inspect
import re
import sys
from collections.abc import Collection, Container, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, get_args, get_origin

from cohdc_train.errors import CohdcError, MissingExtraError


class Command(NamedTuple):
    """A row of the table of commands.

    Attributes:
        module: module below cohdc_train.
        attribute: typed function in it, or a dict of them: subcommand -> function.
        summary: line of `cohdc --help`.
        default: subcommand that a group without subcommands became, for the hint in an error.
        has_page: whether the command writes report.html into its output folder at the end.
    """

    module: str
    attribute: str
    summary: str
    default: str | None = None
    has_page: bool = False


COMMANDS = {
    "demo": Command(
        "demo", "demo", "all steps on a rendered room: data, training, ONNX, SLAM, scores, report"
    ),
    "data": Command(
        "data.commands",
        "COMMANDS",
        "check a COCO-format folder, convert other formats to one, download a TUM sequence",
    ),
    "synth": Command(
        "synth", "COMMANDS", "render COCO-format sets and TUM-format sequences with walking people"
    ),
    "fit": Command(
        "train.cli",
        "fit",
        "train an HDC Mask R-CNN with CQE on a COCO-format folder",
        has_page=True,
    ),
    "validate": Command(
        "validation", "validate", "score a checkpoint or an ONNX file on a COCO-format folder"
    ),
    "export": Command(
        "exporter.export", "export", "write a checkpoint as ONNX, compared before it is kept"
    ),
    "predict": Command(
        "prediction.predict", "predict", "segment images: overlays and annotations (no torch)"
    ),
    "bench": Command(
        "bench",
        "COMMANDS",
        "repeat the paper's tables: networks (4), tum (5 to 7, no torch), table3",
        default="networks",
    ),
    "slam": Command(
        "slam.run",
        "slam",
        "track an RGB-D sequence, with people removed (no torch)",
        has_page=True,
    ),
    "evaluate": Command(
        "trajectory.evaluate", "evaluate", "score a trajectory against ground truth: ATE and RPE"
    ),
    "report": Command("report", "report", "make an HTML page of a run, or of several side by side"),
    "env": Command("env", "env", "print installed versions, and what is wrong with them"),
}

# fmt: off
_TRAIN_PACKAGES = frozenset({
    "torch", "torchvision", "lightning", "pycocotools", "faster_coco_eval", "onnx", "onnxscript",
    "onnxslim", "kornia", "rich", "tensorboard", "embreex", "shapely",
})
# fmt: on

_MAX_USAGE_OPTIONS = 40  # more are not listed in the usage line


class UsageError(CohdcError):
    """A command line that cannot be read; exit code 2."""


def help_text() -> str:
    """Format the text of `cohdc --help`."""
    rows = "\n".join(f"  {name:<10}{command.summary}" for name, command in COMMANDS.items())
    return f"usage: cohdc COMMAND [options]\n\n{rows}\n\ncohdc COMMAND --help lists its options."


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: words behind `cohdc`; those of the process when not given.

    Returns:
        The exit code: 0 done, 1 a user's error in one line, 2 wrong usage. A bug keeps its
        traceback.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(help_text())
        return 0 if args else 2
    if args[0] == "--version":
        from cohdc_train import __version__

        print(f"cohdc {__version__}")
        return 0
    if args[0] not in COMMANDS:
        hint = _closest(args[0], COMMANDS, "cohdc --help lists them")
        print(f"cohdc: no command {args[0]!r}; {hint}", file=sys.stderr)
        return 2
    try:
        _call(args[0], args[1:])
    except CohdcError as error:
        print(f"cohdc {args[0]}: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    return 0


def _call(name: str, args: list[str]) -> None:
    command = COMMANDS[name]
    try:
        module = importlib.import_module(f"cohdc_train.{command.module}")
        component = getattr(module, command.attribute)
        if name == "fit":  # Lightning's own command line, which reads the arguments itself
            trainer = component(args)
            if trainer.is_global_zero:
                _write_page(Path(trainer.default_root_dir))
            return
        if isinstance(component, dict):
            _check_subcommand(name, args, component)
        renamed = getattr(module, "RENAMED_OPTIONS", {})
        function = _with_page(component) if command.has_page else component
        _run_function(function, args, f"cohdc {name}", renamed)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _TRAIN_PACKAGES:
            raise
        fix = "pip install 'cohdc-train[train]'"
        raise MissingExtraError(f"{name} needs {package}, which is not installed: {fix}") from error


def _with_page(function: Any) -> Any:
    """Return a command's function that writes the page of its output folder at the end."""

    @functools.wraps(function)
    def run(**options: Any) -> Any:
        result = function(**options)
        _write_page(options["out"])
        return result

    return run


def _write_page(folder: Path) -> None:
    """Write report.html of a run. An error in it is printed and does not fail the run."""
    try:
        importlib.import_module("cohdc_train.report").report([folder])
    except CohdcError as error:
        print(f"no report: {error}", file=sys.stderr)


def _check_subcommand(name: str, args: Sequence[str], group: Collection[str]) -> None:
    """Raise UsageError when the first word is no subcommand of a group."""
    if not args or args[0].startswith("-") or args[0] in group:
        return
    default = COMMANDS[name].default
    fallback = f"there are {', '.join(group)}"
    if default is not None:
        fallback = f"did you mean cohdc {name} {default} {args[0]}? ({fallback})"
    raise UsageError(f"no command {args[0]!r}; {_closest(args[0], group, fallback)}")


def _closest(word: str, names: Collection[str], fallback: str) -> str:
    """Suggest the name that a mistyped word is nearest to, else say something else."""
    matches = get_close_matches(word, names, n=1, cutoff=0.6)
    return f"did you mean {matches[0]}?" if matches else fallback


def _normalize_options(args: Sequence[str], switches: Container[str]) -> list[str]:
    """Spell option names with underscores, and give each switch without a value the value true.

    Args:
        args: words of the command line.
        switches: options of type bool.
    """
    normalized: list[str] = []
    for i, arg in enumerate(args):
        name, equals, value = arg.partition("=")
        if not name.startswith("--"):
            normalized.append(arg)
            continue
        name = "--" + name[2:].replace("-", "_")
        has_value = bool(equals) or args[i + 1 : i + 2] in (["true"], ["false"])
        if name in switches and not has_value:
            equals, value = "=", "true"
        normalized.append(name + equals + value)
    return normalized


def unknown_option(name: str, known: Collection[str], renamed: Mapping[str, str]) -> str:
    """Format the message for an option that does not exist, with the one that is probably meant.

    Args:
        name: the option.
        known: all options.
        renamed: options of earlier versions, and their names of today.
    """
    if name in renamed:
        return f"no option {name}; it is {renamed[name]} now"
    close = get_close_matches(name, known, 1, 0.7)
    return f"no option {name}; did you mean {close[0]}?" if close else f"no option {name}"


def _short_usage(prog: str, actions: Sequence[Any]) -> str:
    """Format the usage of a parser with its required arguments only."""
    words = []
    for action in actions:
        if action.required and action.option_strings:
            words.append(f"{action.option_strings[0]} {action.dest.upper()}")
        elif action.required:
            words.append(action.dest)
    return " ".join([prog, *words, "[options]"])


def _positional_lists(function: Any) -> dict[str, Any]:
    """Return name -> type of an item, of parameters that are lists without a default."""
    parameters = inspect.signature(function).parameters.values()
    return {
        parameter.name: get_args(parameter.annotation)[0]
        for parameter in parameters
        if get_origin(parameter.annotation) is list and parameter.default is parameter.empty
    }


def _run_function(component: Any, args: list[str], prog: str, renamed: Mapping[str, str]) -> None:
    """Run a typed function, or one of a dict of them, with options read from its signature.

    Args:
        component: the function or the dict.
        args: words of the command line.
        prog: name of the command.
        renamed: options of earlier versions, and their names of today.
    """
    from jsonargparse import ActionYesNo, ArgumentParser, auto_cli

    switches: set[str] = set()
    lists = {} if isinstance(component, dict) else _positional_lists(component)

    class Parser(ArgumentParser):
        """Parser for which a switch needs no value: `--quick`, `--no_quick` and `--quick=true`.

        A switch inside a group needs one: `--settings.loops.enabled false`. jsonargparse copies
        add_argument for groups without its scope, so that it may use `switches` and `lists` for
        others only. A required list takes several words: RUN [RUN ...].
        """

        def add_argument(self, *names: Any, **kwargs: Any) -> Any:
            if not names[0].startswith("-") and names[0] in lists:
                metavar = names[0].removesuffix("s").upper()
                kwargs = {"type": lists[names[0]], "nargs": "+", "help": kwargs["help"]}
                kwargs["metavar"] = metavar
            if kwargs.get("type") is bool and names[0].startswith("--") and "." not in names[0]:
                switches.add(names[0])
                del kwargs["type"]
                kwargs |= {"action": ActionYesNo, "nargs": "?"}
            return super().add_argument(*names, **kwargs)

        def parse_args(self, args: Any = None, *rest: Any, **kwargs: Any) -> Any:
            self.allow_abbrev = False
            if len(self._option_string_actions) > _MAX_USAGE_OPTIONS:
                self.usage = _short_usage(self.prog, self._actions)
            return super().parse_args(_normalize_options(args, switches), *rest, **kwargs)

        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            unknown = re.match(r"unrecognized arguments: (--[\w.]+)", message)
            if unknown is None:
                super().error(message, ex)
            options = [name for name in self._option_string_actions if name.startswith("--")]
            text = unknown_option(unknown[1], options, renamed)
            print(f"{self.prog.replace(' [options]', '')}: {text}", file=sys.stderr)
            raise SystemExit(2)

    auto_cli(component, args=args, prog=prog, as_positional=True, parser_class=Parser)
