"""A run's files -> one HTML page that needs nothing beside itself: pictures, plots and tables are
inside it.
"""

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from cohdc_train.errors import DataError
from cohdc_train.files import check_folder, list_files, write_text
from cohdc_train.report.plots import Run, plot_errors, plot_over_time, plot_paths
from cohdc_train.trajectory.association import match
from cohdc_train.trajectory.metrics import align_umeyama
from cohdc_train.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCORES = ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222 }
h1, h2, h3 { line-height: 1.2 } table { border-collapse: collapse; margin: .5rem 0 1.5rem }
th, td { padding: .2rem .8rem; border-bottom: 1px solid #ddd; text-align: right; font-variant-numeric: tabular-nums }
th:first-child, td:first-child { text-align: left } thead th { border-bottom: 2px solid #888 }
figure { margin: 0 } figcaption { color: #666; font-size: .85rem } img { max-width: 100%; display: block }
.grid { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: .8rem; margin-bottom: 1.5rem }
"""


@dataclass(frozen=True)
class Table:
    """A table of the page: a title, the words of the head and of the rows. Raises ValueError for an
    uneven row.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.head) for row in self.rows):
            raise ValueError(
                f"table {self.title!r}: a row has not the {len(self.head)} cells of its head"
            )

    def html(self) -> str:
        """The table as HTML, every word escaped."""
        head = "".join(f"<th>{html.escape(word)}</th>" for word in self.head)
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(word)}</td>" for word in row) + "</tr>\n"
            for row in self.rows
        )
        return f"<h3>{html.escape(self.title)}</h3>\n<table><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"


def report(
    run: Path,
    *,
    against: Path | None = None,
    groundtruth: Path | None = None,
    out: Path | None = None,
) -> Path:
    """One HTML page of a SLAM run's scores, trajectory, times and pictures; nothing beside it is
    needed to read it.

    Returns the page. Raises DataError naming a file of a run that cannot be used.

    Args:
        run: folder written by `cohdc slam`.
        against: another run on the same sequence, such as one without masks.
        groundtruth: TUM file; groundtruth.txt of the run's sequence when not given and there.
        out: the HTML file; report.html in the run's folder when not given.
    """
    if groundtruth is None:
        beside = Path(str(_config(run).get("sequence"))) / "groundtruth.txt"
        groundtruth = beside if beside.is_file() else None
        print("ground truth: " + (str(beside) if groundtruth else f"none, {beside} is not there"))
    name = run.resolve().name
    runs = (
        {name: run}
        if against is None
        else {f"{against.resolve().name}, against": against, name: run}
    )
    page = out if out is not None else run / "report.html"
    if page.is_dir():
        raise DataError(f"{page}: is a folder; --out names the page")
    if out is None:
        check_folder(run, "report", [page.name])
    write_report(page, name, groundtruth, runs)
    if out is None:
        list_files(run, "report", [page.name])
    print(page)
    return page


def _config(run: Path) -> dict[str, Any]:
    file = run / "config.yaml"
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise DataError(
            f"{file}: cannot be read; is {run} a folder of cohdc slam? ({error})"
        ) from error
    return config if isinstance(config, dict) else {}


def write_report(
    out: Path,
    title: str,
    groundtruth: Path | None,
    runs: Mapping[str, Path],
    overlays: Sequence[Path] = (),
    tables: Sequence[Table] = (),
) -> None:
    """Write one self-contained HTML page about SLAM runs on a sequence.

    out: the HTML file, written whole or not at all; groundtruth: TUM file, None where there is
    none; runs: label -> folder written by `slam` (trajectory.txt, metrics.json, map.png,
    pictures/<stamp>_before.jpg and _after.jpg);
    overlays: JPEG or PNG images of predicted masks; tables: shown first. Sections without content
    are left out. Raises DataError naming a file of a run or an image that cannot be used.
    """
    truth = None if groundtruth is None else Trajectory.load_tum(groundtruth)
    loaded = [_load(label, folder, truth) for label, folder in runs.items()]
    parts = [table.html() for table in (*tables, *_metric_tables(loaded))]
    aligned = [run for run in loaded if run.estimate is not None]
    if aligned:
        parts.append(f"<h2>Trajectory{'' if truth is None else ' against ground truth'}</h2>")
        how = "" if truth is None else ", after rigid alignment"
        parts.append(_svg(plot_paths(truth, aligned), f"seen from above and from the side{how}"))
        parts.append(_svg(plot_over_time(truth, aligned), "position over time"))
    if aligned and truth is not None:
        parts.append("<h2>Absolute trajectory error over time</h2>")
        parts.append(
            _svg(
                plot_errors(truth, aligned),
                "distance to ground truth of every matched pose, after alignment",
            )
        )
    maps = [
        (run.folder / "map.png", run.label) for run in loaded if (run.folder / "map.png").is_file()
    ]
    if maps:
        parts.append(
            "<h2>Map from above</h2>\n<p>What stands still; the way of the camera in red.</p>"
        )
        parts.append(_grid(maps))
    if overlays:
        parts.append(f"<h2>Predicted masks</h2>\n{_grid([(file, file.stem) for file in overlays])}")
    pictures = [item for run in loaded for item in _pictures(run)]
    if pictures:
        parts.append("<h2>Features before and after culling</h2>")
        parts.append(
            "<p>Before: every corner, red on a mask. After: the corners that were used, masks outlined.</p>"
        )
        parts.append(_grid(pictures))
    _write(out, title, parts)


