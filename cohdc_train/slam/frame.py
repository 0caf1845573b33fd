"""What a tracker says of a frame, and when."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from cohdc_train.slam.optimization.pose import Array, inverse
from cohdc_train.slam.tracking.localizer import Fit


@dataclass(frozen=True)
class Pose:
    """What became of one frame. t: s; T_wc: [4, 4] camera to world, m, None when the place is lost; track_ms: until it
    was known; map_ms: of the work after that."""

    t: float
    T_wc: Array | None
    keyframe: bool
    inliers: int
    track_ms: float
    map_ms: float

    @property
    def tracked(self) -> bool:
        """Whether the frame has a pose."""
        return self.T_wc is not None


OnPose = Callable[[Pose], None]


class Answer:
    """A frame's pose from when it is known, and the time that took from the answer's making on."""

    def __init__(self, t: float, on_pose: OnPose | None) -> None:
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
