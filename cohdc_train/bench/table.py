"""Table 4 as text, CSV, JSON and a plot of accuracy over speed."""

import csv
import io
import math
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from cohdc_train.bench.rows import ROWS, Entry, finished_entry, row_config, trained_entry
from cohdc_train.bench.speed import Rate, frame_rates, peak_memory, runners_of, spread
from cohdc_train.data.annotations import read_image
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.files import claim_folder, write_bytes, write_json, write_text
from cohdc_train.types import Row

_FILES = ("table4.json", "table4.csv", "table4.txt", "table4.png", "picture.npy")
_RATES = ("fps_torch", "fps_ort", "fps_ort_int8")
_COLUMNS = {
    "name": "network",
    "train_seconds": "training s",
    "fps_torch": "FPS torch",
    "fps_ort": "FPS ORT",
    "fps_ort_int8": "FPS ORT int8",
    "model_mb": "MB",
    "model_mb_int8": "MB int8",
    "ap": "AP",
    "ap_int8": "AP int8",
    "boundary_ap": "boundary AP",
    "s90_matched": "S>90 of matched",
    "s90_all": "S>90 of all",
    "peak_mb": "peak MiB",
    "vertices": "vertices",
}


def run(
    data: Path,
    out: Path,
    rows: list[str] | None,
    models: list[Path],
    options: tuple[str, ...],
    weights: dict[str, str],
    seeds: list[int],
    threads: int,
    images: int,
    int8: bool,
) -> list[Row]:
    """`cohdc_train.bench.bench`."""
    if min(threads, images) < 1:
        raise CohdcError(f"threads is {threads} and images is {images}; both are at least 1")
    wanted = list(ROWS) if rows is None else rows
    for row in (*wanted, *weights):
        row_config(row)
    if strangers := set(weights) - set(wanted):
        raise CohdcError(f"weights are given for {min(strangers)!r}, which is none of the rows")
    names = {Path(row).stem: row for row in wanted}
    if len(names) < len(wanted):
        raise CohdcError(f"rows {', '.join(wanted)}: two have the same name")
    claim_folder(out, "bench", _FILES)
    entries: dict[str, list[Entry]] = {}
    for seed in seeds:  # seed by seed, so that an interrupted bench has every row at few seeds
        for name, row in names.items():
            folder = out / f"{name}_seed{seed}"
            print(f"{name}, seed {seed}", flush=True)
            made = trained_entry(row, seed, data, folder, options, weights.get(row), threads, int8)
            entries.setdefault(name, []).append(made)
    for model in models:
        print(model, flush=True)
        entries[str(model)] = [finished_entry(model, data, out, threads, int8)]
    pictures = _pictures(data, images)
    rates = _timed({name: of_row[0] for name, of_row in entries.items()}, pictures, threads)
    np.save(out / "picture.npy", pictures[0])
    table = [
        _row(
            name,
            of_row,
            rates[name],
            peak_memory(of_row[0].files["fps_ort"], out / "picture.npy", threads),
        )
        for name, of_row in entries.items()
    ]
    (out / "picture.npy").unlink()
    _write(out, table, environment(threads, data, len(pictures), seeds))
    return table


def _pictures(data: Path, count: int) -> list[Any]:
    split = CocoDataModule(data).folder.val
    return [read_image(image) for image in split.images[:count]]


def _timed(
    entries: dict[str, Entry], pictures: Sequence[Any], threads: int
) -> dict[str, dict[str, Rate]]:
    """Rates of every row by column; all of them take turns."""
    runners = {
        (name, column): runner
        for name, entry in entries.items()
        for column, runner in runners_of(entry.checkpoint, entry.files, threads).items()
    }
    rates: dict[str, dict[str, Rate]] = {name: {} for name in entries}
    for (name, column), rate in frame_rates(runners, pictures).items():
        rates[name][column] = rate
    return rates


