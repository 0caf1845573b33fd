"""Trainings in processes of their own; what was trained once is not trained again."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from cohdc_train.errors import CohdcError
from cohdc_train.files import sha256, write_json
from cohdc_train.presets import config_path


class Trained(NamedTuple):
    """checkpoint: last.ckpt. seconds: wall clock of `cohdc fit`, with its start and without
    validation.
    """

    checkpoint: Path
    seconds: float


def train(folder: Path, data: Sequence[Path], options: Sequence[str], threads: int = 1) -> Trained:
    """`cohdc fit` into a folder, unless it holds a training with the same data and options.

    data: COCO-format folders, the first one validated. Raises CohdcError naming the log when it
    fails.
    """
    kept, checkpoint = folder / "training.json", folder / "last.ckpt"
    configs = {
        option: sha256(config_path(option.partition("=")[2]))
        for option in options
        if option.startswith("--config=")
    }
    asked = {
        "data": [str(root) for root in data],
        "options": list(options),
        "configs": configs,
        "threads": threads,
    }
    if kept.is_file() and checkpoint.is_file():
        known = json.loads(kept.read_text())
        if known["asked"] == asked:
            return Trained(checkpoint, known["seconds"])
    kept.unlink(missing_ok=True)
    start = time.monotonic()
    roots = f"[{','.join(str(root) for root in data)}]"
    fixed = (
        f"--data.root={roots}",
        f"--out={folder}",
        "--data.workers=0",
        "--trainer.limit_val_batches=0",
    )
    quiet = ("--pictures=false", "--trainer.enable_progress_bar=false")
    call(folder / "log.txt", "fit", *fixed, *quiet, *options, threads=threads)
    seconds = time.monotonic() - start
    write_json(kept, {"asked": asked, "seconds": seconds})
    return Trained(checkpoint, seconds)


def budget(epochs: int | None, minutes: float | None) -> tuple[str, ...]:
    """Options of `cohdc fit` for a training of so many epochs, or of so many minutes where those
    are given.
    """
    if minutes is None:
        return (f"--trainer.max_epochs={epochs}",)
    seconds = round(60 * minutes)
    clock = f"00:{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}"
    return (f"--trainer.max_time={clock}", "--trainer.max_epochs=-1")


def call(log: Path, verb: str, *arguments: str, threads: int = 1) -> None:
    """Run a verb of this package with the present interpreter; its output is appended to the log.

    Raises CohdcError naming the log when it fails.
    """
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(part for part in (root, os.environ.get("PYTHONPATH")) if part)
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONPATH": path}
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as stream:
        command = [sys.executable, "-m", "cohdc_train", verb, *arguments]
        print("+", *command, file=stream, flush=True)
        done = subprocess.run(command, env=environment, stdout=stream, stderr=stream, check=False)
    if done.returncode:
        raise CohdcError(
            f"{log}: cohdc {verb} failed with {done.returncode}; its message stands there"
        )
