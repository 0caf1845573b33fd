"""Every tracked frame, by where it lies from a keyframe: keyframes move later on, and take it along."""

from typing import NamedTuple

import numpy as np

from cohdc_train.slam.localization import Fit
from cohdc_train.slam.map import Keyframe, Map
from cohdc_train.slam.optimization import Array, inverse
from cohdc_train.slam.smoothing import smoothed


class _Logged(NamedTuple):
    """t: s; reference: index of the keyframe the frame hangs on; relative: [4, 4] T of the frame in it, m; information,
    pull: as those of `Fit`."""

    t: float
    reference: int
    relative: Array
    information: Array
    pull: Array


class FrameLog:
    """The frames of one run, in their order."""

    def __init__(self) -> None:
        self._frames: list[_Logged] = []

    def append(self, t: float, fit: Fit, reference: Keyframe) -> None:
        """The frame at t, s, after those before it."""
        relative = fit.T_cw @ inverse(reference.T_cw)
        self._frames.append(_Logged(t, reference.index, relative, fit.information, fit.pull))

    def trajectory(self, world: Map, smooth: bool) -> tuple[Array, Array]:
        """Each frame re-derived from its reference keyframe, or that one's heir, as the map has it now.

        Returns stamps [n] s and poses [n, 4, 4] T_wc camera to world, m.
        """
        stamps = np.array([frame.t for frame in self._frames])
        if not self._frames:
            return stamps, np.zeros((0, 4, 4))
        keyframes = {index: world.pose(index) for index in {frame.reference for frame in self._frames}}
        poses = np.stack([frame.relative @ keyframes[frame.reference] for frame in self._frames])
        if smooth:
            information = np.stack([frame.information for frame in self._frames])
            poses = smoothed(stamps, poses, information, np.stack([frame.pull for frame in self._frames]))
        return stamps, inverse(poses)
