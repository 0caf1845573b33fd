"""Trainings in processes of their own; a finished training is not repeated."""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from cohdc_train.errors import CohdcError
from cohdc_train.files import sha256, write_json
from cohdc_train.presets import config_path

Scores = dict[str, float]


class TrainingRun(NamedTuple):
    """Result of one training.

    Attributes:
        checkpoint: its last.ckpt.
        seconds: wall clock time of `cohdc fit`, its start included and validation not.
    """

    checkpoint: Path
    seconds: float


def train(
    folder: Path, data: Sequence[Path], options: Sequence[str], threads: int = 1
) -> TrainingRun:
    """Run `cohdc fit` into a folder, unless it holds a training with the same data and options.

    Args:
        folder: where checkpoints, log.txt and training.json go.
        data: COCO-format folders, the first one validated.
        options: arguments of `cohdc fit`.
        threads: number of threads of the training.

    Raises:
        CohdcError: the training failed; the message names its log.
    """
    cache_file, checkpoint = folder / "training.json", folder / "last.ckpt"
    prefix = "--config="
    configs = {
        option: sha256(config_path(option.removeprefix(prefix)))
        for option in options
        if option.startswith(prefix)
    }
    request = {
        "data": [str(root) for root in data],
        "options": list(options),
        "configs": configs,
        "threads": threads,
    }
    if cache_file.is_file() and checkpoint.is_file():
        cached = json.loads(cache_file.read_text())
        if cached["asked"] == request:
            return TrainingRun(checkpoint, cached["seconds"])

    cache_file.unlink(missing_ok=True)
    roots = f"[{','.join(str(root) for root in data)}]"
    fixed = [
        f"--data.root={roots}",
        f"--out={folder}",
        "--data.workers=0",
        "--trainer.limit_val_batches=0",
        "--figures=false",
        "--trainer.enable_progress_bar=false",
    ]
    start = time.monotonic()
    run_command(folder / "log.txt", "fit", *fixed, *options, threads=threads)
    seconds = time.monotonic() - start
    write_json(cache_file, {"asked": request, "seconds": seconds})
    return TrainingRun(checkpoint, seconds)


def budget_arguments(epochs: int | None, minutes: float | None) -> tuple[str, ...]:
    """Build the arguments of `cohdc fit` for a training of some minutes, else of some epochs."""
    if minutes is None:
        return (f"--trainer.max_epochs={epochs}",)
    seconds = round(60 * minutes)
    clock = f"00:{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}"
    return (f"--trainer.max_time={clock}", "--trainer.max_epochs=-1")


def run_command(log: Path, name: str, *arguments: str, threads: int = 1) -> None:
    """Run a command of this package with this interpreter, and append its output to a log.

    Raises:
        CohdcError: the command failed; the message names the log.
    """
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONPATH": path}
    command = [sys.executable, "-m", "cohdc_train", name, *arguments]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as stream:
        print("+", *command, file=stream, flush=True)
        done = subprocess.run(command, env=environment, stdout=stream, stderr=stream, check=False)
    if done.returncode:
        raise CohdcError(f"{log}: cohdc {name} failed with exit code {done.returncode}; see there")


@dataclass(frozen=True)
class TrainingJob:
    """One training, and how it is scored.

    Attributes:
        folder: where checkpoints, log and scores.json go.
        data: COCO-format folders; the val split of the first one is scored.
        options: arguments of `cohdc fit`.
        scorings: name -> arguments of `cohdc validate` on last.ckpt.
    """

    folder: Path
    data: tuple[Path, ...]
    options: tuple[str, ...]
    scorings: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"plain": ()})

    def run(self) -> dict[str, Scores]:
        """Train and score, unless the folder holds the scores of the same options.

        Returns the scores by name of the scoring.
        """
        cache_file = self.folder / "scores.json"
        scorings = {name: list(arguments) for name, arguments in self.scorings.items()}
        request = {"options": list(self.options), "scorings": scorings}
        if cache_file.is_file():
            cached = json.loads(cache_file.read_text())
            if cached["asked"] == request:
                return dict(cached["scores"])

        training = train(self.folder, self.data, self.options)
        scores: dict[str, Scores] = {}
        for name, arguments in self.scorings.items():
            out = self.folder / f"scores_{name}.json"
            fixed = (str(training.checkpoint), str(self.data[0]), f"--out={out}", "--workers=0")
            run_command(self.folder / "log.txt", "validate", *fixed, *arguments)
            scores[name] = json.loads(out.read_text()) | {"seconds": training.seconds}
        write_json(cache_file, {"asked": request, "scores": scores})
        return scores


def run_jobs(jobs: Sequence[TrainingJob], num_parallel: int) -> list[dict[str, Scores]]:
    """Run jobs, `num_parallel` at a time, and print each one's mask AP50 when it is done.

    Returns the scores in the order of the jobs.

    Raises:
        CohdcError: a training failed.
    """

    def run(job: TrainingJob) -> dict[str, Scores]:
        scores = job.run()
        parts = [f"{name} mask AP50 {row['segm_AP50']:.3f}" for name, row in scores.items()]
        print(f"{job.folder}: {', '.join(parts)}", flush=True)
        return scores

    with ThreadPoolExecutor(num_parallel) as pool:
        try:
            return list(pool.map(run, jobs))
        except CohdcError:
            pool.shutdown(cancel_futures=True)
            raise


def format_mean(values: Sequence[float]) -> str:
    """Format the mean, and the smallest and largest value in brackets."""
    return f"{statistics.fmean(values):.3f} ({min(values):.3f}-{max(values):.3f})"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; the text ends with a newline."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