def _write(out: Path, title: str, parts: Sequence[str]) -> None:
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    body = "\n".join([f"<h1>{html.escape(title)}</h1>", *parts])
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(
        out,
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n',
    )


def _load(label: str, folder: Path, truth: Trajectory | None) -> Run:
    file = folder / "metrics.json"
    try:
        metrics = json.loads(file.read_text(encoding="utf-8"))
        float(metrics["coverage"])
        for time in metrics.get("ms", {}).values():
            float(time["p50"]), float(time["p95"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise DataError(f"{file}: cannot be read as metrics: {error!r}") from error
    if metrics.get("coverage") == 0:  # a tracker that was never on its way has no pose to plot
        return Run(label, folder, metrics, None, None)
    estimate = Trajectory.load_tum(folder / "trajectory.txt")
    if truth is None:
        return Run(label, folder, metrics, None, estimate)
    try:
        matched_truth, matched = match(truth, estimate)
    except DataError:
        return Run(label, folder, metrics, None, None)
    T = align_umeyama(matched.positions, matched_truth.positions)
    return Run(label, folder, metrics, matched_truth, matched.transformed(T))


# ---- tables


def _metric_tables(runs: Sequence[Run]) -> list[Table]:
    scored = [(key, run) for key in SCORES for run in runs if key in run.metrics]
    result = []
    if scored:
        names = list(scored[0][1].metrics[scored[0][0]])
        rows = [
            [key, run.label, *(f"{run.metrics[key][name]:.4f}" for name in names)]
            for key, run in scored
        ]
        result.append(Table("Trajectory scores", ["score", "run", *names], rows))
    rows = []
    for run in runs:
        coverage = f"{100 * run.metrics['coverage']:.1f} %"
        for stage, time in run.metrics.get("ms", {}).items():
            rows.append([run.label, coverage, stage, f"{time['p50']:.1f}", f"{time['p95']:.1f}"])
    if rows:
        result.append(
            Table(
                "Coverage and time per stage",
                ["run", "coverage", "stage", "p50 ms", "p95 ms"],
                rows,
            )
        )
    return result


def _svg(figure: "Figure", caption: str) -> str:
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "cohdc"}):  # the same run gives the same page
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _embedded(buffer.getvalue(), "image/svg+xml", caption)


# ---- pictures


def _pictures(run: Run) -> list[tuple[Path, str]]:
    files = []
    for before in sorted((run.folder / "pictures").glob("*_before.jpg")):
        after = before.with_name(before.name.replace("_before", "_after"))
        if after.is_file():  # a run without masks culls nothing
            stamp = before.name.removesuffix("_before.jpg")
            files += [
                (before, f"{run.label}, {stamp}, before"),
                (after, f"{run.label}, {stamp}, after"),
            ]
    return files


def _grid(files: Sequence[tuple[Path, str]]) -> str:
    figures = []
    for file, caption in files:
        kind = "image/png" if file.suffix.lower() == ".png" else "image/jpeg"
        try:
            figures.append(_embedded(file.read_bytes(), kind, caption))
        except OSError as error:
            raise DataError(f"{file}: cannot be read: {error}") from error
    return f'<div class="grid">{"".join(figures)}</div>'


def _embedded(content: bytes, kind: str, caption: str) -> str:
    data = base64.b64encode(content).decode("ascii")
    text = html.escape(caption, quote=True)
    return f'<figure><img alt="{text}" src="data:{kind};base64,{data}"><figcaption>{text}</figcaption></figure>\n'
