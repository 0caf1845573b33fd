"""Local bundle adjustment beside tracking, so that tracking never waits for it.

No two threads ever touch the map. The tracker's thread takes arrays out of it (`open_window`), a
worker process does the sums on its own copy, and the tracker's thread, between two frames, puts the
result in (`close_window`). One window is under way at a time; a keyframe that joins meanwhile
waits, and a newer one takes its place.
"""

from concurrent.futures import Executor, Future

import numpy as np

from cohdc_train.slam.config import BundleAdjustmentConfig
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.local_bundle_adjustment import (
    Solution,
    Window,
    apply_solution,
    build_window,
    solve,
)
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.reprojection import ReprojectionModel


class BackgroundMapper:
    """Bundle adjustments, one after the other, in an executor."""

    def __init__(
        self, executor: Executor, reprojection: ReprojectionModel, config: BundleAdjustmentConfig
    ) -> None:
        self._executor = executor
        self._reprojection = reprojection
        self._config = config
        self._running: tuple[Window, Future[Solution]] | None = None
        self._waiting: Keyframe | None = None

    @property
    def busy_with(self) -> set[int]:
        """Indices of the keyframes that must stay in the map until `collect` has had them."""
        waiting = set() if self._waiting is None else {self._waiting.index}
        return (
            waiting
            if self._running is None
            else waiting | {k.index for k in self._running[0].keyframes}
        )

    def start(self, point_map: Map, keyframe: Keyframe) -> None:
        """Adjust the keyframe's window as soon as the one under way is done."""
        if self._running is not None:
            self._waiting = keyframe
            return
        window = build_window(point_map, keyframe, self._config)
        poses = np.stack(window.poses)
        problem = poses, window.points, window.problem, self._reprojection, self._config
        job = self._executor.submit(solve, *problem)
        self._running = window, job

    def collect(self, point_map: Map) -> Array | None:
        """Put a finished result into the map. Returns the motion of `close_window`, None when there
        is none.
        """
        if self._running is None or not self._running[1].done():
            return None
        window, job = self._running
        motion = apply_solution(point_map, window, job.result())
        self._running, waiting = None, self._waiting
        self._waiting = None
        if waiting is not None:
            self.start(point_map, waiting)
        return motion

    def finish(self, point_map: Map) -> None:
        """Wait for what is under way and what waits, and put it into the map."""
        while self._running is not None:
            self._running[1].result()
            self.collect(point_map)
