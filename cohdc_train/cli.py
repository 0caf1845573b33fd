"""The table of verbs. A verb's module is imported when the verb is called, so that `cohdc --help`
costs nothing.
"""

import functools
import importlib
import inspect
import sys
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin

from cohdc_train.errors import CohdcError, MissingExtraError


class Verb(NamedTuple):
    """A row of the table: where the typed function (or the group of them) behind a verb lies.

    has_page: whether its run ends with report.html in the folder that `--out` names.
    """

    module: str
    attribute: str
    summary: str
    has_page: bool = False


VERBS = {
    "demo": Verb(
        "demo",
        "demo",
        "the whole way on a rendered room: data, training, ONNX, SLAM, scores, report",
    ),
    "data": Verb(
        "data.commands",
        "COMMANDS",
        "look at a COCO-format folder, make one of other formats, fetch a TUM sequence",
    ),
    "synth": Verb(
        "synth", "COMMANDS", "render COCO-format sets and TUM-format sequences with walking people"
    ),
    "fit": Verb(
        "train.cli", "fit", "train an HDC Mask R-CNN with CQE on a COCO-format folder", True
    ),
    "validate": Verb(
        "validation", "validate", "score a checkpoint or an ONNX on a COCO-format folder"
    ),
    "export": Verb(
        "exporter.export", "export", "checkpoint -> ONNX, run and compared before it is kept"
    ),
    "predict": Verb(
        "prediction.predict", "predict", "run an ONNX on images: overlays and COCO JSON (no torch)"
    ),
    "bench": Verb(
        "bench", "bench", "Table 4: networks trained, exported, scored and timed side by side", True
    ),
    "slam": Verb(
        "slam.run",
        "slam",
        "RGB-D sequence -> trajectory, map tracking with people removed (no torch)",
        True,
    ),
    "evaluate": Verb(
        "trajectory.evaluate", "evaluate", "ATE and RPE of a trajectory against ground truth"
    ),
    "report": Verb("report", "report", "one HTML page of a run, or of several beside each other"),
    "env": Verb("env", "env", "versions of everything that matters, and what is wrong with them"),
}

# fmt: off
_TRAIN_PACKAGES = frozenset({
    "torch", "torchvision", "lightning", "pycocotools", "faster_coco_eval", "onnx", "onnxscript", "onnxslim", "kornia",
    "rich", "tensorboard", "embreex", "shapely",
})
# fmt: on


def help_text() -> str:
    """What `cohdc --help` prints."""
    rows = "\n".join(f"  {name:<10}{verb.summary}" for name, verb in VERBS.items())
    return f"usage: cohdc VERB [options]\n\n{rows}\n\ncohdc VERB --help tells a verb's options."


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code: 0 done, 1 a user's error in one line, 2 usage. A bug
    keeps its traceback.
    """
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(help_text())
        return 0 if args else 2
    if args[0] == "--version":
        from cohdc_train import __version__

        print(f"cohdc {__version__}")
        return 0
    if args[0] not in VERBS:
        print(f"cohdc: no verb {args[0]!r}; cohdc --help lists them", file=sys.stderr)
        return 2
    try:
        _call(args[0], args[1:])
    except CohdcError as error:
        print(f"cohdc {args[0]}: {error}", file=sys.stderr)
        return 1
    return 0


def _call(name: str, args: list[str]) -> None:
    verb = VERBS[name]
    try:
        component = getattr(importlib.import_module(f"cohdc_train.{verb.module}"), verb.attribute)
        if name == "fit":  # Lightning's own command line, which reads the arguments itself
            trainer = component(args)
            if trainer.is_global_zero:
                _write_page(Path(trainer.default_root_dir))
            return
        _run_function(_with_page(component) if verb.has_page else component, args, f"cohdc {name}")
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _TRAIN_PACKAGES:
            raise
        message = (
            f"{name} needs {package}, which is not installed: pip install 'cohdc-train[train]'"
        )
        raise MissingExtraError(message) from error


def _with_page(function: Any) -> Any:
    """Return a verb's function that writes the page of the folder `out` when it is done."""

    @functools.wraps(function)
    def run(**options: Any) -> Any:
        result = function(**options)
        _write_page(options["out"])
        return result

    return run


def _write_page(folder: Path) -> None:
    """Write report.html of a run. What is wrong with it is told, and does not spoil the run."""
    try:
        importlib.import_module("cohdc_train.report").report([folder])
    except CohdcError as error:
        print(f"no report: {error}", file=sys.stderr)


def _spelled_out(args: Sequence[str], switches: Container[str]) -> list[str]:
    """Arguments with option names in underscores, and a switch's value behind it unless a truth
    value follows.
    """
    spelled: list[str] = []
    for i, arg in enumerate(args):
        name, equals, value = arg.partition("=")
        if not name.startswith("--"):
            spelled.append(arg)
            continue
        name = "--" + name[2:].replace("-", "_")
        if name in switches and not equals and args[i + 1 : i + 2] not in (["true"], ["false"]):
            equals, value = "=", "true"
        spelled.append(name + equals + value)
    return spelled


def _positional_lists(function: Any) -> dict[str, Any]:
    """Return name -> type of an item, of parameters that are lists without a default."""
    parameters = inspect.signature(function).parameters.values()
    return {
        parameter.name: get_args(parameter.annotation)[0]
        for parameter in parameters
        if get_origin(parameter.annotation) is list and parameter.default is parameter.empty
    }


def _run_function(component: Any, args: list[str], prog: str) -> None:
    """Run a typed function, or the group of them in a dict, with a command line read from its
    signature.
    """
    from jsonargparse import ActionYesNo, ArgumentParser, auto_cli

    switches: set[str] = set()
    lists = {} if isinstance(component, dict) else _positional_lists(component)

    class Parser(ArgumentParser):
        """A parser for which a switch needs no value: `--quick`, `--no_quick` and `--quick=true`.

        One inside a group does: `--method.loops false`; jsonargparse copies this method for groups,
        without its scope.
        """

        def add_argument(self, *names: Any, **kwargs: Any) -> Any:
            if not names[0].startswith("-") and names[0] in lists:  # RUN [RUN ...]
                metavar = names[0].removesuffix("s").upper()
                kwargs = {"type": lists[names[0]], "nargs": "+", "help": kwargs["help"]}
                kwargs["metavar"] = metavar
            if kwargs.get("type") is bool and names[0].startswith("--") and "." not in names[0]:
                switches.add(names[0])
                del kwargs["type"]
                kwargs |= {"action": ActionYesNo, "nargs": "?"}
            return super().add_argument(*names, **kwargs)

        def parse_args(self, args: Any = None, *rest: Any, **kwargs: Any) -> Any:
            return super().parse_args(_spelled_out(args, switches), *rest, **kwargs)

    auto_cli(component, args=args, prog=prog, as_positional=True, parser_class=Parser)
