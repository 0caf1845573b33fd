"""The demo's first image: a frame with mask and keypoints, and three trajectories."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cohdc_train.demo.steps import RUNS
from cohdc_train.images import read_rgb
from cohdc_train.trajectory.metrics import align_to_truth
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_GAP_S = 0.1  # a longer pause between two poses is left open
_MOST_MASKED = 0.7  # share of the view
COLORS = {"plain": "#c0392b", "geometry": "#d68910", "masks": "#1f77b4"}


def draw_result(out: Path, metrics: dict[str, Any]) -> None:
    """Write result.png.

    Args:
        out: folder of the demo.
        metrics: run -> its metrics.json.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    _draw_frame(left, out)
    _draw_trajectories(right, out, metrics)
    figure.savefig(out / "result.png", dpi=110)


def _draw_frame(axes: "Axes", out: Path) -> None:
    """Show a tracked frame in which the dynamic mask covers much of the view."""
    figures = out / "slam" / "masks" / "pictures"
    with (out / "slam" / "masks" / "frames.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    drawn = [row for row in rows if (figures / f"{row['stamp']}_after.jpg").is_file()]
    if not drawn:
        return
    best = max(drawn, key=_how_telling)
    image = read_rgb(figures / f"{best['stamp']}_after.jpg")
    if image is not None:
        axes.imshow(image)
    axes.set_title("Dynamic mask (yellow) and the keypoints that SLAM keeps", fontsize=11)
    axes.axis("off")


def _how_telling(row: dict[str, str]) -> float:
    """Return the masked share of the view; less where tracking failed or nothing is left."""
    masked = float(row["culled_share"])
    is_useful = int(row["tracked"]) and masked < _MOST_MASKED
    return masked if is_useful else masked - 1.0


def _draw_trajectories(axes: "Axes", out: Path, metrics: dict[str, Any]) -> None:
    """Draw the camera's path from above: ground truth and three estimates, aligned to it."""
    truth = Trajectory.load_tum(out / "sequence" / "groundtruth.txt")
    path = truth.poses[:, :3, 3]
    axes.plot(path[:, 0], path[:, 1], color="0.4", linewidth=5, alpha=0.35, label="ground truth")
    for name, title in RUNS.items():
        estimate = Trajectory.load_tum(out / "slam" / name / "trajectory.txt")
        points = _with_gaps(align_to_truth(truth, estimate))
        error = metrics[name]["ate_m"]["rmse"]
        label = f"{title}: error {100 * error:.1f} cm"
        axes.plot(points[:, 0], points[:, 1], color=COLORS[name], linewidth=1.6, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.grid(alpha=0.25)
    axes.legend(loc="upper left", frameon=False, fontsize=9)
    axes.set_title("Path of the camera from above", fontsize=11)


def _with_gaps(trajectory: Trajectory) -> FloatArray:
    """Return the positions [n, 3] with a row of nan where tracking paused."""
    pauses = np.flatnonzero(np.diff(trajectory.timestamps) > _LONGEST_GAP_S) + 1
    return np.insert(trajectory.positions, pauses, np.nan, axis=0)
