#!/usr/bin/env python3
"""Score dynamic SLAM on rendered sequences: walks, carts, crowds, a loop, plain walls, and more.

    tools/experiments/slam_evaluation.py --root DIR --out OUT [--model person] [--seeds 0 1 2]
        [--settings loops.enabled=false ...]

Renders what is missing of the sequences below DIR (12 of --frames frames, the loop twice as long),
then runs `cohdc slam` in process on each: without masks ("none"), with the true people ("masks"),
with whatever truly moves ("movers"), and with --model ("model"). Every run's row goes into
OUT/evaluation.json as soon as it is there; a row that is there is not made again, but rows of other
code under cohdc_train/slam are dropped. OUT/evaluation.md has the medians and the worst over the
seeds; the latest run's files lie in OUT/SEQUENCE.
"""

import argparse
import hashlib
import json
import statistics
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slam_settings import add_settings_option

import cohdc_train.slam
from cohdc_train.errors import CohdcError
from cohdc_train.files import sha256, write_json, write_text
from cohdc_train.presets import model_path
from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.run import run_slam
from cohdc_train.synth.camera_motion import CameraMotion
from cohdc_train.synth.scenario import SceneConfig
from cohdc_train.synth.sequence import sequence

Row = dict[str, Any]
QUICK_FRAMES, QUICK_SIZE = 8, (120, 160)
MODES = ("none", "masks", "movers", "model")


@dataclass(frozen=True)
class Kind:
    """What is rendered; length: its frames as a multiple of --frames."""

    seed: int
    motion: CameraMotion
    people: int
    scene: SceneConfig = SceneConfig()  # noqa: RUF009 - frozen
    length: int = 1


KINDS = {
    "rolling_cart": Kind(101, "xyz", 0, SceneConfig(cart="alone")),
    "pushed_cart": Kind(102, "halfsphere", 2, SceneConfig(cart="pushed")),
    "loop": Kind(103, "loop", 2, length=2),
    "crowd": Kind(104, "xyz", 9),
    "plain_wall": Kind(105, "xyz", 2, SceneConfig(walls="plain")),
    "filled_view": Kind(106, "xyz", 3, SceneConfig(action="fill_view")),
    "stop_and_go": Kind(107, "halfsphere", 3, SceneConfig(action="stop_and_go")),
    "sitting": Kind(108, "halfsphere", 3, SceneConfig(action="sit")),
    "walking_xyz": Kind(109, "xyz", 3),
    "walking_halfsphere": Kind(110, "halfsphere", 3),
    "walking_static": Kind(111, "static", 3),
    "walking_rpy": Kind(112, "rpy", 3),
}


def main() -> None:
    """Render, run, write."""
    arguments = parse()
    arguments.out.mkdir(parents=True, exist_ok=True)
    code = digest(Path(cohdc_train.slam.__path__[0]).rglob("*.py"))
    rows, failures = kept(arguments.out / "evaluation.json", code), []
    for name in arguments.sequences:
        frames = KINDS[name].length * arguments.frames
        render(arguments.root / name, KINDS[name], frames, arguments.size)
        for mode, seed in ((mode, seed) for mode in arguments.modes for seed in arguments.seeds):
            asked: Row = {
                "sequence": name,
                "mode": mode,
                "seed": seed,
                "settings": arguments.settings,
            }
            asked |= {"frames": frames, "size": list(arguments.size), "code": code}
            asked |= {"model": sha256(model_path(arguments.model))} if mode == "model" else {}
            if any(all(row.get(key) == value for key, value in asked.items()) for row in rows):
                continue
            try:
                rows.append(asked | score(arguments, name, mode, seed))
            except CohdcError as error:
                failures.append(f"{name} {mode} seed {seed}: {error}")
            write_json(arguments.out / "evaluation.json", rows)
    text = tables(rows)
    write_text(arguments.out / "evaluation.md", text)
    print(text)
    if failures:
        raise SystemExit("\n".join(["runs that failed:", *failures]))


