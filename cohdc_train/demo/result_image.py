"""The demo's first image: a frame with mask and keypoints, and three trajectories."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cohdc_train.demo.steps import RUNS
from cohdc_train.images import read_rgb
from cohdc_train.trajectory.association import match
from cohdc_train.trajectory.metrics import align_umeyama
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_GAP_S = 0.1  # a longer pause between two poses is left open
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
    """Show the stored frame in which the dynamic mask covers most."""
    images = sorted((out / "slam" / "masks" / "pictures").glob("*_after.jpg"))
    image = read_rgb(images[len(images) // 2])
    if image is not None:
        axes.imshow(image)
    axes.set_title("Dynamic mask of the fine-tuned network, and the keypoints that SLAM keeps")
    axes.axis("off")


def _draw_trajectories(axes: "Axes", out: Path, metrics: dict[str, Any]) -> None:
    """Draw the camera's path from above: ground truth and three estimates, aligned to it."""
    truth = Trajectory.load_tum(out / "sequence" / "groundtruth.txt")
    path = truth.poses[:, :3, 3]
    axes.plot(path[:, 0], path[:, 1], color="0.4", linewidth=5, alpha=0.35, label="ground truth")
    for name, title in RUNS.items():
        estimate = Trajectory.load_tum(out / "slam" / name / "trajectory.txt")
        matched_truth, matched = match(truth, estimate)
        T = align_umeyama(matched.positions, matched_truth.positions)
        points = _with_gaps(estimate.transformed(T))
        error = metrics[name]["ate_m"]["rmse"]
        label = f"{title}: error {100 * error:.1f} cm"
        axes.plot(points[:, 0], points[:, 1], color=COLORS[name], linewidth=1.6, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.grid(alpha=0.25)
    axes.legend(loc="best", frameon=False)
    axes.set_title("Path of the camera from above")


def _with_gaps(trajectory: Trajectory) -> FloatArray:
    """Return the positions [n, 3] with a row of nan where tracking paused."""
    pauses = np.flatnonzero(np.diff(trajectory.timestamps) > _LONGEST_GAP_S) + 1
    return np.insert(trajectory.positions, pauses, np.nan, axis=0)
