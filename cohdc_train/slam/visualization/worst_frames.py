"""Images of the frames in which tracking was weakest, for the report."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import fill_mask, write_jpeg
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.overlays import draw_after

_COUNT = 6
_APART_S = 1.0  # between two of them: a place in which tracking is weak gives one image
_TINT = (230, 40, 40)  # RGB
_TINT_SHARE = 0.35


@dataclass(frozen=True, eq=False)
class _WeakFrame:
    """A frame and what was seen in it. inliers: -1 when the frame was lost."""

    frame: RGBDFrame
    inliers: int
    mask: NDArray[np.bool_] | None
    features: Features | None


class WorstFrames:
    """Observer of a run that keeps the frames that were lost or had the fewest inliers."""

    def __init__(self) -> None:
        """Start without a frame."""
        self._kept: list[_WeakFrame] = []

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Keep the frame if it is among the worst so far."""
        inliers = result.num_inliers if result.is_tracked else -1
        near = [kept for kept in self._kept if self._is_near(kept, frame)]
        if any(kept.inliers <= inliers for kept in near):
            return
        others = [kept for kept in self._kept if kept not in near]
        others.append(_WeakFrame(frame, inliers, result.dynamic_mask, result.features))
        self._kept = sorted(others, key=lambda kept: kept.inliers)[:_COUNT]

    @staticmethod
    def _is_near(kept: _WeakFrame, frame: RGBDFrame) -> bool:
        return abs(kept.frame.timestamp - frame.timestamp) < _APART_S

    def write(self, folder: Path) -> None:
        """Write `<stamp>_worst.jpg` of each: keypoints that were used in green, the mask in red."""
        for kept in self._kept:
            write_jpeg(folder / f"{kept.frame.timestamp_text}_worst.jpg", _draw(kept))


def _draw(kept: _WeakFrame) -> NDArray[np.uint8]:
    image = kept.frame.rgb.copy()
    mask = np.zeros(image.shape[:2], np.bool_) if kept.mask is None else kept.mask
    fill_mask(image, mask, _TINT, _TINT_SHARE)
    return image if kept.features is None else draw_after(image, kept.features, mask)
