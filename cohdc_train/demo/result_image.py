"""The demo's first image: a frame with mask and keypoints, and three trajectories."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cohdc_train.demo.steps import RUNS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    import cv2

    images = sorted((out / "slam" / "masks" / "pictures").glob("*_after.jpg"))
    image = cv2.cvtColor(cv2.imread(str(images[len(images) // 2])), cv2.COLOR_BGR2RGB)
    axes.imshow(image)
    axes.set_title("Dynamic mask of the fine-tuned network, and the keypoints that SLAM keeps")
    axes.axis("off")


def _draw_trajectories(axes: "Axes", out: Path, metrics: dict[str, Any]) -> None:
    """Draw the camera's path from above: ground truth and three estimates, aligned to it."""
    from cohdc_train.trajectory.association import match
    from cohdc_train.trajectory.metrics import align_umeyama
    from cohdc_train.trajectory.trajectory import read_tum

    truth = read_tum(out / "sequence" / "groundtruth.txt")
    path = truth.poses[:, :3, 3]
    axes.plot(path[:, 0], path[:, 1], color="0.4", linewidth=5, alpha=0.35, label="ground truth")
    for name, title in RUNS.items():
        estimate = read_tum(out / "slam" / name / "trajectory.txt")
        pairs = match(truth, estimate)
        aligned = align_umeyama(pairs)
        points = aligned[:, :3, 3]
        error = metrics[name]["ate_m"]["rmse"]
        label = f"{title}: error {100 * error:.1f} cm"
        axes.plot(points[:, 0], points[:, 1], color=COLORS[name], linewidth=1.6, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.grid(alpha=0.25)
    axes.legend(loc="best", frameon=False)
    axes.set_title("Path of the camera from above")
