"""A validation's numbers and a training's log as PNG files (matplotlib, without pyplot's global
state).
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train.metrics.coco_metrics import (
    CERTAIN,
    IOUS,
    MATCH_IOU,
    RECALLS,
    Results,
    category_names,
    mean_valid,
    quality_pairs,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PR_IOUS = (0.5, 0.75)
_CURVES = 10  # classes with a curve of their own; of more, the mean only
_CELLS = 30  # classes in a confusion matrix; of more, those with the most mistakes
_NAME = 20  # letters of a class name
_BINS = 10
_KINDS = {"segm": ("mask", "C0"), "boundary": ("boundary", "C1"), "box": ("box", "C2")}
_STYLES = {"AP": ("AP", "-"), "AP50": ("AP50", "--"), "AP70": ("AP70", ":")}


def class_names(truth: Mapping[str, Any]) -> list[str]:
    """Names of a COCO dict's categories by id, cut to what a plot has room for; a dollar starts no
    formula.
    """
    return [_short(name) for name in category_names(truth)]


def _short(name: str) -> str:
    return (name if len(name) <= _NAME else name[: _NAME - 1] + "…").replace("$", r"\$")


def plot_precision_recall(results: Results) -> bytes:
    """COCO's precision against recall of masks at IoU .5 and .75: every class that has objects, at
    most ten, and their mean, as mask AP ranks them."""
    figure = _figure(12, 6)
    names = class_names(results.truth)
    valid = [i for i in range(len(names)) if results.precision[0, 0, i] > -1]
    for axes, iou in zip(figure.subplots(1, 2, sharey=True), PR_IOUS, strict=True):
        table = results.precision[int(np.argmin(np.abs(IOUS - iou)))]
        for i in valid if 1 < len(valid) <= _CURVES else []:
            axes.plot(
                RECALLS,
                table[:, i],
                linewidth=1,
                label=f"AP {mean_valid(table[:, i]):.2f}  {names[i]}",
            )
        if valid:
            who = names[valid[0]] if len(valid) == 1 else f"mean of {len(valid)} classes"
            mean = table[:, valid].mean(axis=1)
            axes.plot(
                RECALLS,
                mean,
                "k",
                linewidth=2.5,
                label=f"AP {mean_valid(table[:, valid]):.2f}  {who}",
            )
            axes.legend(
                loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, fontsize=9, frameon=False
            )
        title = f"masks, IoU ≥ {iou:g}" if valid else "no objects"
        axes.set(
            title=title,
            xlabel="recall: share of the objects found",
            xlim=(0, 1),
            ylim=(-0.02, 1.02),
        )
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("precision, the best at this recall or higher")
    return _png(figure)


def plot_calibration(results: Results) -> bytes:
    """Predicted quality against true mask IoU of every detection that `metrics.calibration` counts,
    and its numbers.
    """
    quality, true = quality_pairs(results.truth, results.rows).T
    figure = _figure(6.4, 6.4)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], "k--", linewidth=1, label="quality is the IoU")
    axes.scatter(quality, true, s=14, alpha=0.4, linewidths=0, label="a detection")
    bins = np.minimum((quality * _BINS).astype(int), _BINS - 1)
    means = np.array(
        [(quality[bins == b].mean(), true[bins == b].mean()) for b in np.unique(bins)]
    ).reshape(-1, 2)
    axes.plot(
        *means.T,
        "o-",
        color="C3",
        linewidth=2,
        label=f"mean per {1 / _BINS:g} of quality (their number)",
    )
    for (x, y), count in zip(means, np.unique(bins, return_counts=True)[1], strict=True):
        axes.annotate(
            str(count),
            (x, y),
            (0, 8),
            textcoords="offset points",
            ha="center",
            color="C3",
            fontweight="bold",
        )
    spearman, error = (results.scores[f"quality_{name}"] for name in ("spearman", "error"))
    title = f"{len(quality)} detections of class score ≥ {CERTAIN:g}\n"
    axes.set_title(title + f"Spearman {_number(spearman)}, mean error {_number(error)}")
    axes.set(
        xlabel="predicted quality",
        ylabel="true mask IoU with the object it fits best",
        aspect="equal",
    )
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=9, frameon=False)
    return _png(figure)


def plot_confusion(counts: NDArray[np.int64], names: Sequence[str]) -> bytes:
    """A confusion matrix as `matching.confusion_matrix` counts it. names: of the C classes, see
    `class_names`.
    """
    from matplotlib import colormaps

    classes = len(names)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    mistakes = counts.sum(axis=0)[:-1] + counts.sum(axis=1)[:-1] - 2 * np.diag(counts)[:-1]
    shown = sorted(np.argsort(-mistakes, kind="stable")[:_CELLS])
    cells = [*shown, classes]
    counts, share = counts[np.ix_(cells, cells)], share[np.ix_(cells, cells)]
    side = 3.2 + 0.55 * len(cells)
    figure = _figure(side + 0.6, side)
    axes = figure.subplots()
    wrong = ~np.eye(len(cells), dtype=np.bool_)
    axes.imshow(
        np.where(wrong[..., None], colormaps["Reds"](0.9 * share), colormaps["Blues"](0.9 * share))
    )
    for (i, j), count in np.ndenumerate(counts):
        if (i, j) != (len(shown), len(shown)) and (count or classes < 7):
            text = (
                f"{count}\n{100 * share[i, j]:.0f} %"
                if classes < 7 and i < len(shown)
                else f"{count}"
            )
            axes.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                color="white" if share[i, j] > 0.5 else "black",
                fontsize=9,
            )
    labels = [names[i] for i in shown]
    axes.set_xticks(
        range(len(cells)), [*labels, "(missed)"], rotation=45, ha="right", rotation_mode="anchor"
    )
    axes.set_yticks(range(len(cells)), [*labels, "(no object)"])
    axes.set(xlabel="predicted class", ylabel="true class")
    title = f"class score ≥ {CERTAIN:g}, mask IoU ≥ {MATCH_IOU:g}\nblue right, red wrong; colour: share of the row"
    fewer = (
        f"\nthe {len(shown)} of {classes} classes with the most mistakes"
        if len(shown) < classes
        else ""
    )
    axes.set_title(title + fewer, fontsize=10)
    return _png(figure)


def plot_log(log: Path) -> bytes:
    """Training losses, per logged step and as each epoch's mean, and validation scores over epochs,
    from Lightning's metrics.csv. A resumed training's file holds what came after."""
    series = _read_log(log)
    scores = _chosen(series, "val/")
    classes = _chosen(scores, "segm_AP/")
    rest = {name: points for name, points in scores.items() if not name.startswith("segm_AP/")}
    figure = _figure(14, 8.5) if classes else _figure(20, 4.8)
    axes = figure.subplots(2, 2).ravel() if classes else figure.subplots(1, 3)
    _plot_losses(axes[0], _chosen(series, "train/"))
    for prefix, (kind, colour) in _KINDS.items():
        for suffix, (which, style) in _STYLES.items():
            points = rest.pop(f"{prefix}_{suffix}", np.zeros((0, 2)))
            axes[1].plot(
                *points.T, style, color=colour, marker="o", markersize=3, label=f"{kind} {which}"
            )
    for name, points in rest.items():
        axes[2].plot(*points.T, "o-", markersize=3, label=name)
    for name, points in sorted(classes.items(), key=lambda item: -item[1][-1, 1])[: 2 * _CURVES]:
        axes[3].plot(*points.T, "o-", markersize=3, label=f"{points[-1, 1]:.2f} {_short(name)}")
    titles = ("COCO AP", "overlaps and quality", "mask AP per class")
    end = max((points[-1, 0] for points in series.values()), default=1.0)
    for k, panel in enumerate(axes):
        title = (
            f"validation: {titles[k - 1]}"
            if k
            else "training losses (pale: steps, bold: epoch's mean)"
        )
        if not panel.lines:
            title += "\nnone in the log" + (
                "" if k else ", which has every trainer.log_every_n_steps-th step"
            )
        panel.set(
            title=title, xlabel="epochs", ylabel="score" if k else "loss", xlim=(0, 1.02 * end)
        )
        panel.grid(alpha=0.3, which="both")
        panel.xaxis.get_major_locator().set_params(integer=True)
        if k and np.isfinite(panel.dataLim.height):
            low, high = min(0.0, panel.dataLim.y0), max(0.1, panel.dataLim.y1)
            panel.set_ylim(low - 0.03 * (high - low), high + 0.03 * (high - low))
        if panel.lines:
            panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9, frameon=False)
    return _png(figure)


def _plot_losses(axes: Any, losses: Mapping[str, NDArray[np.float64]]) -> None:
    lowest = np.inf
    for k, (name, points) in enumerate(losses.items()):
        epochs = np.ceil(points[:, 0] - 1e-9)
        means = np.array(
            [points[epochs == epoch].mean(axis=0) for epoch in np.unique(epochs)]
        ).reshape(-1, 2)
        means, points = (
            values[values[:, 1] > 0] for values in (means, points)
        )  # a logarithm has no place for 0
        axes.plot(*points.T, color=f"C{k}", alpha=0.25, linewidth=1)
        axes.plot(
            *means.T,
            "o-",
            color=f"C{k}",
            markersize=3,
            linewidth=3 if name == "loss" else 1.5,
            label=name,
        )
        lowest = min(lowest, means[:, 1].min(initial=np.inf))
    if np.isfinite(lowest):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.3 * lowest)


def _chosen(
    series: Mapping[str, NDArray[np.float64]], prefix: str
) -> dict[str, NDArray[np.float64]]:
    return {
        name.removeprefix(prefix): points
        for name, points in series.items()
        if name.startswith(prefix)
    }


def _read_log(path: Path) -> dict[str, NDArray[np.float64]]:
    """Column -> [n, 2] of epochs gone by and value, nan left out.

    An epoch's steps are not in the file; they are taken from the step that got furthest in its
    epoch.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row.get("epoch") and row.get("step")]
    ends = [(float(row["step"]) + 1, float(row["epoch"]) + 1) for row in rows]
    per_epoch = max((step / epoch for step, epoch in ends), default=1.0)
    series = {}
    for name in rows[0] if rows else ():
        cells = [
            (step / per_epoch, float(row[name] or "nan"))
            for (step, _), row in zip(ends, rows, strict=True)
        ]
        points = np.array(cells)
        points = points[np.isfinite(points[:, 1])]
        if len(points):
            series[name] = points
    return series


def _number(value: float) -> str:
    return "undefined" if np.isnan(value) else f"{value:.3f}"


def plot_lr_find(rates: Sequence[float], losses: Sequence[float], suggestion: float) -> bytes:
    """Plot the loss over the learning rate of a range test, and the rate that it suggests."""
    figure = _figure(8, 5)
    axes = figure.subplots()
    axes.plot(rates, losses, label="loss, smoothed")
    axes.axvline(suggestion, color="C3", linestyle="--", label=f"suggested {suggestion:.1e}")
    axes.set(xscale="log", xlabel="learning rate", ylabel="training loss")
    axes.legend()
    axes.grid(alpha=0.3)
    return _png(figure)


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _png(figure: "Figure") -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