def parse() -> argparse.Namespace:
    """Return the arguments; `modes` are those that can run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--root", type=Path, required=True, help="where the rendered sequences are or go"
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--sequences", nargs="+", choices=KINDS, default=list(KINDS), metavar="NAME"
    )
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument(
        "--model", type=Path, help="ONNX or a shipped network's name; without it, no mode `model`"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    add_settings_option(parser)
    parser.add_argument("--frames", type=int, default=200, help="of a sequence of length 1")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH")
    )
    parser.add_argument(
        "--quick", action="store_true", help=f"{QUICK_FRAMES} frames of {QUICK_SIZE} px"
    )
    arguments = parser.parse_args()
    arguments.modes = [
        mode for mode in arguments.modes if mode != "model" or arguments.model is not None
    ]
    if arguments.quick:
        arguments.frames, arguments.size = QUICK_FRAMES, QUICK_SIZE
    return arguments


def digest(files: Iterable[Path]) -> str:
    """Of the tracker's code: rows of other code are not this code's."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(files))).hexdigest()[:16]


def kept(path: Path, code: str) -> list[Row]:
    """Rows of former calls that this code made."""
    rows = json.loads(path.read_text()) if path.is_file() else []
    return [row for row in rows if row["code"] == code]


def render(folder: Path, kind: Kind, frames: int, size: tuple[int, int]) -> None:
    """Render a sequence unless it lies there. Raises SystemExit when another one does."""
    wanted = {
        "seed": kind.seed,
        "motion": kind.motion,
        "people": kind.people,
        "scene": asdict(kind.scene),
    }
    wanted |= {"frames": frames, "size": list(size)}
    if (folder / "info.json").is_file():
        there = json.loads((folder / "info.json").read_text())
        if any(there.get(key) != value for key, value in wanted.items()):
            raise SystemExit(
                f"{folder}: rendered with other options; remove it or give another --root"
            )
        return
    sequence(folder, frames, (size[0], size[1]), kind.seed, kind.motion, kind.people, kind.scene)


def score(arguments: argparse.Namespace, name: str, mode: str, seed: int) -> Row:
    """Run once; the errors are None when fewer than three frames were tracked."""
    folder = arguments.root / name
    given: Row = {"model": arguments.model} if mode == "model" else {}
    given |= {"masks": folder / mode} if mode in ("masks", "movers") else {}
    out = arguments.out / name / f"{mode}_seed{seed}"
    settings = SlamConfig(seed=seed).override(arguments.settings)
    metrics = run_slam(folder, out, settings=settings, **given)
    row = {
        error: metrics.get(error, {}).get("rmse") for error in ("ate_m", "rpe_1s_m", "rpe_1s_deg")
    }
    return row | {"coverage": metrics["coverage"], "track_ms": metrics["ms"]["track"]["p50"]}


def tables(rows: list[Row]) -> str:
    """Return a table per choice of settings: ATE RMSE of each sequence and mode.

    Cells have the median and the worst over the seeds, and the coverage.
    """
    parts = []
    for settings in unique(json.dumps(row["settings"]) for row in rows):
        ours = [row for row in rows if json.dumps(row["settings"]) == settings]
        modes = [mode for mode in MODES if any(row["mode"] == mode for row in ours)]
        lines = [
            "| ATE RMSE m, median (worst), least coverage | " + " | ".join(modes) + " |",
            "|---" * (len(modes) + 1) + "|",
        ]
        for name in unique(row["sequence"] for row in ours):
            cells = [
                cell([r for r in ours if r["sequence"] == name and r["mode"] == mode])
                for mode in modes
            ]
            lines.append(f"| {name} | {' | '.join(cells)} |")
        changed = ", ".join(f"{key} {value}" for key, value in json.loads(settings).items())
        parts.append(f"### {changed or 'default settings'}\n\n" + "\n".join(lines) + "\n")
    return "\n".join(parts)


def cell(rows: list[Row]) -> str:
    """Return the table cell of one mode on one sequence."""
    if not rows:
        return "-"
    known = [row["ate_m"] for row in rows if row["ate_m"] is not None]
    errors = f"{statistics.median(known):.4f} ({max(known):.4f})" if known else "lost"
    return f"{errors}, {100 * min(row['coverage'] for row in rows):.0f} %"


def unique(names: Iterable[str]) -> list[str]:
    """In the order of their first appearance."""
    return list(dict.fromkeys(names))


if __name__ == "__main__":
    main()
