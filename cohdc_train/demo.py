"""The whole way on a rendered room: data, training, ONNX, SLAM without and with it, scores, report."""

import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cohdc_train.errors import CohdcError
from cohdc_train.files import check_folder, files_below, list_files, remove_listed, write_json

_MARK = "demo.json"  # written first, so that a later run knows the folder as its own
_FOLDERS = ("data", "sequence", "train", "without", "with", "predictions")
_FILES = (_MARK, "model.onnx", "model.onnx.json", "report.html", "summary.json")
_OVERLAYS = 6


@dataclass(frozen=True)
class Plan:
    """How much is rendered and trained."""

    train_images: int
    val_images: int
    frames: int
    epochs: int


FULL = Plan(train_images=500, val_images=60, frames=240, epochs=24)
QUICK = Plan(train_images=160, val_images=24, frames=120, epochs=8)


@dataclass
class Clock:
    """Prints what is being done and keeps how long each step took, s. out: the demo's folder."""

    out: Path
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time the block under `name`, and list the files that it leaves, however it ends."""
        print(f"== {name}", flush=True)
        started = time.monotonic()
        try:
            yield
        finally:
            list_files(self.out, "demo", _files_of(self.out))
        self.seconds[name] = round(time.monotonic() - started, 1)


def demo(out: Path = Path("runs/demo"), quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Render a set and a sequence, train, export, run SLAM without and with the segmenter, score
    and report.

    Writes into the output folder: data/, sequence/, train/, model.onnx, without/, with/,
    predictions/, report.html and summary.json (segm_ap50, ate_without_m, ate_with_m, coverage,
    seconds). Everything is rendered; nothing is fetched.

    Args:
        out: new or empty folder, or that of a former demo, whose files are replaced.
        quick: a fraction of the images, frames and epochs; scores are worse.
        seed: of rendering, training and SLAM; the same seed gives the same numbers on the same
            machine.

    Returns:
        The content of summary.json.
    """
    plan = QUICK if quick else FULL
    _claim(out, plan, seed)
    clock = Clock(out)
    with clock.step("render"):
        _render(out, plan, seed)
    with clock.step("train"):
        scores = _train(out, plan, seed)
    with clock.step("export"):
        _export(out)
    with clock.step("slam without masks"):
        without = _slam(out / "sequence", out / "without", None, seed)
    with clock.step("slam with masks"):
        with_masks = _slam(out / "sequence", out / "with", out / "model.onnx", seed)
    with clock.step("report"):
        _report(out, scores, clock)
    summary = {
        "segm_ap50": scores["segm_AP50"],
        "ate_without_m": without["ate_m"]["rmse"],
        "ate_with_m": with_masks["ate_m"]["rmse"],
        "coverage": with_masks["coverage"],
        "coverage_without": without["coverage"],
        "seconds": round(sum(clock.seconds.values()), 1),
        "steps": clock.seconds,
        "plan": vars(plan),
        "seed": seed,
    }
    write_json(out / "summary.json", summary)
    print(table(summary, out))
    return summary


