"""One commit of this repository in a folder of its own, and its commands."""

import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from cohdc_train.slam.run import RENAMED_OPTIONS as SLAM_RENAMED_OPTIONS

REPOSITORY = Path(__file__).resolve().parents[2]

# Options of `cohdc` and of tools that got another name. The cases use the old one.
# Old name: new name; an empty one for an option whose value became positional.
RENAMED_OPTIONS = {**SLAM_RENAMED_OPTIONS, "--sequence": "", "--pictures": "--figures"}
# Where a program lies, the newest place first, relative to a checkout.
_TOOL_PLACES = {"late_masks": ("tools/experiments/late_masks.py", "tools/late_masks")}
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class CommandFailedError(Exception):
    """A command of a checkout ended with an error."""


class Elapsed(NamedTuple):
    """Time of a command, s."""

    wall: float
    cpu: float


class Checkout:
    """One commit in a folder of its own."""

    def __init__(self, folder: Path, label: str) -> None:
        self.folder = folder
        self.label = label
        self._helps: dict[tuple[str, ...], str] = {}
        self._environment = os.environ | dict.fromkeys(_ONE_THREAD, "1")
        self._environment |= {"CUDA_VISIBLE_DEVICES": "", "OPENCV_FOR_THREADS_NUM": "1"}
        self._environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(folder / "tools")])

    def check_import(self) -> None:
        """Raise CommandFailedError when Python would import the package from elsewhere."""
        code = "import cohdc_train; print(cohdc_train.__file__)"
        done = self._capture([sys.executable, "-c", code])
        if not Path(done.strip() or "/").is_relative_to(self.folder):
            raise CommandFailedError(f"{self.label}: cohdc_train is imported from {done.strip()}")

    def run(self, command: list[str], folder: Path) -> Elapsed:
        """Run a command in a folder, with what it prints in golden.log there.

        command: `cohdc` or a tool's name, and its arguments, with options' old names.
        Raises CommandFailedError when it fails.
        """
        words = [*self._program(command[0]), *self._translate(command)]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        start = time.perf_counter()
        with (folder / "golden.log").open("a+", encoding="utf-8") as log:
            code = subprocess.call(
                words,
                cwd=folder,
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            wall = time.perf_counter() - start
            log.seek(0)
            lines = log.read().strip().splitlines() or [""]
        if code != 0:
            what = f"{self.label}: {' '.join(command[:2])}"
            raise CommandFailedError(f"{what} ended with {code}: {lines[-1]}")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return Elapsed(wall, cpu)

    def _program(self, name: str) -> list[str]:
        if name == "cohdc":
            return [sys.executable, "-m", "cohdc_train"]
        if name == "golden_flow":
            return [sys.executable, str(Path(__file__).with_name("golden_flow.py"))]
        for place in _TOOL_PLACES[name]:
            if (self.folder / place).is_file():
                return [sys.executable, str(self.folder / place)]
        raise CommandFailedError(f"{self.label}: none of {', '.join(_TOOL_PLACES[name])}")

    def _translate(self, command: list[str]) -> list[str]:
        """Return the arguments of a command with options named as this checkout names them."""
        arguments = command[1:]
        if not RENAMED_OPTIONS.keys() & {word.partition("=")[0] for word in arguments}:
            return arguments
        verb = arguments[:1] if command[0] == "cohdc" else []
        key = (command[0], *verb)
        if key not in self._helps:
            self._helps[key] = self._capture([*self._program(command[0]), *verb, "--help"])
        return translate(arguments, self._helps[key])

    def _capture(self, words: list[str]) -> str:
        done = subprocess.run(
            words,
            cwd="/",
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            error = done.stderr.strip().splitlines() or [""]
            raise CommandFailedError(f"{self.label}: {words[-2:]}: {error[-1]}")
        return done.stdout


def translate(arguments: list[str], help_text: str) -> list[str]:
    """Replace old names of options that a help text does not know by their new names."""
    known = set(re.findall(r"--[\w.]+", help_text))
    renames = {old: new for old, new in RENAMED_OPTIONS.items() if old not in known}
    names_and_values = (word.partition("=") for word in arguments)
    words = [renames.get(name, name) + equals + value for name, equals, value in names_and_values]
    return [word for word in words if word]


@contextmanager
def checked_out(commit: str, folder: Path, label: str) -> Iterator[Checkout]:
    """Check a commit out with `git worktree`; the worktree is removed when the block ends."""
    git = ["git", "-C", str(REPOSITORY), "worktree"]
    subprocess.run([*git, "add", "--detach", "--quiet", str(folder), commit], check=True)
    try:
        checkout = Checkout(folder, label)
        checkout.check_import()
        yield checkout
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)
