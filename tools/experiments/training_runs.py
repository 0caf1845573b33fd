"""Trainings of the experiments, each in its own process; what is scored once is not trained again.

Imported by the tools beside it; runs the checkout's `cohdc fit` and `cohdc validate` with the
present interpreter.
"""

import json
import statistics
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from cohdc_train.bench.training import call, train
from cohdc_train.errors import CohdcError
from cohdc_train.files import write_json

ROOT = Path(__file__).resolve().parents[2]
Scores = dict[str, float]


@dataclass(frozen=True)
class Run:
    """One training and how it is scored.

    Attributes:
        folder: where checkpoints, log and scores.json go.
        data: COCO-format folders; the first one's val split is scored.
        options: of `cohdc fit`.
        scorings: name -> options of `cohdc validate` on last.ckpt; every name's scores are kept.
    """

    folder: Path
    data: tuple[Path, ...]
    options: tuple[str, ...]
    scorings: dict[str, tuple[str, ...]] = field(default_factory=lambda: {"plain": ()})

    def scores(self) -> dict[str, Scores]:
        """Train and score, unless the folder holds the scores of the same options."""
        kept = self.folder / "scores.json"
        asked = {
            "options": list(self.options),
            "scorings": {k: list(v) for k, v in self.scorings.items()},
        }
        if kept.is_file() and (known := json.loads(kept.read_text()))["asked"] == asked:
            return known["scores"]
        checkpoint, seconds = train(self.folder, self.data, self.options)
        scores: dict[str, Scores] = {}
        for name, options in self.scorings.items():
            out = self.folder / f"scores_{name}.json"
            fixed = (str(checkpoint), str(self.data[0]), f"--out={out}", "--workers=0")
            call(self.folder / "log.txt", "validate", *fixed, *options)
            scores[name] = json.loads(out.read_text()) | {"seconds": seconds}
        write_json(kept, {"asked": asked, "scores": scores})
        return scores


def run_all(runs: Sequence[Run], jobs: int) -> list[dict[str, Scores]]:
    """The scores of every run, `jobs` at a time, in their order; says how far it is.

    Raises SystemExit with the one line of a training that failed.
    """

    def one(run: Run) -> dict[str, Scores]:
        scores = run.scores()
        print(
            f"{run.folder}: "
            + ", ".join(f"{k} mask AP50 {v['segm_AP50']:.3f}" for k, v in scores.items()),
            flush=True,
        )
        return scores

    with ThreadPoolExecutor(jobs) as pool:
        try:
            return list(pool.map(one, runs))
        except CohdcError as error:
            pool.shutdown(cancel_futures=True)
            raise SystemExit(str(error)) from None


def spread(values: Sequence[float]) -> str:
    """Mean and, in brackets, the smallest and largest over the seeds."""
    return f"{statistics.fmean(values):.3f} ({min(values):.3f}-{max(values):.3f})"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
