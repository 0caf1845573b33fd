"""Folders and files of `cohdc validate`, `cohdc evaluate` and `cohdc bench` on a page."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cohdc_train.errors import DataError
from cohdc_train.report.names import BENCH, ERRORS, score_quantity
from cohdc_train.report.page import Fact, Figure, Page, Section, Table
from cohdc_train.report.slam_run import SlamRun, match_to_truth
from cohdc_train.report.svg import Draw, Size, color, svg
from cohdc_train.report.tables import mark_best
from cohdc_train.report.training_run import VALIDATION_IMAGES, read_scores, score_files
from cohdc_train.report.training_sections import image_figures, score_table
from cohdc_train.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

BENCH_FILE = "table4.json"
_SPEEDS = (("fps_ort", "ap", "o"), ("fps_ort_int8", "ap_int8", "s"))


def read_evaluation(label: str, file: Path) -> SlamRun | None:
    """Return a file of `cohdc evaluate` as a run with nothing but its trajectory and errors.

    None for another file. The trajectories are drawn where they still are.
    """
    content = _json(file)
    if not isinstance(content, dict) or not {"coverage", "pairs", *list(ERRORS)[:1]} <= set(
        content
    ):
        return None
    run = SlamRun(label, file.parent, content, {}, None, None, None, None)
    estimate, truth = (Path(str(content.get(key))) for key in ("estimate", "groundtruth"))
    if not estimate.is_file():
        return run
    return match_to_truth(
        run, Trajectory.load_tum(estimate), Trajectory.load_tum(truth) if truth.is_file() else None
    )


def validated_scores(path: Path) -> dict[str, dict[str, float]]:
    """Return name -> scores of a file of `cohdc validate`, or of all such files in a folder."""
    if path.is_dir():
        return score_files(path)
    scores = read_scores(path)
    return {path.stem: scores} if scores else {}


def validation_page(title: str, runs: Mapping[str, Path]) -> Page:
    """Return the page of one or more validations. runs: label -> file or folder."""
    columns: dict[str, Mapping[str, float]] = {}
    files: list[Path] = []
    for label, path in runs.items():
        found = validated_scores(path)
        columns |= {label if len(found) == 1 else f"{label}/{n}": s for n, s in found.items()}
        files += [
            path / name for name in VALIDATION_IMAGES if path.is_dir() and (path / name).is_file()
        ]
    facts = []
    if len(columns) == 1:
        (scores,) = columns.values()
        names = [
            name for name in ("segm_AP", "segm_AP50", "boundary_AP", "box_AP") if name in scores
        ]
        facts = [Fact(score_quantity(name).name, f"{scores[name]:.3f}") for name in names]
    sections = [
        Section("Scores", tables=[score_table(columns)] if columns else []),
        Section("Classes", tables=_class_table(columns)),
        Section("Sample predictions", figures=image_figures(files, len(files))),
    ]
    return Page(title, "Validation", facts=facts, sections=sections)


def bench_page(title: str, rows: Sequence[Mapping[str, Any]]) -> Page:
    """Return the page of `cohdc bench`. rows: of its table4.json."""
    columns = [key for key in BENCH if any(row.get(key) is not None for row in rows)]
    cells = [
        [
            str(row.get("name")),
            *("–" if row.get(k) is None else BENCH[k].text(row[k]) for k in columns),
        ]
        for row in rows
    ]
    best = mark_best(cells, [0, *(BENCH[key].better for key in columns)])
    table = Table(
        "",
        ["Network", *(BENCH[key].title for key in columns)],
        cells,
        best=best,
        note="Bold: best.",
    )
    wide, narrow = (svg(_draw_bench(rows), size, f"bench{size.width}") for size in _BENCH_SIZES)
    caption = "Circle: float32, square: int8; with onnxruntime."
    figure = Figure("Mask AP over speed", caption, wide, narrow, span=True)
    return Page(
        title,
        "Benchmark of networks",
        sections=[Section("Networks", tables=[table], figures=[figure])],
    )


def read_bench(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a folder of `cohdc bench`. Raises DataError for a file of another kind."""
    file = folder / BENCH_FILE
    rows = _json(file)
    if not isinstance(rows, list) or not all(
        isinstance(row, dict) and "name" in row for row in rows
    ):
        raise DataError(f"{file}: is no table of cohdc bench")
    return rows


_BENCH_SIZES = (Size(1080, 380), Size(380, 340))


def _draw_bench(rows: Sequence[Mapping[str, Any]]) -> Draw:
    def draw(figure: "Drawing") -> None:
        axes = figure.subplots()
        for place, row in enumerate(rows):
            points = [
                (row[x], row[y], marker)
                for x, y, marker in _SPEEDS
                if row.get(x) is not None and row.get(y) is not None
            ]
            axes.plot(
                [x for x, _, _ in points], [y for _, y, _ in points], color=color(place), lw=1
            )
            for x, y, marker in points:
                axes.plot(x, y, marker, color=color(place), ms=6)
            if points:
                place_of_name = points[0][:2]
                axes.annotate(str(row["name"]), place_of_name, (6, 6), textcoords="offset points")
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.margins(0.15)
        axes.set(xlabel="speed, images/s", ylabel="mask AP")

    return draw


def _class_table(columns: Mapping[str, Mapping[str, float]]) -> list[Table]:
    prefix = "segm_AP/"
    names = list(
        dict.fromkeys(n for scores in columns.values() for n in scores if n.startswith(prefix))
    )
    rows = [
        [n.removeprefix(prefix), *(f"{s[n]:.3f}" if n in s else "–" for s in columns.values())]
        for n in names
    ]
    return [Table("Mask AP of every class", ["Class", *columns], rows)] if rows else []


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read as JSON: {error}") from error
