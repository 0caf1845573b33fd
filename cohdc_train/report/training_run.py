"""A training's folder as the report reads it: the log, the configuration and the scores."""

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.report.slam_run import read_config

Series = NDArray[np.float64]  # [n, 2]: step and value

_WATCHED = "val/segm_AP"
_CLASS = "segm_AP/"
VALIDATION_IMAGES = ("best.jpg", "worst.jpg", "pr_curves.png", "calibration.png", "confusion.png")


@dataclass(frozen=True)
class TrainingRun:
    """One training.

    config: content of config.yaml; series: column of the log -> [n, 2] of step and value; epochs:
    that were begun; validated: name of a JSON file of `cohdc validate` in the folder -> its scores.
    """

    label: str
    folder: Path
    config: Mapping[str, Any]
    series: Mapping[str, Series]
    epochs: int
    validated: Mapping[str, Mapping[str, float]]

    @property
    def steps(self) -> int:
        """Steps up to the last row of the log."""
        return 1 + int(max((rows[-1, 0] for rows in self.series.values()), default=-1))

    def best_step(self) -> float | None:
        """Return the step of the validation with the highest mask AP; None before the first."""
        watched = self.series.get(_WATCHED)
        return None if watched is None else float(watched[np.argmax(watched[:, 1]), 0])

    def best_scores(self) -> dict[str, float]:
        """Return the scores of that validation by name; empty before the first."""
        step = self.best_step()
        chosen = {
            name.removeprefix("val/"): rows[rows[:, 0] == step, 1]
            for name, rows in self.series.items()
            if name.startswith("val/")
        }
        return {name: float(values[-1]) for name, values in chosen.items() if len(values)}

    def class_scores(self) -> dict[str, float]:
        """Return class name -> mask AP of the best validation, the best class first."""
        scores = {
            name.removeprefix(_CLASS): value
            for name, value in self.best_scores().items()
            if name.startswith(_CLASS)
        }
        return dict(sorted(scores.items(), key=lambda item: -item[1]))

    def part(self, prefix: str) -> dict[str, Series]:
        """Return the series whose names begin with a prefix, by the rest of their names."""
        found = {
            n.removeprefix(prefix): rows for n, rows in self.series.items() if n.startswith(prefix)
        }
        return {name: rows for name, rows in found.items() if "/" not in name}

    def option(self, *names: str) -> Any:
        """Return an option of the configuration by its path; None where there is none."""
        value: Any = self.config
        for name in names:
            value = value.get(name) if isinstance(value, dict) else None
        return value

    def images(self) -> list[Path]:
        """Return the images of the best validation that are there, of the last one otherwise."""
        for folder in (self.folder / "pictures", self.folder / "pictures" / "last"):
            files = [folder / name for name in VALIDATION_IMAGES if (folder / name).is_file()]
            if files:
                return files
        return []


def read_training_run(label: str, folder: Path) -> TrainingRun:
    """Read a folder of `cohdc fit`. Raises DataError naming a file that cannot be used."""
    rows = _log_rows(logs(folder))
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for name, value in row.items():
            if math.isfinite(value) and name not in ("epoch", "step"):
                series.setdefault(name, []).append((row["step"], value))
    epochs = 1 + int(max((row.get("epoch", -1.0) for row in rows), default=-1.0))
    arrays = {name: np.array(pairs) for name, pairs in series.items()}
    config = read_config(folder / "config.yaml")
    return TrainingRun(label, folder, config, arrays, epochs, score_files(folder))


def logs(folder: Path) -> list[Path]:
    """Return the logs of a training in the order in which they were written."""
    found = [
        (int(match[1]), file)
        for file in folder.glob("logs/version_*/metrics.csv")
        if (match := re.fullmatch(r"version_(\d+)", file.parent.name))
    ]
    return [file for _, file in sorted(found)]


def score_files(folder: Path) -> dict[str, dict[str, float]]:
    """Return file name -> scores of every JSON file in a folder that `cohdc validate` wrote."""
    found = {}
    for file in sorted(folder.glob("*.json")):
        scores = read_scores(file)
        if scores:
            found[file.name] = scores
    return found


def read_scores(file: Path) -> dict[str, float]:
    """Return the scores in a JSON file of `cohdc validate`; empty for another file."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(content, dict) or "segm_AP" not in content:
        return {}
    return {name: float(v) for name, v in content.items() if isinstance(v, int | float)}


def _log_rows(files: Sequence[Path]) -> list[dict[str, float]]:
    """Return the rows of the last log, and of those before it that it resumes."""
    rows: list[dict[str, float]] = []
    for file in reversed(files):
        earlier = _read_log(file)
        if rows and earlier and earlier[-1]["step"] >= rows[0]["step"]:
            break  # another training in the same folder
        rows = earlier + rows
    return rows


def _read_log(file: Path) -> list[dict[str, float]]:
    """Return the rows of a log that have a step, as numbers; an empty cell is nan."""
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            table = [row for row in csv.DictReader(stream) if row.get("step")]
        return [{name: float(cell or "nan") for name, cell in row.items()} for row in table]
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise DataError(f"{file}: cannot be read as a log: {error}") from error
