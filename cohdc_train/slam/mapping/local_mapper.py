"""Insertion of keyframes, followed by local bundle adjustment, loop closing, and culling."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Protocol

from cohdc_train.slam.config import BundleAdjustmentConfig, KeyframeCullingConfig
from cohdc_train.slam.features.patch_alignment import Pyramid
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.mapping.background_bundle_adjustment import BackgroundMapper
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.keyframe_culling import cull_keyframes
from cohdc_train.slam.mapping.local_bundle_adjustment import adjust_window
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import add_points, cull_map_points, fuse
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner
from cohdc_train.slam.optimization.reprojection import ReprojectionModel


@dataclass(frozen=True)
class LocalMapperConfig:
    """Options of a local mapper.

    max_depth_m: farthest depth at which a point is created, m.
    """

    bundle_adjustment: BundleAdjustmentConfig
    keyframe_culling: KeyframeCullingConfig
    max_depth_m: float


class LoopCloserLike(Protocol):
    """Interface of a loop closer.

    closed: number of loops closed; image_px: longer side of the image that it needs, px.
    """

    closed: int
    image_px: int

    @property
    def loop_keyframes(self) -> set[int]:
        """Return the indices of the keyframes that loops refer to."""

    def close(self, keyframe: Keyframe, image: DepthImage) -> None:
        """Search a loop with the newest keyframe; the map may move."""

    def forget(self, keyframe: Keyframe) -> None:
        """Forget a keyframe that the map has removed."""


class LocalMapper:
    """Insertion of keyframes into a map, and the tasks that follow.

    refiner: stores the patches of new points; loop_closer: searches a loop with every keyframe,
    None disables loop closing; executor: runs bundle adjustment in parallel with tracking, None
    runs it directly; incremental: leave the tasks after an insertion to `run_next_task`.
    """

    def __init__(
        self,
        point_map: Map,
        reprojection: ReprojectionModel,
        config: LocalMapperConfig,
        refiner: PatchRefiner | None,
        loop_closer: LoopCloserLike | None,
        executor: Executor | None,
        incremental: bool,
    ) -> None:
        self._map, self._reprojection = point_map, reprojection
        self._config = config
        self._mapper = (
            None
            if executor is None
            else BackgroundMapper(executor, reprojection, config.bundle_adjustment)
        )
        self._refiner = refiner
        self._loops = loop_closer
        self._incremental = incremental
        self._tasks: deque[Callable[[], None]] = deque()

    @property
    def num_loops(self) -> int:
        """Return the number of loops closed so far."""
        return 0 if self._loops is None else self._loops.closed

    @property
    def is_idle(self) -> bool:
        """Return whether all tasks of the latest keyframe are done."""
        return not self._tasks

    def insert(
        self, keyframe: Keyframe, patches: Pyramid | None, make_image: Callable[[int], DepthImage]
    ) -> None:
        """Insert a tracked keyframe, and create points at its keypoints with depth.

        The tasks that follow are fusion of duplicates, bundle adjustment, and point culling, then
        loop closing and keyframe culling. Unfinished tasks of the keyframe before are run first.

        Args:
            keyframe: the frame, with the points that were tracked in it.
            patches: image pyramid for the refiner.
            make_image: makes the image for loop closing, whose longer side it is given in px.
        """
        self._run_all_tasks()
        self._map.add_keyframe(keyframe)
        add_points(self._map, keyframe, self._config.max_depth_m)
        if self._refiner is not None and patches is not None:
            self._refiner.store(keyframe, patches)
        self._tasks.extend(
            [
                lambda: self._adjust(keyframe),
                lambda: self._close_loops_and_cull(keyframe, make_image),
            ]
        )
        if not self._incremental:
            self._run_all_tasks()

    def run_next_task(self) -> None:
        """Run the next task, if there is one; keyframes may move."""
        if self._tasks:
            self._tasks.popleft()()

    def apply_finished_adjustment(self) -> None:
        """Apply a bundle adjustment that has finished in parallel; keyframes may move."""
        if self._mapper is not None:
            self._mapper.collect(self._map)

    def finish(self) -> None:
        """Run all tasks, and wait for bundle adjustment."""
        self._run_all_tasks()
        if self._mapper is not None:
            self._mapper.finish(self._map)

    def _run_all_tasks(self) -> None:
        while self._tasks:
            self.run_next_task()

    def _adjust(self, keyframe: Keyframe) -> None:
        """Fuse duplicates of a keyframe's points, bundle-adjust its window, and cull points."""
        if len(self._map.keyframes) == 1:
            return
        fuse(self._map, keyframe)
        if self._mapper is None:
            config = self._config.bundle_adjustment
            adjust_window(self._map, keyframe, self._reprojection, config)
        else:
            self._mapper.start(self._map, keyframe)
        cull_map_points(self._map, keyframe.index)

    def _close_loops_and_cull(
        self, keyframe: Keyframe, make_image: Callable[[int], DepthImage]
    ) -> None:
        """Search a loop with a keyframe, and cull redundant keyframes."""
        in_use: set[int] = set() if self._mapper is None else self._mapper.busy_with
        if self._loops is not None:
            self._loops.close(keyframe, make_image(self._loops.image_px))
            in_use = in_use | self._loops.loop_keyframes
        culling = self._config.keyframe_culling
        if culling.enabled:
            window = self._config.bundle_adjustment.local_keyframes
            for removed in cull_keyframes(self._map, keyframe, in_use, culling, window):
                if self._loops is not None:
                    self._loops.forget(removed)
