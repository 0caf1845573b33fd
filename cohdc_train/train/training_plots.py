"""Plots of a training's log and of a learning-rate range test, as PNG files."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train.train.png_figure import new_figure, short_name, to_png

Series = NDArray[np.float64]  # [n, 2]: epochs since the start, value

_MAX_CLASSES = 20  # with a curve of their own
_IOU_TYPES = {"segm": ("mask", "C0"), "boundary": ("boundary", "C1"), "box": ("box", "C2")}
_STYLES = {"AP": "-", "AP50": "--", "AP70": ":"}
_LEGEND = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5), "fontsize": 9, "frameon": False}


def plot_log(log: Path) -> bytes:
    """Plot training losses and validation scores over epochs, from Lightning's metrics.csv.

    Losses are drawn per logged step and as each epoch's mean. The file of a resumed training holds
    only what came after.
    """
    series = _read_log(log)
    scores = _with_prefix(series, "val/")
    class_scores = _with_prefix(scores, "segm_AP/")
    others = {name: points for name, points in scores.items() if not name.startswith("segm_AP/")}
    figure = new_figure(14, 8.5) if class_scores else new_figure(20, 4.8)
    panels = figure.subplots(2, 2).ravel() if class_scores else figure.subplots(1, 3)

    _plot_losses(panels[0], _with_prefix(series, "train/"))
    _plot_average_precision(panels[1], others)
    for name, points in others.items():
        if name.partition("_")[0] not in _IOU_TYPES:
            panels[2].plot(*points.T, "o-", markersize=3, label=name)
    if class_scores:
        _plot_classes(panels[3], class_scores)

    last_epoch = max((points[-1, 0] for points in series.values()), default=1.0)
    losses = "training losses (pale: steps, bold: epoch's mean)"
    empty = "none in the log, which has every trainer.log_every_n_steps-th step"
    _finish(panels[0], losses, "loss", last_epoch, empty)
    for panel, title in zip(
        panels[1:], ("COCO AP", "overlaps and quality", "mask AP per class"), strict=False
    ):
        _finish(panel, f"validation: {title}", "score", last_epoch, "none in the log")
        _fit_scores(panel)
    return to_png(figure)


def plot_lr_find(rates: Sequence[float], losses: Sequence[float], suggestion: float) -> bytes:
    """Plot the loss over the learning rate of a range test, and the rate that it suggests."""
    figure = new_figure(8, 5)
    axes = figure.subplots()
    axes.plot(rates, losses, label="loss, smoothed")
    axes.axvline(suggestion, color="C3", linestyle="--", label=f"suggested {suggestion:.1e}")
    axes.set(xscale="log", xlabel="learning rate", ylabel="training loss")
    axes.legend()
    axes.grid(alpha=0.3)
    return to_png(figure)


def _plot_losses(axes: Any, losses: Mapping[str, Series]) -> None:
    """Plot each loss on a logarithmic axis, which has no place for 0."""
    lowest = np.inf
    for k, (name, points) in enumerate(losses.items()):
        means = _epoch_means(points)
        means, points = means[means[:, 1] > 0], points[points[:, 1] > 0]
        width = 3 if name == "loss" else 1.5
        axes.plot(*points.T, color=f"C{k}", alpha=0.25, linewidth=1)
        axes.plot(*means.T, "o-", color=f"C{k}", markersize=3, linewidth=width, label=name)
        lowest = min(lowest, means[:, 1].min(initial=np.inf))
    if np.isfinite(lowest):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.3 * lowest)


def _epoch_means(points: Series) -> Series:
    """Return the mean of each epoch."""
    epochs = np.ceil(points[:, 0] - 1e-9)
    means = [points[epochs == epoch].mean(axis=0) for epoch in np.unique(epochs)]
    return np.array(means).reshape(-1, 2)


def _plot_average_precision(axes: Any, scores: Mapping[str, Series]) -> None:
    """Plot AP, AP50 and AP70 of masks, boundaries and boxes."""
    for prefix, (iou_type, color) in _IOU_TYPES.items():
        for suffix, style in _STYLES.items():
            points = scores.get(f"{prefix}_{suffix}", np.zeros((0, 2)))
            label = f"{iou_type} {suffix}"
            axes.plot(*points.T, style, color=color, marker="o", markersize=3, label=label)


def _plot_classes(axes: Any, scores: Mapping[str, Series]) -> None:
    """Plot mask AP of the classes with the best last value."""
    best_first = sorted(scores.items(), key=lambda item: -item[1][-1, 1])
    for name, points in best_first[:_MAX_CLASSES]:
        label = f"{points[-1, 1]:.2f} {short_name(name)}"
        axes.plot(*points.T, "o-", markersize=3, label=label)


def _finish(axes: Any, title: str, ylabel: str, last_epoch: float, empty: str) -> None:
    """Set title, labels, limits, grid and legend; empty: second line of the title without lines."""
    if not axes.lines:
        title += f"\n{empty}"
    axes.set(title=title, xlabel="epochs", ylabel=ylabel, xlim=(0, 1.02 * last_epoch))
    axes.grid(alpha=0.3, which="both")
    axes.xaxis.get_major_locator().set_params(integer=True)
    if axes.lines:
        axes.legend(**_LEGEND)


def _fit_scores(axes: Any) -> None:
    """Fit the y axis to the scores, with 0 and 0.1 inside."""
    if not np.isfinite(axes.dataLim.height):
        return
    low, high = min(0.0, axes.dataLim.y0), max(0.1, axes.dataLim.y1)
    margin = 0.03 * (high - low)
    axes.set_ylim(low - margin, high + margin)


def _with_prefix(series: Mapping[str, Series], prefix: str) -> dict[str, Series]:
    """Return the series whose name starts with a prefix, without it."""
    return {
        name.removeprefix(prefix): points
        for name, points in series.items()
        if name.startswith(prefix)
    }


def _read_log(path: Path) -> dict[str, Series]:
    """Read the columns of metrics.csv; nan is dropped.

    An epoch's steps are not in the file; they are taken from the step that got furthest in its
    epoch.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row.get("epoch") and row.get("step")]
    if not rows:
        return {}
    steps = np.array([float(row["step"]) + 1 for row in rows])
    epochs = np.array([float(row["epoch"]) + 1 for row in rows])
    steps_per_epoch = (steps / epochs).max()
    series = {}
    for name in rows[0]:
        values = np.array([float(row[name] or "nan") for row in rows])
        is_known = np.isfinite(values)
        if is_known.any():
            series[name] = np.stack([steps, values], axis=1)[is_known]
            series[name][:, 0] /= steps_per_epoch
    return series