def _row(name: str, entries: Sequence[Entry], rates: dict[str, Rate], peak: float) -> Row:
    """A row of table4.json: medians over seeds, and beside them the range; None where there is
    nothing.
    """
    row: Row = {"name": name}
    first = entries[0]
    seconds = [entry.train_seconds for entry in entries if entry.train_seconds is not None]
    row["train_seconds"] = spread(seconds)[0] if seconds else None
    for column in _RATES:
        row[column] = rates[column].median if column in rates else None
    sizes = {column: path.stat().st_size / 1e6 for column, path in first.files.items()}
    row |= {"model_mb": sizes["fps_ort"], "model_mb_int8": sizes.get("fps_ort_int8")}
    scores = {key: [entry.scores[key] for entry in entries] for key in first.scores}
    row |= {key: _none_if_nan(spread(values)[0]) for key, values in scores.items()}
    row |= {"ap_int8": row.get("ap_int8"), "peak_mb": peak}
    row["ranges"] = {
        key: [_none_if_nan(v) for v in spread(values)[1:]] for key, values in scores.items()
    }
    row["ranges"] |= {column: [rate.low, rate.high] for column, rate in rates.items()}
    row["seeds"] = [entry.seed for entry in entries if entry.seed is not None]
    return row


def _none_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


def environment(threads: int, data: Path, pictures: int, seeds: Sequence[int]) -> str:
    """One paragraph: what the figures were measured on."""
    packages = ", ".join(
        f"{name} {metadata.version(name)}" for name in ("torch", "torchvision", "onnxruntime")
    )
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = models[0].partition(":")[2].strip() if models else cpu
    load = f", load {os.getloadavg()[0]:.1f} at the end" if hasattr(os, "getloadavg") else ""
    return (
        f"{cpu}, {os.cpu_count()} CPUs{load}; {threads} thread{'s' if threads > 1 else ''}; {packages}; "
        f"{data.name}, {pictures} pictures timed in turn, seeds {', '.join(map(str, seeds))}"
    )


def as_text(table: Sequence[Row], environment: str) -> str:
    """The table in Markdown, with ranges over seeds (scores) and quartiles over pictures (FPS) in
    brackets.
    """
    lines = [list(_COLUMNS.values()), ["---"] * len(_COLUMNS)]
    for row in table:
        lines.append([_cell(row, column) for column in _COLUMNS])
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{text}\n\n{environment}\n"


def _cell(row: Row, column: str) -> str:
    value = row.get(column)
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    digits = (
        1 if column in ("train_seconds", "model_mb", "model_mb_int8", "peak_mb", "vertices") else 3
    )
    digits = 2 if column in _RATES else digits
    low, high = row["ranges"].get(column, (None, None))
    one = low is None or high is None or (column not in _RATES and len(row["seeds"]) < 2)
    return (
        f"{value:.{digits}f}" if one else f"{value:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"
    )


def _write(out: Path, table: Sequence[Row], said: str) -> None:
    text = as_text(table, said)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(_COLUMNS), extrasaction="ignore")
    writer.writeheader()
    writer.writerows(table)
    write_json(out / "table4.json", list(table))
    write_text(out / "table4.csv", stream.getvalue())
    write_text(out / "table4.txt", text)
    write_bytes(out / "table4.png", plot(table))
    print(text)


def plot(table: Sequence[Row]) -> bytes:
    """Mask AP over frames per second as a PNG, with their ranges; float32 and int8 of a network are
    joined.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for i, row in enumerate(table):
        pairs = (("fps_ort", "ap", "o"), ("fps_ort_int8", "ap_int8", "s"))
        points = [(x, y, m) for x, y, m in pairs if row[x] is not None and row[y] is not None]
        color = f"C{i % 10}"
        axes.plot(
            [row[x] for x, _, _ in points], [row[y] for _, y, _ in points], color=color, linewidth=1
        )
        for x, y, marker in points:
            errors = _either_way(row, y), _either_way(row, x)
            axes.errorbar(
                row[x], row[y], *errors, fmt=marker, color=color, elinewidth=0.7, capsize=2
            )
        if points:
            place = row[points[0][0]], row[points[0][1]]
            axes.annotate(row["name"], place, xytext=(5, 5), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.margins(0.15)
    axes.set_xlabel("frames per second, image to masks (circle float32, square int8; onnxruntime)")
    axes.set_ylabel("mask AP")
    axes.grid(alpha=0.3)
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)  # type: ignore[no-untyped-call]
    return stream.getvalue()


def _either_way(row: Row, name: str) -> list[list[float]]:
    """[[below], [above]] of a column's median in a row: how far its range reaches, 0 where it has
    none.
    """
    low, high = (row[name] if end is None else end for end in row["ranges"].get(name, (None, None)))
    return [[row[name] - low], [high - row[name]]]
