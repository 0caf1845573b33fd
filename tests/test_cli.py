"""The command line: its cost, its messages and its exit codes."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from cohdc_train import cli
from cohdc_train.cli import COMMANDS, main
from cohdc_train.errors import DataError

TRAIN_COMMANDS = {
    "fit",
    "validate",
    "export",
    "data",
    "synth",
    "demo",
}  # may need the train extra, even for their help


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)


def test_help_costs_little_and_imports_little() -> None:
    cpu_seconds = []
    for _ in range(4):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = run("-m", "cohdc_train", "--help")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == 0, done.stderr
        cpu_seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert min(cpu_seconds) < 0.2, "seconds of CPU for cohdc --help, best of four"


def test_help_imports_no_parser_and_no_numpy() -> None:
    code = (
        "import sys, json; from cohdc_train.cli import main; main(['--help']);"
        "print(json.dumps(sorted(sys.modules)))"
    )
    modules = set(json.loads(run("-c", code).stdout.splitlines()[-1]))
    assert modules.isdisjoint({"jsonargparse", "numpy", "cv2", "torch", "onnxruntime", "yaml"})


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(f"  {verb} " in printed for verb in COMMANDS)


def test_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    from cohdc_train import __version__

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"cohdc {__version__}\n"


@pytest.mark.parametrize("argv", [["fly"], []])
def test_wrong_use_ends_with_two(argv: list[str]) -> None:
    assert main(argv) == 2


def test_unknown_verb_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    main(["fly"])
    assert capsys.readouterr().err == "cohdc: no command 'fly'; cohdc --help lists them\n"


def test_mistyped_command_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evalute"]) == 2
    assert capsys.readouterr().err == "cohdc: no command 'evalute'; did you mean evaluate?\n"
    assert main(["bench", "netwrks"]) == 2
    assert capsys.readouterr().err.endswith("no command 'netwrks'; did you mean networks?\n")


def test_former_spelling_of_bench_suggests_the_new_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["bench", "DATA", "--out", "runs"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "cohdc bench: no command 'DATA'; did you mean cohdc bench networks DATA?"
    )
    assert error.count("\n") == 1


def test_mistyped_option_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "a.txt", "b.txt", "--max_diference=3"])
    assert ended.value.code == 2
    message = "no option --max_diference; did you mean --max_difference?"
    assert capsys.readouterr().err == f"cohdc evaluate: {message}\n"


@pytest.mark.slow
def test_renamed_option_names_the_new_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["validate", "model.onnx", "data", "--pictures=out"])
    assert ended.value.code == 2
    message = "no option --pictures; it is --figures now"
    assert capsys.readouterr().err == f"cohdc validate: {message}\n"


def test_unknown_option_ends_with_two(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "a.txt", "b.txt", "--spin=3"])
    assert ended.value.code == 2
    assert "--spin" in capsys.readouterr().err


# these two load Lightning for their help, which takes seconds
@pytest.mark.parametrize(
    "verb",
    [
        pytest.param(verb, marks=pytest.mark.slow) if verb in ("fit", "validate") else verb
        for verb in COMMANDS
    ],
)
def test_every_verb_has_help_and_the_robots_verbs_import_no_torch(verb: str) -> None:
    code = (
        "import json, sys, warnings; warnings.simplefilter('ignore')\n"
        "from cohdc_train.cli import main\n"
        f"try: code = main([{verb!r}, '--help'])\n"
        "except SystemExit as ended: code = ended.code\n"
        "heavy = {'torch', 'torchvision', 'lightning', 'matplotlib.pyplot'} & set(sys.modules)\n"
        "print(json.dumps([code or 0, sorted(heavy)]))"
    )
    done = run("-c", code)
    assert f"usage: cohdc {verb}" in done.stdout, done.stderr
    ended, heavy = json.loads(done.stdout.splitlines()[-1])
    assert ended == 0
    if verb not in TRAIN_COMMANDS:
        assert heavy == []


def test_users_error_is_one_line_and_ends_with_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 3\n")
    assert main(["evaluate", str(bad), str(bad)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert (
        captured.err
        == f"cohdc evaluate: {bad}:1: 3 numbers; timestamp tx ty tz qx qy qz qw are 8\n"
    )


@pytest.mark.parametrize("error", [DataError("file.txt:3: no"), RuntimeError("a bug")])
def test_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(name: str, args: list[str]) -> None:
        raise error

    monkeypatch.setattr(cli, "_call", fail)
    if isinstance(error, DataError):
        assert main(["evaluate"]) == 1
    else:
        with pytest.raises(RuntimeError, match="a bug"):
            main(["evaluate"])


def test_missing_extra_is_named_with_its_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(COMMANDS, "probe", cli.Command("no_such_room", "f", "for this test"))

    def absent(name: str) -> None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(cli.importlib, "import_module", absent)
    assert main(["probe"]) == 1
    assert capsys.readouterr().err == (
        "cohdc probe: probe needs torch, which is not installed: pip install 'cohdc-train[train]'\n"
    )
