"""Trainings drawn: learning curve, losses, learning rates, and AP of every class."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cohdc_train.report.names import score_quantity
from cohdc_train.report.svg import INK, Draw, color, dash, legend, log_scale
from cohdc_train.report.training_run import Series, TrainingRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOSSES: Mapping[str, str] = {
    "loss": "total",
    "class": "class",
    "box": "box",
    "mask": "mask",
    "cqe": "mask quality (CQE)",
    "objectness": "objectness (RPN)",
    "rpn_box": "box (RPN)",
}
_RATES: Mapping[str, str] = {"heads": "heads", "backbone": "backbone"}
_CURVES = ("segm_AP", "segm_AP50", "boundary_AP", "box_AP")
_SMOOTH = 25  # windows of the moving mean in a whole training
_NAME = 22  # letters of a class name in a plot

Placed = Sequence[tuple[int, TrainingRun]]


def draw_learning_curve(runs: Placed) -> Draw:
    """Return a drawing of validation scores over steps: of one run several, of more mask AP."""

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        if len(runs) == 1:
            scores = runs[0][1].part("val/")
            for place, name in enumerate(name for name in _CURVES if name in scores):
                label = score_quantity(name).name
                axes.plot(*scores[name].T, "o-", ms=3.5, color=color(place), label=label)
        for place, run in runs if len(runs) > 1 else ():
            rows = run.part("val/").get("segm_AP", np.zeros((0, 2)))
            axes.plot(*rows.T, dash(place), marker="o", ms=3.5, color=color(place), label=run.label)
        axes.set(xlabel="steps", ylabel="mask AP" if len(runs) > 1 else "score, validation")
        axes.set_ylim(0, max(0.05, 1.08 * axes.dataLim.y1))
        axes.set_xlim(left=0)
        legend(figure, axes)

    return draw


def draw_losses(runs: Placed) -> Draw:
    """Return a drawing of the training losses over steps: of one run its parts, of more the total.

    Pale: as logged; bold: moving mean.
    """

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        if len(runs) == 1:
            losses = runs[0][1].part("train/")
            for place, name in enumerate(name for name in LOSSES if name in losses):
                tint = INK if name == "loss" else color(place - 1)
                _draw_smooth(axes, losses[name], tint, LOSSES[name], 2.2 if name == "loss" else 1.3)
        for place, run in runs if len(runs) > 1 else ():
            rows = run.part("train/").get("loss", np.zeros((0, 2)))
            _draw_smooth(axes, rows, color(place), run.label, 1.6, dash(place))
        axes.set(xlabel="steps", ylabel="training loss")
        log_scale(axes)
        axes.set_xlim(left=0)
        legend(figure, axes)

    return draw


def draw_rates(runs: Placed) -> Draw:
    """Return a drawing of the learning rates over steps; of several runs that of the heads."""

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        for place, run in runs:
            rates = run.part("lr/")
            names = [name for name in _RATES if name in rates][: 1 if len(runs) > 1 else None]
            for number, name in enumerate(names):
                label = run.label if len(runs) > 1 else _RATES[name]
                axes.plot(*rates[name].T, dash(place), color=color(place + number), label=label)
        axes.set(xlabel="steps", ylabel="learning rate")
        axes.set_ylim(bottom=0)
        axes.set_xlim(left=0)
        axes.yaxis.set_major_formatter("{x:g}")
        legend(figure, axes)

    return draw


def draw_classes(scores: Sequence[Mapping[str, float]], names: Sequence[str]) -> Draw:
    """Return a drawing of mask AP of classes as bars, one a run. scores: of each run, by class."""

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        rows = np.arange(len(names))
        height = 0.8 / len(scores)
        for place, of_run in enumerate(scores):
            values = [of_run.get(name, 0.0) for name in names]
            shift = (place - (len(scores) - 1) / 2) * height
            bars = axes.barh(rows + shift, values, 0.92 * height, color=color(place))
            if len(scores) < 3:
                axes.bar_label(bars, [f"{value:.3f}" for value in values], padding=3, fontsize=8)
        axes.set_yticks(rows, [_short(name) for name in names])
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlim(
            0, max(0.05, 1.18 * max((max(s.values(), default=0) for s in scores), default=0))
        )
        axes.set_xlabel("mask AP")
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)

    return draw


def _draw_smooth(
    axes: "Axes", rows: Series, tint: str, label: str, width: float, style: str = "-"
) -> None:
    rows = rows[rows[:, 1] > 0]  # a logarithm has no place for 0
    window = max(1, len(rows) // _SMOOTH)
    kernel = np.ones(window)
    counts = np.convolve(np.ones(len(rows)), kernel, "same")
    means = (
        np.convolve(rows[:, 1], kernel, "same") / np.maximum(counts, 1) if len(rows) else rows[:, 1]
    )
    if window > 1:
        axes.plot(*rows.T, color=tint, alpha=0.25, lw=0.8)
    axes.plot(rows[:, 0], means, style, color=tint, lw=width, label=label)


def _short(name: str) -> str:
    return name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"
