"""A SLAM run's trajectory and errors, drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#c0392b", "#1f77b4", "#2ca02c", "#9467bd", "#8c564b")  # of the runs, in their order
_LOST_AFTER_S = 0.5  # a longer pause between two poses is left open in a plot


@dataclass(frozen=True)
class Run:
    """One SLAM run.

    truth, estimate: matched poses, the estimate aligned to the truth; None when too few matched.
    Without ground truth the estimate stands as it is.
    """

    label: str
    folder: Path
    metrics: dict[str, Any]
    truth: Trajectory | None
    estimate: Trajectory | None


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _opened(trajectory: Trajectory) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Stamps [n] and positions [n, 3] with a row of nan wherever tracking paused, so that no line
    is drawn there.
    """
    pauses = np.flatnonzero(np.diff(trajectory.timestamps) > _LOST_AFTER_S) + 1
    stamps = np.insert(trajectory.timestamps, pauses, np.nan)
    return stamps, np.insert(trajectory.positions, pauses, np.nan, axis=0)


def _lines(truth: Trajectory | None, runs: Sequence[Run]) -> list[tuple[str, Trajectory, str]]:
    rows = [] if truth is None else [("ground truth", truth, "black")]
    for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
        if run.estimate is not None:
            rows.append((run.label, run.estimate, colour))
    return rows


def plot_paths(truth: Trajectory | None, runs: Sequence[Run]) -> "Figure":
    """Positions of ground truth and runs from above (x, y) and from the side (x, z), m."""
    figure = _figure(11, 5)
    for axes, (i, j) in zip(figure.subplots(1, 2), [(0, 1), (0, 2)], strict=True):
        for label, trajectory, colour in _lines(truth, runs):
            positions = _opened(trajectory)[1]
            axes.plot(positions[:, i], positions[:, j], color=colour, linewidth=1.2, label=label)
        axes.set_xlabel(f"{'xyz'[i]} [m]")
        axes.set_ylabel(f"{'xyz'[j]} [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    axes.legend()
    return figure


def plot_over_time(truth: Trajectory | None, runs: Sequence[Run]) -> "Figure":
    """x, y and z, m, over s since the first pose."""
    figure = _figure(11, 6)
    start = _lines(truth, runs)[0][1].timestamps[0]
    rows = figure.subplots(3, 1, sharex=True)
    for k, axes in enumerate(rows):
        for label, trajectory, colour in _lines(truth, runs):
            stamps, positions = _opened(trajectory)
            axes.plot(stamps - start, positions[:, k], color=colour, linewidth=1.2, label=label)
        axes.set_ylabel(f"{'xyz'[k]} [m]")
        axes.grid(alpha=0.3)
    rows[0].legend(ncols=len(runs) + 1)
    rows[-1].set_xlabel("time [s]")
    return figure


def plot_errors(truth: Trajectory, runs: Sequence[Run]) -> "Figure":
    """Distance to the ground truth of every matched pose, m, over s since its first."""
    figure = _figure(11, 4)
    axes = figure.subplots()
    for run, colour in zip(runs, _COLOURS * len(runs), strict=False):
        if run.truth is None or run.estimate is None:
            continue
        errors = np.linalg.norm(run.estimate.positions - run.truth.positions, axis=1)
        label = f"{run.label}: rmse {np.sqrt(np.mean(errors**2)):.4f} m"
        axes.plot(
            run.truth.timestamps - truth.timestamps[0],
            np.maximum(errors, 1e-5),
            ".-",
            color=colour,
            ms=3,
            label=label,
        )
    axes.set_yscale("log")  # a run with masks and one without differ by more than ten
    axes.set_xlabel("time [s]")
    axes.set_ylabel("error [m]")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure
