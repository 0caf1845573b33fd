"""Images of the frames in which tracking was weakest, for the report."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import fill_mask, write_jpeg
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.frame import FrameRecord, View
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.slam.visualization.overlays import draw_after

_COUNT = 6
_APART_S = 1.0  # between two of them: a place in which tracking is weak gives one image
_TINT = (230, 40, 40)  # RGB
_TINT_SHARE = 0.35


@dataclass(frozen=True, eq=False)
class _WeakFrame:
    """A frame and what was seen in it. inliers: -1 when the frame was lost."""

    view: View
    inliers: int
    mask: NDArray[np.bool_] | None
    features: Features | None


class WorstFrames:
    """Observer of a run that keeps the frames that were lost or had the fewest inliers."""

    def __init__(self) -> None:
        """Start without a frame."""
        self._kept: list[_WeakFrame] = []

    def __call__(
        self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        """Keep the frame if it is among the worst so far."""
        inliers = record.pose.inliers if record.pose.tracked else -1
        near = [kept for kept in self._kept if abs(kept.view.t - view.t) < _APART_S]
        if any(kept.inliers <= inliers for kept in near):
            return
        others = [kept for kept in self._kept if kept not in near]
        others.append(_WeakFrame(view, inliers, tracker.mask, tracker.features))
        self._kept = sorted(others, key=lambda kept: kept.inliers)[:_COUNT]

    def write(self, folder: Path) -> None:
        """Write `<stamp>_worst.jpg` of each: keypoints that were used in green, the mask in red."""
        for kept in self._kept:
            write_jpeg(folder / f"{kept.view.stamp}_worst.jpg", _draw(kept))


def _draw(frame: _WeakFrame) -> NDArray[np.uint8]:
    image = frame.view.rgb.copy()
    mask = np.zeros(image.shape[:2], np.bool_) if frame.mask is None else frame.mask
    fill_mask(image, mask, _TINT, _TINT_SHARE)
    return image if frame.features is None else draw_after(image, frame.features, mask)