def table(summary: dict[str, Any], out: Path) -> str:
    """The demo's closing table."""
    rows = [
        ("mask AP50 on unseen rooms", f"{summary['segm_ap50']:.3f}"),
        ("ATE RMSE without masks", f"{summary['ate_without_m']:.4f} m"),
        ("ATE RMSE with masks", f"{summary['ate_with_m']:.4f} m"),
        (
            "frames tracked, without / with",
            f"{summary['coverage_without']:.1%} / {summary['coverage']:.1%}",
        ),
        *((f"time: {name}", f"{seconds:.0f} s") for name, seconds in summary["steps"].items()),
        ("time in all", f"{summary['seconds']:.0f} s"),
        ("report", str(out / "report.html")),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n" + "\n".join(f"  {name:<{width}}  {value}" for name, value in rows)


def _claim(out: Path, plan: Plan, seed: int) -> None:
    """Remove what a former demo left; raise CohdcError when anything else is in its place."""
    if out.exists() and not out.is_dir():
        raise CohdcError(f"{out}: is not a folder")
    if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
        raise CohdcError(f"{out}: not empty and not from a former demo; give another --out")
    check_folder(out, "demo", _files_of(out))
    remove_listed(out, "demo")
    list_files(out, "demo", _FILES)
    write_json(out / _MARK, {"plan": vars(plan), "seed": seed})


def _files_of(out: Path) -> list[str]:
    """Names of the files that lie where a demo writes, relative to its folder."""
    files = [name for name in _FILES if (out / name).exists()]
    return files + [f"{name}/{file}" for name in _FOLDERS for file in files_below(out / name)]


def _render(out: Path, plan: Plan, seed: int) -> None:
    """The set and the sequence, each in a process of its own on one core."""
    from cohdc_train.synth import coco, sequence

    with ProcessPoolExecutor(
        2, multiprocessing.get_context("spawn"), initializer=_use_one_thread
    ) as pool:
        jobs = [
            pool.submit(
                coco, out / "data", train=plan.train_images, val=plan.val_images, seed=seed
            ),
            pool.submit(sequence, out / "sequence", frames=plan.frames, seed=seed),
        ]
        for job in jobs:
            job.result()


def _use_one_thread() -> None:
    """For a new process, before numpy is loaded in it: threads of two renderers would wait for each
    other.
    """
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    import cv2

    cv2.setNumThreads(1)


def _train(out: Path, plan: Plan, seed: int) -> dict[str, float]:
    """Train the network of configs/demo.yaml; returns the validation scores of the best checkpoint.

    By the command line, which Lightning starts once more for the second process of the two that
    configs/demo.yaml asks for.
    """
    from cohdc_train.validation import validate

    options = {
        "--config": "demo.yaml",
        "--data.root": out / "data",
        "--out": out / "train",
        "--trainer.max_epochs": plan.epochs,
        "--trainer.check_val_every_n_epoch": plan.epochs,
        "--seed_everything": seed,
    }
    fit = [
        sys.executable,
        "-m",
        "cohdc_train",
        "fit",
        *(str(part) for option in options.items() for part in option),
    ]
    if subprocess.run(fit, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}).returncode != 0:
        raise CohdcError("the training ended early; its own message stands above")
    return validate(out / "train" / "best.ckpt", out / "data", out=out / "train" / "scores.json")


def _export(out: Path) -> None:
    from cohdc_train.exporter.export import export

    export(out / "train" / "best.ckpt", out / "model.onnx", images=out / "data" / "images")


def _slam(sequence: Path, out: Path, model: Path | None, seed: int) -> dict[str, Any]:
    from cohdc_train.slam.config import Culling
    from cohdc_train.slam.run import slam

    # A network trained for minutes misses limbs and doubts people at the border: trust less, cut
    # wider.
    return slam(
        sequence=sequence, out=out, model=model, seed=seed, culling=Culling(score=0.2, dilate=20)
    )


def _report(out: Path, scores: dict[str, float], clock: Clock) -> None:
    from cohdc_train.prediction.predict import predict
    from cohdc_train.report import Table, write_report

    frames = sorted((out / "sequence" / "rgb").iterdir())
    chosen = out / "predictions" / "frames"
    chosen.mkdir(parents=True, exist_ok=True)
    for frame in frames[:: max(1, len(frames) // _OVERLAYS)][:_OVERLAYS]:
        shutil.copy(frame, chosen / frame.name)
    predict(chosen, model=out / "model.onnx", out=out / "predictions")
    tables = [
        Table(
            "Segmentation on unseen rooms",
            ["score", "value"],
            [[n, f"{v:.4f}"] for n, v in scores.items()],
        ),
        Table("Time per step", ["step", "s"], [[n, f"{s:.1f}"] for n, s in clock.seconds.items()]),
    ]
    write_report(
        out / "report.html",
        "cohdc demo",
        out / "sequence" / "groundtruth.txt",
        {"without masks": out / "without", "with masks": out / "with"},
        sorted((out / "predictions").glob("*_overlay.jpg")),
        tables,
    )
