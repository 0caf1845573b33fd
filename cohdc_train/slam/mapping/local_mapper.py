"""All that follows when a keyframe joins the map: at once, or a part per frame where time is short."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Protocol

from cohdc_train.slam.config import Method
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.mapping.background_bundle_adjustment import BackgroundMapper
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.keyframe_culling import cull_keyframes
from cohdc_train.slam.mapping.local_bundle_adjustment import adjust_window
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import add_points, cull, fuse
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner
from cohdc_train.slam.optimization.reprojection import ReprojectionModel


class LoopCloserLike(Protocol):
    """Closer of loops among the keyframes of a map."""

    closed: int

    @property
    def loop_keyframes(self) -> set[int]:
        """Indices of the keyframes that loops refer to."""

    def close(self, keyframe: Keyframe, picture: DepthImage) -> bool:
        """Look for a loop with the newest keyframe. Returns whether the map moved."""

    def forget(self, keyframe: Keyframe) -> None:
        """Forget a keyframe that the map gave up."""


class LocalMapper:
    """Takes keyframes into a map and puts it in order.

    refiner: cuts out the patches of new points; loop_closer: closes loops with every keyframe, None
    closes none;
    executor: where bundle adjustment runs, in parallel with tracking
    (`background_bundle_adjustment`), None waits for it; in_parts: what can wait is done by `work`,
    a part at a time.
    """

    def __init__(
        self,
        world: Map,
        reprojection: ReprojectionModel,
        method: Method,
        refiner: PatchRefiner | None,
        loop_closer: LoopCloserLike | None,
        executor: Executor | None,
        in_parts: bool,
    ) -> None:
        self._world, self._reprojection = world, reprojection
        self._mapper = None if executor is None else BackgroundMapper(executor, reprojection)
        self._refiner = refiner
        self._loops = loop_closer
        self._culls_keyframes = method.keyframe_culling
        self._in_parts = in_parts
        self._parts: deque[Callable[[], None]] = deque()

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return 0 if self._loops is None else self._loops.closed

    @property
    def busy(self) -> bool:
        """Whether something is left to do of the latest keyframe."""
        return bool(self._parts)

    def insert(self, keyframe: Keyframe, picture: Callable[[], DepthImage]) -> None:
        """A tracked keyframe joins, and its corners of known depth become points. Then: duplicates
        merged, bundle adjustment, weak points out; loops, superfluous keyframes out.

        picture: makes what loop closing keeps of it. Must not be called while `busy`.
        """
        assert not self.busy
        self._world.add_keyframe(keyframe)
        add_points(self._world, keyframe)
        if self._refiner is not None:
            self._refiner.remember(keyframe)
        self._parts.extend(
            [lambda: self._settle(keyframe), lambda: self._look_back(keyframe, picture)]
        )
        if not self._in_parts:
            self._finish_parts()

    def work(self) -> None:
        """One part of what is left, if anything. Keyframes may move."""
        if self._parts:
            self._parts.popleft()()

    def collect(self) -> None:
        """What was adjusted beside tracking goes into the map. Keyframes may move."""
        if self._mapper is not None:
            self._mapper.collect(self._world)

    def finish(self) -> None:
        """Do all that is left."""
        self._finish_parts()
        if self._mapper is not None:
            self._mapper.finish(self._world)

    def _finish_parts(self) -> None:
        while self._parts:
            self.work()

    def _settle(self, keyframe: Keyframe) -> None:
        if len(self._world.keyframes) == 1:
            return
        fuse(self._world, keyframe)
        if self._mapper is None:
            adjust_window(self._world, keyframe, self._reprojection)
        else:
            self._mapper.start(self._world, keyframe)
        cull(self._world, keyframe.index)

    def _look_back(self, keyframe: Keyframe, picture: Callable[[], DepthImage]) -> None:
        in_use: set[int] = set() if self._mapper is None else self._mapper.busy_with
        if self._loops is not None:
            self._loops.close(keyframe, picture())
            in_use = in_use | self._loops.loop_keyframes
        if self._culls_keyframes:
            for removed in cull_keyframes(self._world, keyframe, in_use):
                if self._loops is not None:
                    self._loops.forget(removed)
