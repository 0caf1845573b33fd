"""Table 4 as text, CSV, JSON and a plot of accuracy over speed."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cohdc_train.bench.training import markdown_table
from cohdc_train.files import write_bytes, write_json, write_text
from cohdc_train.types import Row

TABLE_FILES = ("table4.json", "table4.csv", "table4.txt", "table4.png")
RATES = ("fps_torch", "fps_ort", "fps_ort_int8")
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
_ONE_DIGIT = ("train_seconds", "model_mb", "model_mb_int8", "peak_mb", "vertices")


def write_table(out: Path, table: Sequence[Row], environment: str) -> None:
    """Write table4.json, table4.csv, table4.txt and table4.png, and print the table.

    Args:
        out: folder for the files.
        table: rows of table4.json.
        environment: what the figures were measured on.
    """
    text = format_table(table, environment)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(_COLUMNS), extrasaction="ignore")
    writer.writeheader()
    writer.writerows(table)
    write_json(out / "table4.json", list(table))
    write_text(out / "table4.csv", stream.getvalue())
    write_text(out / "table4.txt", text)
    write_bytes(out / "table4.png", plot_table(table))
    print(text)


def format_table(table: Sequence[Row], environment: str) -> str:
    """Format the table in Markdown, and what it was measured on.

    Brackets hold the range over the seeds (scores) and the quartiles over the images (FPS).
    """
    cells = [[_format_cell(row, column) for column in _COLUMNS] for row in table]
    return f"{markdown_table(list(_COLUMNS.values()), cells)}\n{environment}\n"


def _format_cell(row: Row, column: str) -> str:
    value = row.get(column)
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    digits = 2 if column in RATES else 1 if column in _ONE_DIGIT else 3
    text = f"{value:.{digits}f}"
    low, high = row["ranges"].get(column, (None, None))
    has_range = column in RATES or len(row["seeds"]) >= 2
    if low is None or high is None or not has_range:
        return text
    return f"{text} ({low:.{digits}f}-{high:.{digits}f})"


def plot_table(table: Sequence[Row]) -> bytes:
    """Plot mask AP over images per second, float32 and int8 of a network joined; returns a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for i, row in enumerate(table):
        _plot_row(axes, row, f"C{i % 10}")
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


def _plot_row(axes: Any, row: Row, color: str) -> None:
    pairs = (("fps_ort", "ap", "o"), ("fps_ort_int8", "ap_int8", "s"))
    points = [(x, y, m) for x, y, m in pairs if row[x] is not None and row[y] is not None]
    if not points:
        return
    rates = [row[x] for x, _, _ in points]
    scores = [row[y] for _, y, _ in points]
    axes.plot(rates, scores, color=color, linewidth=1)
    for x, y, marker in points:
        y_error, x_error = _error_bar(row, y), _error_bar(row, x)
        style = {"fmt": marker, "color": color, "elinewidth": 0.7, "capsize": 2}
        axes.errorbar(row[x], row[y], y_error, x_error, **style)
    place = (rates[0], scores[0])
    axes.annotate(row["name"], place, xytext=(5, 5), textcoords="offset points", fontsize=8)


def _error_bar(row: Row, column: str) -> list[list[float]]:
    """Return [[below], [above]]: how far a column's range reaches from its median, else 0."""
    median = row[column]
    low, high = row["ranges"].get(column, (None, None))
    below = 0.0 if low is None else median - low
    above = 0.0 if high is None else high - median
    return [[below], [above]]
