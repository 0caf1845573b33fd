"""A frame's mask as the tracker uses it: as given, without what has stood still, with what depth
finds moving.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.free_space import DepthComparison, FreeSpaceChecker, Reference
from cohdc_train.slam.dynamics.masks import grow
from cohdc_train.slam.dynamics.moving_surfaces import MovingSurfaceTracker
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.types import Mask

_REFERENCES = 8  # keyframes whose depth a frame is held against
_BAND = 8.0  # px: a coarse pixel's width, around what depth finds
_STOOD = 0.5  # s for which a surface must have stood still not to be taken for a part of what moves
_RESTED = 2.0  # s that a masked or moving thing must have stood still to be of use to tracking


class DynamicMaskEstimator:
    """Makes the masks of one frame after the other."""

    def __init__(self, geometry: FreeSpaceChecker) -> None:
        self._geometry = geometry
        self._movers = MovingSurfaceTracker()

    def forget(self) -> None:
        """The place is lost."""
        self._movers.forget()

    def of(
        self,
        mask: Mask | None,
        depth: NDArray[np.float32],
        T_cw: Array,
        around: list[Keyframe],
        t: float,
    ) -> Mask | None:
        """mask, depth: [H, W], depth in m; T_cw: the frame's expected pose; around: keyframes that
        see the same place.

        Returns [H, W] bool, True = dynamic; None where nothing was given and nothing moves.
        """
        around = sorted(around, key=lambda keyframe: keyframe.index)
        judges, older = _spread(around), _spread([k for k in around if k.t <= t - _RESTED])
        all_of_them = list({k.index: k for k in (*judges, *older)}.values())
        row = {k.index: i for i, k in enumerate(all_of_them)}
        comparison = self._geometry.compare(
            depth, T_cw, [Reference(k.T_cw, k.nearest) for k in all_of_them]
        )

        def against(keyframes: list[Keyframe]) -> DepthComparison:
            return comparison.only([row[k.index] for k in keyframes])

        before, long_ago = [k for k in all_of_them if k.t <= t - _STOOD], against(older)
        stood = against(before).still if before else np.ones(comparison.image.shape, dtype=np.bool_)
        found = self._geometry.movers(against(judges))
        masked = np.zeros_like(found) if mask is None else self._geometry.coarse(mask)
        found = self._movers.whole(t, found, stood, long_ago.still, comparison.image, masked)
        moves = grow(self._geometry.fine(found), _BAND)
        if mask is None:
            return moves if moves.any() else None
        if older:
            mask = mask & ~self._geometry.static_components(mask, long_ago)
        return mask | moves


def _spread(keyframes: list[Keyframe]) -> list[Keyframe]:
    """Some of them, evenly."""
    if not keyframes:
        return []
    places = np.unique(np.linspace(0, len(keyframes) - 1, _REFERENCES).round().astype(int))
    return [keyframes[i] for i in places.tolist()]
