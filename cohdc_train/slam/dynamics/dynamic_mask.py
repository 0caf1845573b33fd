"""Dynamic mask of a frame: the given mask, minus static objects, plus motion found by depth."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.dynamics.free_space import DepthComparison, FreeSpaceChecker, ReferenceDepth
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.dynamics.moving_surfaces import MovingSurfaceTracker, SurfaceEvidence
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.types import Mask


class DynamicMaskEstimator:
    """Estimator of the dynamic masks of consecutive frames."""

    def __init__(self, checker: FreeSpaceChecker) -> None:
        """Start without moving surfaces. checker: compares depth for the camera of the frames."""
        self._checker = checker
        self._config = checker.config
        self._surfaces = MovingSurfaceTracker(checker.surfaces)

    def reset(self) -> None:
        """Forget all moving surfaces, as after a loss of tracking."""
        self._surfaces.reset()

    def estimate(
        self,
        mask: Mask | None,
        depth: NDArray[np.float32],
        T_cw: Array,
        neighbors: list[Keyframe],
        timestamp: float,
    ) -> Mask | None:
        """Combine the mask of a frame with what the depth of keyframes tells.

        Args:
            mask: [H, W] bool as the segmenter gives it, True = dynamic; None without a segmenter.
            depth: [H, W] m, 0 = no reading.
            T_cw: [4, 4] predicted pose of the frame.
            neighbors: keyframes that observe the same place.
            timestamp: of the frame, s.

        Returns:
            [H, W] bool, True = dynamic; None where no mask was given and nothing moves.
        """
        config = self._config
        neighbors = sorted(neighbors, key=lambda keyframe: keyframe.index)
        current = _select_evenly(neighbors, config.reference_keyframes)
        old = [k for k in neighbors if k.timestamp <= timestamp - config.rest_s]
        old = _select_evenly(old, config.reference_keyframes)
        comparison = _Comparisons(self._checker, depth, T_cw, [*current, *old])
        with_old = comparison.with_keyframes(old)

        moving_cells = self._update_surfaces(mask, comparison, current, with_old, timestamp)
        moving = dilate_mask(self._checker.upsample(moving_cells), config.mask_margin_px)
        if mask is None:
            return moving if moving.any() else None
        if old:
            mask = mask & ~self._checker.static_components(mask, with_old)
        return mask | moving

    def _update_surfaces(
        self,
        mask: Mask | None,
        comparison: "_Comparisons",
        current: list[Keyframe],
        with_old: DepthComparison,
        timestamp: float,
    ) -> NDArray[np.bool_]:
        """Return the cells [h, w] that move, extended to whole surfaces."""
        depth = comparison.depth
        recent = [
            k for k in comparison.keyframes if k.timestamp <= timestamp - self._config.recent_s
        ]
        moving = self._checker.find_moving(comparison.with_keyframes(current))
        masked = np.zeros_like(moving) if mask is None else self._checker.downsample(mask)
        # Without a keyframe of that age all cells count as static, so no surface is extended.
        everywhere = np.ones(depth.shape, dtype=np.bool_)
        static_recently = comparison.with_keyframes(recent).static if recent else everywhere
        evidence = SurfaceEvidence(depth, moving, static_recently, with_old.static, masked)
        return self._surfaces.update(timestamp, evidence)


class _Comparisons:
    """Depth of one frame compared once with several keyframes, of which subsets can be taken.

    depth: [h, w] m, downsampled; keyframes: without repetition.
    """

    def __init__(
        self,
        checker: FreeSpaceChecker,
        depth: NDArray[np.float32],
        T_cw: Array,
        keyframes: list[Keyframe],
    ) -> None:
        self.keyframes = list({keyframe.index: keyframe for keyframe in keyframes}.values())
        self._row = {keyframe.index: row for row, keyframe in enumerate(self.keyframes)}
        references = [ReferenceDepth(k.T_cw, k.min_depth_grid) for k in self.keyframes]
        self._all = checker.compare(depth, T_cw, references)
        self.depth = self._all.depth

    def with_keyframes(self, keyframes: list[Keyframe]) -> DepthComparison:
        """Return the comparison with some of the keyframes."""
        return self._all.select([self._row[keyframe.index] for keyframe in keyframes])


def _select_evenly(keyframes: list[Keyframe], limit: int) -> list[Keyframe]:
    """Select at most `limit` keyframes, evenly spaced in the list."""
    if not keyframes:
        return []
    places = np.linspace(0, len(keyframes) - 1, limit).round().astype(int)
    return [keyframes[place] for place in np.unique(places).tolist()]
