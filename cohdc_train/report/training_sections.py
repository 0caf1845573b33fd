"""The parts of a page about trainings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cohdc_train.report.images import embed
from cohdc_train.report.names import count, score_quantity
from cohdc_train.report.page import Fact, Figure, Page, Section, Table
from cohdc_train.report.svg import Draw, Size, svg
from cohdc_train.report.tables import mark_best, options
from cohdc_train.report.training_plots import (
    draw_classes,
    draw_learning_curve,
    draw_losses,
    draw_rates,
)
from cohdc_train.report.training_run import TrainingRun

_PLOT = Size(370, 300)
_CLASSES = 20  # in the plot; the table has all
_COMPARED = ("segm_AP", "segm_AP50", "segm_AP75", "boundary_AP", "box_AP", "mIoU")
TITLES: Mapping[str, tuple[str, str]] = {
    "best.jpg": ("Images predicted best", "Left: truth, right: prediction."),
    "worst.jpg": (
        "Images predicted worst",
        "Left: truth, right: prediction. Red: missed or false.",
    ),
    "pr_curves.png": ("Precision over recall", ""),
    "calibration.png": ("Predicted quality against true IoU", ""),
    "confusion.png": ("Confusion of classes", ""),
}


def training_page(title: str, runs: Sequence[TrainingRun]) -> Page:
    """Return the page of one or more trainings."""
    sections = training_sections(runs)
    if len(runs) == 1:
        (run,) = runs
        return Page(title, "Training", [_lead(run)], _facts(run), sections)
    return Page(title, f"Comparison of {len(runs)} trainings", sections=sections)


def training_sections(runs: Sequence[TrainingRun]) -> list[Section]:
    """Return all parts below the facts."""
    placed = list(enumerate(runs))
    summary = [Section("Trainings side by side", tables=[_comparison(runs)])]
    differing, every = options({run.label: run.config for run in runs})
    plots = [
        ("Learning curve", draw_learning_curve(placed), "val/segm_AP"),
        ("Losses", draw_losses(placed), "train/loss"),
        ("Learning rate", draw_rates(placed), "lr/heads"),
    ]
    figures = [
        Figure(name, wide=_plot(drawing, name))
        for name, drawing, column in plots
        if any(column in run.series for run in runs)
    ]
    return [
        *(summary if len(runs) > 1 else []),
        Section("Training", figures=figures),
        _classes(runs),
        *([_scores(runs[0])] if len(runs) == 1 else []),
        *(_predictions(run, len(runs)) for run in runs),
        Section("Options", tables=differing, folded=every),
    ]


def image_figures(files: Sequence[Path], images: int) -> list[Figure]:
    """Return figures of a validation's images, the grids over the whole width.

    images: how many the page has.
    """
    figures = []
    for file in files:
        title, caption = TITLES.get(file.name, (file.stem, ""))
        grid = file.suffix == ".jpg"
        figure = Figure(title, caption, image=embed(file, images), span=grid, chart=not grid)
        figures.append(replace(figure, large=file.name == "pr_curves.png"))
    return figures


def score_table(columns: Mapping[str, Mapping[str, float]]) -> Table:
    """Return a table of segmentation scores, without classes. columns: head -> scores by name."""
    names = sorted({n for scores in columns.values() for n in scores if "/" not in n}, key=_order)
    rows = [
        [
            score_quantity(name).title,
            *(score_quantity(name).text(s[name]) if name in s else "–" for s in columns.values()),
        ]
        for name in names
    ]
    return Table("", ["Score", *columns], rows)


def _order(score: str) -> tuple[int, str]:
    """Return the place of a score in a table: masks, boundaries, boxes, and what is left."""
    kinds = ("segm_", "boundary_", "box_")
    return next((k for k, kind in enumerate(kinds) if score.startswith(kind)), len(kinds)), score


def _lead(run: TrainingRun) -> str:
    scores = run.best_scores()
    trained = f"{count(run.steps, 'step')} in {count(run.epochs, 'epoch')}"
    if "segm_AP" not in scores:
        return f"{trained}; no validation yet."
    return f"Mask AP {scores['segm_AP']:.3f} on the validation split, after {trained}."


def _facts(run: TrainingRun) -> list[Fact]:
    """Return what to know of a training first."""
    scores, step = run.best_scores(), run.best_step()
    found = [
        Fact(
            score_quantity(name).name,
            f"{scores[name]:.3f}",
            "" if k else f"best, at step {step:.0f}",
        )
        for k, name in enumerate(("segm_AP", "segm_AP50", "boundary_AP", "box_AP"))
        if name in scores
    ]
    found.append(Fact("Steps", str(run.steps), count(run.epochs, "epoch")))
    speed = run.part("speed/").get("images_per_s")
    if speed is not None:
        found.append(Fact("Speed", f"{speed[-1, 1]:.1f} images/s", "training, at the end"))
    network, canvas = run.option("model", "network"), run.option("data", "canvas")
    if isinstance(network, dict):
        width = f"width {network['width']:g}" if "width" in network else ""
        found.append(Fact("Network", str(network.get("backbone", "?")), width))
    if isinstance(canvas, list | tuple) and len(canvas) == 2:
        found.append(Fact("Canvas", f"{canvas[1]} × {canvas[0]} px", "width × height"))
    values = {
        "Data": _name(run.option("data", "root")),
        "Initial weights": run.option("pretrained"),
        "Batch size": run.option("data", "batch_size"),
        "Learning rate": run.option("model", "optimizer", "lr"),
        "Seed": run.option("seed_everything"),
    }
    return found + [Fact(name, str(value)) for name, value in values.items() if value is not None]


def _name(root: object) -> str | None:
    """Return the name of a data folder, or of several."""
    if root is None:
        return None
    roots = root if isinstance(root, list) else [root]
    return ", ".join(Path(str(folder)).name for folder in roots)


def _comparison(runs: Sequence[TrainingRun]) -> Table:
    """Return a row per training; the best of a column is marked."""
    scores = [run.best_scores() for run in runs]
    names = [name for name in _COMPARED if any(name in of_run for of_run in scores)]
    rows = [
        [
            run.label,
            *(score_quantity(n).text(of_run[n]) if n in of_run else "–" for n in names),
            str(run.steps),
            str(run.epochs),
        ]
        for run, of_run in zip(runs, scores, strict=True)
    ]
    head = ["Run", *(score_quantity(name).title for name in names), "Steps", "Epochs"]
    better = [0, *(score_quantity(name).better for name in names), 0, 0]
    best = mark_best(rows, better)
    return Table("", head, rows, best=best, note="Bold: the best of a column." if best else "")


def _classes(runs: Sequence[TrainingRun]) -> Section:
    scores = [run.class_scores() for run in runs]
    names = list(dict.fromkeys(name for of_run in scores for name in of_run))
    if not names:
        return Section("Classes")
    shown = names[:_CLASSES]
    size = Size(370, 90 + 24 * len(shown) * max(1.0, 0.5 * len(runs)))
    caption = f"The best {_CLASSES} of {len(names)} classes." if len(shown) < len(names) else ""
    figure = Figure(
        "Mask AP per class", caption, wide=svg(draw_classes(scores, shown), size, "classes")
    )
    rows = [[name, *(f"{s[name]:.3f}" if name in s else "–" for s in scores)] for name in names]
    head = ["Class", *(run.label for run in runs)] if len(runs) > 1 else ["Class", "Mask AP"]
    return Section(
        "Classes", figures=[figure], folded=[Table("Mask AP of every class", head, rows)]
    )


def _scores(run: TrainingRun) -> Section:
    step = run.best_step()
    best = {} if step is None else {f"Best validation, step {step:.0f}": run.best_scores()}
    columns = best | {f"cohdc validate, {name}": found for name, found in run.validated.items()}
    return Section("Scores", tables=[score_table(columns)] if columns else [])


def _predictions(run: TrainingRun, runs: int) -> Section:
    files = run.images()
    if runs > 1:  # of several only what is missed is of interest
        files = [file for file in files if file.name == "worst.jpg"]
    title = "Sample predictions" + (f": {run.label}" if runs > 1 else "")
    return Section(title, figures=image_figures(files, 6 if runs == 1 else runs))


def _plot(drawing: Draw, name: str) -> str:
    return svg(drawing, _PLOT, name)
