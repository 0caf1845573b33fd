"""Report of a frame's pose as soon as it is known."""

import time

from cohdc_train.slam.frame import Pose, PoseCallback
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.tracking.localizer import Fit


class PoseReporter:
    """A frame's pose from when it is known, and the time that took from the answer's making on."""

    def __init__(self, t: float, on_pose: PoseCallback | None) -> None:
        self._t, self._on_pose = t, on_pose
        self._start = time.perf_counter()
        self._known: float | None = None

    def give(self, fit: Fit | None) -> None:
        """The first one counts, and is told."""
        if self._known is not None:
            return
        self._known = time.perf_counter()
        if self._on_pose is not None:
            self._on_pose(self.pose(fit, keyframe=False))

    def pose(self, fit: Fit | None, keyframe: bool) -> Pose:
        """What became of the frame so far. fit: None when the place is lost."""
        assert self._known is not None
        T_wc, inliers = (None, 0) if fit is None else (inverse(fit.T_cw), len(fit.matches))
        rest = time.perf_counter() - self._known
        return Pose(self._t, T_wc, keyframe, inliers, 1e3 * (self._known - self._start), 1e3 * rest)
