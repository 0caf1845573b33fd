#!/usr/bin/env python3
"""Prove that a refactoring changes no result: run the same cases on two commits, compare bytes.

    tools/experiments/golden.py BASE HEAD [--cases slam_xyz train ...] [--shared ../shared]
        [--timing N] [--keep DIR] [--images]

Both commits are checked out with `git worktree` into a temporary folder. Each command runs in a
process of its own on one thread; inputs are rendered or trained once, with BASE. One line per case
says equal, DIFFERENT (which files), FAILED or skipped, then a digest of BASE's results, and the
seconds of BASE and HEAD (wall, and CPU). The exit code is 1 when a case differs or fails, and 2
when a commit cannot be checked out.

Bits depend on CPU and library versions: compare digests within one run only. Times, speeds,
versions, and config.yaml are not compared, and drawn images only with --images. Options that HEAD
has renamed belong into RENAMED_OPTIONS of golden_checkout.py, classes that it has moved into
golden_flow.py. The tool uses the cases of the working tree that it lies in, not of BASE or HEAD.

--timing N runs slam_xyz N times alternately in BASE and HEAD, and prints the ratio of the medians.
"""

import argparse
import signal
import statistics
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from golden_cases import CASES, Case
from golden_checkout import REPOSITORY, Checkout, CommandFailedError, Elapsed, checked_out
from golden_compare import Comparison, compare_folders
from golden_inputs import Inputs

_NAMES = [case.name for case in CASES]
_MOST_NAMED = 6  # files in the line of a case


class Pair:
    """The two checkouts, with a folder for the results of each."""

    def __init__(self, base: Checkout, head: Checkout, folder: Path, shared: Path) -> None:
        self.checkouts = (base, head)
        self.folder = folder
        (folder / "inputs").mkdir(parents=True)
        self.inputs = Inputs(folder / "inputs", base, shared)

    def run(self, case: Case, with_images: bool) -> tuple[Comparison, list[Elapsed]]:
        """Run a case in both and compare. Raises CommandFailedError."""
        source = case.prepare(self.inputs)
        folders = [self.folder / side / case.name for side in ("base", "head")]
        times = []
        for checkout, folder in zip(self.checkouts, folders, strict=True):
            times.append(run_commands(checkout, case, source, folder))
        return compare_folders(folders[0], folders[1], with_images), times

    def alternate(self, case: Case, repetitions: int) -> list[list[Elapsed]]:
        """Return the times of both, run in turn."""
        source = case.prepare(self.inputs)
        times: list[list[Elapsed]] = [[], []]
        for repetition in range(repetitions):
            order = (0, 1) if repetition % 2 == 0 else (1, 0)
            for side in order:
                folder = self.folder / "timing" / f"{repetition}_{side}"
                times[side].append(run_commands(self.checkouts[side], case, source, folder))
        return times


def run_commands(checkout: Checkout, case: Case, source: Path, folder: Path) -> Elapsed:
    """Run the commands of a case in a new folder, and return their time."""
    folder.mkdir(parents=True)
    times = [checkout.run(command, folder) for command in case.commands(source)]
    return Elapsed(sum(time.wall for time in times), sum(time.cpu for time in times))


def report(pair: Pair, case: Case, with_images: bool) -> bool:
    """Run a case, print its line, and return whether all is equal."""
    missing = [name for name in case.needs if not (pair.inputs.shared / name).exists()]
    if missing:
        print(f"{case.name:<16}skipped: no {', '.join(missing)} in the shared folder", flush=True)
        return True
    try:
        comparison, times = pair.run(case, with_images)
    except CommandFailedError as error:
        print(f"{case.name:<16}FAILED     {error}", flush=True)
        return False
    seconds = "  ".join(f"{time.wall:6.1f} s ({time.cpu:5.1f} CPU)" for time in times)
    facts = f"{comparison.digest[:12]}  {seconds}  {comparison.num_files} files"
    named = comparison.different[:_MOST_NAMED]
    if len(comparison.different) > _MOST_NAMED:
        named.append(f"{len(comparison.different) - _MOST_NAMED} more")
    if comparison.num_files == 0:
        named = ["no result files"]
    verdict = "DIFFERENT" if named else "equal"
    print(f"{case.name:<16}{verdict:<11}{facts}  {', '.join(named)}".rstrip(), flush=True)
    return not named


def report_timing(pair: Pair, case: Case, repetitions: int) -> None:
    """Time a case in both checkouts in turn, and print the ratio of the medians."""
    base, head = pair.alternate(case, repetitions)
    for kind in Elapsed._fields:
        before = statistics.median(getattr(time, kind) for time in base)
        after = statistics.median(getattr(time, kind) for time in head)
        words = f"{before:.2f} s -> {after:.2f} s, ratio {after / before:.3f}"
        print(f"timing of {case.name}, {kind}, median of {repetitions}: {words}", flush=True)


def parse_arguments() -> argparse.Namespace:
    """Return the command line."""
    description = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=description)
    parser.add_argument("base", metavar="BASE", help="commit before the refactoring")
    parser.add_argument("head", metavar="HEAD", help="commit after it")
    parser.add_argument("--cases", nargs="+", choices=_NAMES, default=_NAMES, metavar="CASE")
    parser.add_argument("--shared", type=Path, default=REPOSITORY.parent / "shared")
    parser.add_argument("--timing", type=int, default=0, metavar="N", help="runs of slam_xyz each")
    parser.add_argument("--keep", type=Path, help="new folder that inputs and results stay in")
    parser.add_argument("--images", action="store_true", help="compare drawn images, too")
    return parser.parse_args()


def main() -> None:
    """Run the cases; exit with 1 when one differs or fails."""
    arguments = parse_arguments()
    try:
        equal = run(arguments)
    except (CommandFailedError, subprocess.CalledProcessError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    sys.exit(0 if equal else 1)


def run(arguments: argparse.Namespace) -> bool:
    """Check out, run the cases, and return whether all are equal."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # removes the worktrees
    with ExitStack() as stack:
        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="golden.")))
        commits = {"base": arguments.base, "head": arguments.head}
        base, head = (
            stack.enter_context(checked_out(commit, temporary / f"{side}_checkout", side.upper()))
            for side, commit in commits.items()
        )
        folder = (arguments.keep or temporary / "results").resolve()
        pair = Pair(base, head, folder, arguments.shared.resolve())
        chosen = [case for case in CASES if case.name in arguments.cases]
        equal = [report(pair, case, arguments.images) for case in chosen]
        timed = CASES[_NAMES.index("slam_xyz")]
        if arguments.timing and timed.name in arguments.cases:
            report_timing(pair, timed, arguments.timing)
    return all(equal)


if __name__ == "__main__":
    main()
