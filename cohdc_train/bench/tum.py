"""`cohdc bench tum`: ATE and RPE over TUM sequences, the paper's Tables 5 to 7 (no torch)."""

import json
import os
import re
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from cohdc_train.bench.published import ATE_RMSE, ERRORS, TABLES_5_TO_7
from cohdc_train.errors import CohdcError, DataError
from cohdc_train.files import sha256, write_json, write_text
from cohdc_train.presets import model_path
from cohdc_train.types import Row

MaskMode = Literal["none", "model", "masks"]

_LISTS = ("rgb.txt", "depth.txt", "groundtruth.txt")
_SCORES = {"ATE": "ate_m", "RPE 1 s": "rpe_1s_m", "RPE all pairs": "rpe_all_pairs_m"}


def bench_tum(
    folder: Path,
    *,
    out: Path,
    model: Path = Path("person"),
    modes: list[MaskMode] | None = None,
    seeds: list[int] | None = None,
) -> list[Row]:
    """Run SLAM on every TUM sequence below a folder, and compare ATE and RPE with the paper.

    A sequence is a folder with rgb.txt, depth.txt and groundtruth.txt. Each one runs without masks,
    with the model's masks, and with its own masks/ folder where it has one, once per seed. Finished
    runs are not repeated. Writes OUT/SEQUENCE/MODE_seedN (as `cohdc slam`), benchmark.json with one
    row per run, and benchmark.md with the median and worst over the seeds. TUM's own freiburg3
    walking sequences, known by their names, stand next to the paper's figures.

    Args:
        folder: folder of sequences; links are followed.
        out: folder for all results.
        model: ONNX file, or a shipped network's name: person, person_s.
        modes: where masks come from, in this order: none, model, masks; all three when not given.
        seeds: seeds of the runs; [0, 1, 2, 3, 4] when not given.

    Returns:
        The rows of benchmark.json.

    Raises:
        CohdcError: there is no sequence, or a run failed; the tables hold the others.
    """
    sequences = find_sequences(folder)
    rows: list[Row] = []
    failures: list[str] = []
    for name, sequence in sequences.items():
        for mode in modes or ("none", "model", "masks"):
            if mode == "masks" and not (sequence / "masks").is_dir():
                continue
            for seed in range(5) if seeds is None else seeds:
                title = f"{name} {mode} seed {seed}"
                try:
                    metrics = run_sequence(
                        sequence, mode, seed, model, out / name / f"{mode}_seed{seed}"
                    )
                except CohdcError as error:
                    failures.append(f"{title}: {error}")
                    print(failures[-1], flush=True)
                    continue
                row = {"sequence": name, "mode": mode, "seed": seed, **flatten(metrics)}
                rows.append(row)
                print(f"{title}: ATE {row.get('ate_m_rmse', float('nan')):.4f} m", flush=True)
    if rows:
        write_json(out / "benchmark.json", rows)
        text = format_tables(rows)
        write_text(out / "benchmark.md", text)
        print(text)
    if failures:
        total = len(rows) + len(failures)
        raise CohdcError(f"{len(failures)} of {total} runs failed, the first: {failures[0]}")
    return rows


def find_sequences(folder: Path) -> dict[str, Path]:
    """Find the TUM sequences below a folder: relative name -> folder, sorted.

    Raises:
        DataError: there is none.
    """
    candidates = sorted(Path(path) for path, _, _ in os.walk(folder, followlinks=True))
    sequences = {}
    for candidate in candidates:
        if all((candidate / name).is_file() for name in _LISTS):
            is_root = candidate == folder
            name = folder.resolve().name if is_root else str(candidate.relative_to(folder))
            sequences[name] = candidate
    if not sequences:
        raise DataError(f"{folder}: no folder with {', '.join(_LISTS[:2])} and {_LISTS[2]}")
    return sequences


def run_sequence(
    sequence: Path, mode: MaskMode, seed: int, model: Path, folder: Path
) -> dict[str, Any]:
    """Return the metrics of one run, from `folder` where it was made with the same options."""
    source = {"none": None, "model": str(model), "masks": str(sequence / "masks")}[mode]
    request = {"sequence": str(sequence.resolve()), "masks": source, "seed": seed}
    if mode == "model":
        request["model"] = sha256(model_path(model))

    cache_file = folder / "request.json"
    if cache_file.is_file() and json.loads(cache_file.read_text()) == request:
        return dict(json.loads((folder / "metrics.json").read_text()))

    from cohdc_train.slam.config import SlamConfig
    from cohdc_train.slam.run import run_slam

    folder.parent.mkdir(parents=True, exist_ok=True)
    metrics = run_slam(
        sequence,
        folder,
        model=model if mode == "model" else None,
        masks=sequence / "masks" if mode == "masks" else None,
        settings=SlamConfig(seed=seed),
    )
    write_json(cache_file, request)
    return metrics


def flatten(metrics: dict[str, Any], prefix: str = "") -> Row:
    """Join the names of nested metrics with underscores, such as `ate_m_rmse`; drop `seed`."""
    row: Row = {}
    for name, value in metrics.items():
        if name == "seed":
            continue
        if isinstance(value, dict):
            row |= flatten(value, f"{prefix}{name}_")
        else:
            row[prefix + name] = value
    return row


def format_tables(rows: Sequence[Row]) -> str:
    """Format one Markdown table per sequence: its errors in each mode, and the paper's."""
    names = dict.fromkeys(row["sequence"] for row in rows)
    return "\n".join(
        _format_sequence(name, [row for row in rows if row["sequence"] == name]) for name in names
    )


def _format_sequence(sequence: str, rows: Sequence[Row]) -> str:
    modes = list(dict.fromkeys(row["mode"] for row in rows))
    published = next(
        (name for name in ATE_RMSE if re.search(f"(freiburg|fr)3_{name}$", sequence)), ""
    )

    def cells(key: str, worst: Callable[[list[float]], float] = max) -> str:
        of_mode = ([row.get(key) for row in rows if row["mode"] == mode] for mode in modes)
        return " | ".join(format_spread(values, worst) for values in of_mode)

    titles = " | ".join(f"{mode}, median (worst)" for mode in modes)
    lines = [f"### {sequence}", "", f"| error, m | {titles} | paper |"]
    lines.append("|---" * (len(modes) + 2) + "|")
    for title, key in _SCORES.items():
        paper = _paper_errors(published, title)
        for error in ERRORS:
            value = paper[error]
            text = "" if value is None else f"{value:.4f}"
            lines.append(f"| {title} {error} | {cells(f'{key}_{error}')} | {text} |")
    lines.append(f"| coverage | {cells('coverage', min)} | |")
    if published:
        others = ", ".join(f"{name} {value:.4f}" for name, value in ATE_RMSE[published].items())
        lines += ["", f"ATE RMSE in the systems' own papers, m: {others}."]
    return "\n".join(lines) + "\n"


def _paper_errors(sequence: str, title: str) -> dict[str, float | None]:
    """Return the paper's value of each error; None where it has none. Its RPE is of all pairs."""
    key = {"ATE": "ATE", "RPE all pairs": "RPE"}.get(title, "")
    values = TABLES_5_TO_7.get(sequence, {}).get(key, (None,) * len(ERRORS))
    return dict(zip(ERRORS, values, strict=True))


def format_spread(
    values: Sequence[float | None], worst: Callable[[list[float]], float] = max
) -> str:
    """Format the median and worst of the known values, and their number when some are None."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    missing = "" if len(known) == len(values) else f", {len(known)} of {len(values)}"
    return f"{statistics.median(known):.4f} ({worst(known):.4f}{missing})"
