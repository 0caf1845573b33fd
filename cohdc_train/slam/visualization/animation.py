"""Animated image of a run: keypoints, dynamic mask, and trajectory side by side."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage

from cohdc_train.drawing import draw_outline, fill_mask
from cohdc_train.errors import DataError
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.overlays import draw_before
from cohdc_train.trajectory.metrics import align_to_truth
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import FloatArray, Image

SUFFIXES = (".webp", ".gif")
_PANEL = (240, 320)  # px, height and width of each of the three panels
_TITLES = ("keypoints: static, dynamic", "dynamic mask", "trajectory from above")
_LABELS = {"baseline": "plain RGB-D SLAM", "estimate": "this run"}
_MARGIN_PX, _LEGEND_PX = 12, 60
_RED, _YELLOW, _BLUE = (230, 40, 40), (255, 220, 0), (31, 119, 180)  # RGB
_GRAY, _BLACK = (150, 150, 150), (30, 30, 30)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True)
class _Panels:
    """Panels of one frame. keypoints, mask: [H, W, 3] RGB."""

    timestamp: float
    keypoints: Image
    mask: Image


class RunAnimation:
    """Observer of a run that keeps every third frame for an animated image."""

    def __init__(self, path: Path, extract: OrbExtractor, every: int = 3) -> None:
        """Set what is kept.

        Args:
            path: animated image to write, .webp or .gif.
            extract: searches keypoints in a whole image.
            every: frames from one shown frame to the next.

        Raises:
            DataError: the suffix is of no animated image.
        """
        if path.suffix.lower() not in SUFFIXES:
            raise DataError(f"{path}: an animation is a file {' or '.join(SUFFIXES)}")
        self._path = path
        self._extract = extract
        self._every = every
        self._num_seen = 0
        self._shown: list[_Panels] = []

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Keep the panels of a frame if it is shown."""
        self._num_seen += 1
        if (self._num_seen - 1) % self._every:
            return
        dynamic = result.union_mask
        found = self._extract(frame.rgb, frame.depth)
        keypoints = draw_before(frame.rgb, found, dynamic)
        self._shown.append(_Panels(frame.timestamp, _resize(keypoints), _draw_mask(frame, result)))

    def write(
        self,
        trajectory: Trajectory,
        truth: Trajectory | None,
        baseline: Trajectory | None = None,
    ) -> None:
        """Write the animated image.

        Args:
            trajectory: final poses of the run.
            truth: ground truth, drawn in gray; the trajectory is aligned to it.
            baseline: another run on the same frames, drawn in red.
        """
        drawing = _TrajectoryPanel(trajectory, truth, baseline)
        images = []
        for shown in self._shown:
            panels = [shown.keypoints, shown.mask, drawing.draw(shown.timestamp)]
            for panel, title in zip(panels, _TITLES, strict=True):
                _write_line(panel, title)
            images.append(PillowImage.fromarray(np.concatenate(panels, axis=1)))
        first, *others = images
        first.save(
            self._path,
            save_all=True,
            append_images=others,
            duration=100,
            loop=0,
            quality=55,
            method=4,
        )


def _write_line(
    panel: Image, text: str, top: int = 0, color: tuple[int, int, int] = _BLACK
) -> None:
    """Write a line on white at the left edge, in place."""
    width = cv2.getTextSize(text, _FONT, 0.45, 1)[0][0] + 10
    cv2.rectangle(panel, (0, top), (width, top + 19), (255, 255, 255), -1)
    cv2.putText(panel, text, (5, top + 14), _FONT, 0.45, color, 1, cv2.LINE_AA)


def _resize(image: Image) -> Image:
    height, width = _PANEL
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8)


def _draw_mask(frame: RGBDFrame, result: FrameResult) -> Image:
    """Draw the dynamic mask in red; a frame without a pose says so."""
    image = frame.rgb.copy()
    mask = result.union_mask
    if mask is not None:
        fill_mask(image, mask, _RED, 0.45)
        draw_outline(image, mask, _YELLOW, thickness=2)
    panel = _resize(image)
    if not result.is_tracked:
        _write_line(panel, "no pose: too little is visible", _PANEL[0] - 20)
    return panel


class _TrajectoryPanel:
    """Camera paths from above, up to a time."""

    def __init__(
        self, trajectory: Trajectory, truth: Trajectory | None, baseline: Trajectory | None
    ) -> None:
        self._truth = truth
        self._paths = [("baseline", baseline, _RED), ("estimate", trajectory, _BLUE)]
        if truth is not None:
            self._paths = [
                (name, path and _align(path, truth), color) for name, path, color in self._paths
            ]
        shown = [truth, *(path for _, path, _ in self._paths)]
        positions = np.concatenate([path.positions[:, :2] for path in shown if path is not None])
        self._center = (positions.min(axis=0) + positions.max(axis=0)) / 2
        extent = np.maximum(positions.max(axis=0) - positions.min(axis=0), 0.1)
        height, width = _PANEL
        sides = np.array([width, height - _LEGEND_PX]) - 2 * _MARGIN_PX
        self._px_per_m = float((sides / extent).min())

    def draw(self, timestamp: float) -> Image:
        """Draw the ground truth and the runs until `timestamp`, s. Returns [H, W, 3] RGB."""
        image: Image = np.full((*_PANEL, 3), 255, np.uint8)
        top = 20
        if self._truth is not None:
            self._draw_path(image, self._truth.positions, _GRAY, 4)
            _write_line(image, "ground truth", top, _GRAY)
            top += 16
        for name, path, color in self._paths:
            if path is None:
                continue
            self._draw_path(image, path.positions[path.timestamps <= timestamp], color, 2)
            _write_line(image, _LABELS[name], top, color)
            top += 16
        return image

    def _draw_path(
        self,
        image: Image,
        positions: FloatArray,
        color: tuple[int, int, int],
        thickness: int,
    ) -> None:
        height, width = _PANEL
        offsets = (positions[:, :2] - self._center) * self._px_per_m
        pixels = np.stack(
            [width / 2 + offsets[:, 0], (height + _LEGEND_PX) / 2 - offsets[:, 1]], axis=1
        )
        points = np.rint(pixels).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [points], False, color, thickness, cv2.LINE_AA)
        if len(points):
            x, y = points[-1, 0].tolist()
            cv2.circle(image, (x, y), thickness + 2, color, -1, cv2.LINE_AA)


def _align(trajectory: Trajectory, truth: Trajectory) -> Trajectory:
    """Align to the ground truth; too few common poses leave the trajectory as it is."""
    try:
        return align_to_truth(truth, trajectory)
    except DataError:
        return trajectory
