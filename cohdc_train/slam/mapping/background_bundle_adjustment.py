"""Local bundle adjustment in parallel with tracking.

Only the tracker's thread accesses the map. It copies arrays from the map (`build_window`), a worker
process adjusts the copy, and between two frames the tracker's thread writes the result
(`apply_solution`). One window is adjusted at a time; a keyframe that is inserted meanwhile waits,
and a newer one replaces it.
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
    """Queue of bundle adjustments that run in an executor, one after the other."""

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
        """Return the indices of the keyframes that must stay in the map until `collect` returns."""
        waiting = set() if self._waiting is None else {self._waiting.index}
        return (
            waiting
            if self._running is None
            else waiting | {k.index for k in self._running[0].keyframes}
        )

    def start(self, point_map: Map, keyframe: Keyframe) -> None:
        """Adjust the keyframe's window as soon as the running adjustment is done."""
        if self._running is not None:
            self._waiting = keyframe
            return
        window = build_window(point_map, keyframe, self._config)
        poses = np.stack(window.poses)
        problem = poses, window.points, window.problem, self._reprojection, self._config
        job = self._executor.submit(solve, *problem)
        self._running = window, job

    def collect(self, point_map: Map) -> Array | None:
        """Write a finished result into the map.

        Returns the motion of `apply_solution`, None where nothing has finished.
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
        """Wait for the running and the waiting adjustment, and write them into the map."""
        while self._running is not None:
            self._running[1].result()
            self.collect(point_map)
