"""Plots of a validation as PNG files: precision-recall, calibration, confusion."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train.metrics.average_precision import IOUS, RECALLS, category_names, mean_valid
from cohdc_train.metrics.coco_metrics import Results
from cohdc_train.metrics.mask_overlap import MATCH_IOU, MIN_SCORE, quality_pairs
from cohdc_train.train.png_figure import new_figure, short_name, to_png

PR_IOUS = (0.5, 0.75)
_MAX_CURVES = 10  # classes with a curve of their own; of more, the mean only
_MAX_CELLS = 30  # classes in a confusion matrix; of more, those with the most mistakes
_MAX_ANNOTATED = 6  # classes up to which each cell shows its share too
_NUM_BINS = 10


def class_names(truth: Mapping[str, Any]) -> list[str]:
    """Return the names of a COCO dict's categories by id, cut to what a plot has room for."""
    return [short_name(name) for name in category_names(truth)]


def plot_precision_recall(results: Results) -> bytes:
    """Plot COCO's precision of masks against recall at IoU .5 and .75, as mask AP ranks them.

    There is a curve for each class that has objects, of at most ten, and one of their mean.
    """
    figure = new_figure(12, 6)
    names = class_names(results.truth)
    valid = [i for i in range(len(names)) if results.precision[0, 0, i] > -1]
    for axes, iou in zip(figure.subplots(1, 2, sharey=True), PR_IOUS, strict=True):
        table = results.precision[int(np.argmin(np.abs(IOUS - iou)))]
        _plot_pr_curves(axes, table, valid, names)
        axes.set(
            title=f"masks, IoU ≥ {iou:g}" if valid else "no objects",
            xlabel="recall: share of the objects found",
            xlim=(0, 1),
            ylim=(-0.02, 1.02),
        )
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("precision, the best at this recall or higher")
    return to_png(figure)


def plot_calibration(results: Results) -> bytes:
    """Plot predicted quality against true mask IoU of the detections that `calibration` counts."""
    quality, true_iou = quality_pairs(results.truth, results.rows).T
    figure = new_figure(6.4, 6.4)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], "k--", linewidth=1, label="quality is the IoU")
    axes.scatter(quality, true_iou, s=14, alpha=0.4, linewidths=0, label="a detection")
    _plot_bin_means(axes, quality, true_iou)
    spearman, error = (_number(results.scores[f"quality_{name}"]) for name in ("spearman", "error"))
    axes.set_title(
        f"{len(quality)} detections of class score ≥ {MIN_SCORE:g}\n"
        f"Spearman {spearman}, mean error {error}"
    )
    axes.set(
        xlabel="predicted quality",
        ylabel="true mask IoU with the object it fits best",
        aspect="equal",
        xlim=(-0.02, 1.02),
        ylim=(-0.02, 1.02),
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, fontsize=9, frameon=False)
    return to_png(figure)


def plot_confusion(counts: NDArray[np.int64], names: Sequence[str]) -> bytes:
    """Plot a confusion matrix.

    Args:
        counts: [C + 1, C + 1] as `matching.confusion_matrix` returns them.
        names: of the C classes, see `class_names`.
    """
    num_classes = len(names)
    mistakes = counts.sum(axis=0)[:-1] + counts.sum(axis=1)[:-1] - 2 * np.diag(counts)[:-1]
    shown = sorted(np.argsort(-mistakes, kind="stable")[:_MAX_CELLS])
    cells = [*shown, num_classes]
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)

    side = 3.2 + 0.55 * len(cells)
    figure = new_figure(side + 0.6, side)
    axes = figure.subplots()
    _plot_cells(axes, counts[np.ix_(cells, cells)], shares[np.ix_(cells, cells)], num_classes)
    labels = [names[i] for i in shown]
    positions = range(len(cells))
    axes.set_xticks(
        positions, [*labels, "(missed)"], rotation=45, ha="right", rotation_mode="anchor"
    )
    axes.set_yticks(positions, [*labels, "(no object)"])
    axes.set(xlabel="predicted class", ylabel="true class")
    title = (
        f"class score ≥ {MIN_SCORE:g}, mask IoU ≥ {MATCH_IOU:g}\n"
        "blue right, red wrong; color: share of the row"
    )
    if len(shown) < num_classes:
        title += f"\nthe {len(shown)} of {num_classes} classes with the most mistakes"
    axes.set_title(title, fontsize=10)
    return to_png(figure)


def _plot_pr_curves(
    axes: Any, table: NDArray[np.float64], valid: Sequence[int], names: Sequence[str]
) -> None:
    """Plot precision [RECALLS, C] of the valid classes, and their mean."""
    if not valid:
        return
    if 1 < len(valid) <= _MAX_CURVES:
        for i in valid:
            label = f"AP {mean_valid(table[:, i]):.2f}  {names[i]}"
            axes.plot(RECALLS, table[:, i], linewidth=1, label=label)
    what = names[valid[0]] if len(valid) == 1 else f"mean of {len(valid)} classes"
    label = f"AP {mean_valid(table[:, valid]):.2f}  {what}"
    axes.plot(RECALLS, table[:, valid].mean(axis=1), "k", linewidth=2.5, label=label)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, fontsize=9, frameon=False)


def _plot_bin_means(axes: Any, quality: NDArray[np.float64], true_iou: NDArray[np.float64]) -> None:
    """Plot mean quality and IoU of each tenth of the quality, with the number of detections."""
    bins = np.minimum((quality * _NUM_BINS).astype(int), _NUM_BINS - 1)
    used, counts = np.unique(bins, return_counts=True)
    pairs = [(quality[bins == b].mean(), true_iou[bins == b].mean()) for b in used]
    means = np.array(pairs).reshape(-1, 2)
    label = f"mean per {1 / _NUM_BINS:g} of quality (their number)"
    axes.plot(*means.T, "o-", color="C3", linewidth=2, label=label)
    style = {"textcoords": "offset points", "ha": "center", "color": "C3", "fontweight": "bold"}
    for (x, y), count in zip(means, counts, strict=True):
        axes.annotate(str(count), (x, y), (0, 8), **style)


def _plot_cells(
    axes: Any, counts: NDArray[np.int64], shares: NDArray[np.float64], num_classes: int
) -> None:
    """Color the cells by their share of the row, and write the counts."""
    from matplotlib import colormaps

    last = len(counts) - 1
    is_wrong = ~np.eye(len(counts), dtype=np.bool_)[..., None]
    axes.imshow(
        np.where(is_wrong, colormaps["Reds"](0.9 * shares), colormaps["Blues"](0.9 * shares))
    )
    is_small = num_classes <= _MAX_ANNOTATED
    for (i, j), count in np.ndenumerate(counts):
        if (i, j) == (last, last) or not (count or is_small):
            continue
        text = f"{count}"
        if is_small and i < last:
            text += f"\n{100 * shares[i, j]:.0f} %"
        color = "white" if shares[i, j] > 0.5 else "black"
        axes.text(j, i, text, ha="center", va="center", color=color, fontsize=9)


def _number(value: float) -> str:
    return "undefined" if np.isnan(value) else f"{value:.3f}"
