"""The tracker: every frame's pose against the map; decides on keyframes; finds the place again after a loss."""

import time
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.alignment import Picture, take_picture
from cohdc_train.slam.background_mapping import BackgroundMapper
from cohdc_train.slam.camera import Camera
from cohdc_train.slam.dynamic_mask import DynamicMask
from cohdc_train.slam.features import Corners, FeatureExtractor, Features, gray_of
from cohdc_train.slam.final_adjustment import SeenFrames
from cohdc_train.slam.flow_tracking import FlowTracker
from cohdc_train.slam.frame_log import FrameLog
from cohdc_train.slam.geometry import Geometry
from cohdc_train.slam.keyframe_culling import cull_keyframes
from cohdc_train.slam.localization import LOCAL_KEYFRAMES, Fit, Localizer, thumbnail
from cohdc_train.slam.loop_closing import LoopCloser
from cohdc_train.slam.map import Keyframe, Map
from cohdc_train.slam.mapping import insert_keyframe
from cohdc_train.slam.matching import Matches
from cohdc_train.slam.method import Method
from cohdc_train.slam.motion import Expectation, Motion
from cohdc_train.slam.optimization import Array, Weighing, exp_se3, inverse
from cohdc_train.slam.refinement import Refiner
from cohdc_train.slam.shutter import unrolled

MIN_START = 50  # points a first keyframe needs
_KEYFRAME = 0.82, 20  # share of the inliers right after the last keyframe, and frames since: one makes the next due
_KEYFRAME_FLOW = 0.75, 15  # where only every third frame can become one, and time is short
_OLD = 10  # keyframes ago that a point joined the map: what is seen there is no new place
_KNOWN = 0.9  # share of a frame's points that are old, from which on its place is known
_KNOWN_SHARE = 0.7  # of the old points of the reference keyframe; where a known place is seen less well, it has changed
_CERTAIN = 1e9  # information of the first pose, which is where the world begins

_Rgb = NDArray[np.uint8]
_Depth = NDArray[np.float32]
_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Pose:
    """What became of one frame. t: s; T_wc: [4, 4] camera to world, m, None when the place is lost."""

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


class Tracker:
    """RGB-D SLAM, one frame at a time; the same frames and seed give the same poses, bit for bit.

    With an executor bundle adjustment runs there, beside tracking (`background_mapping`); poses then depend on time.
    """

    def __init__(
        self,
        camera: Camera,
        features: int,
        seed: int = 0,
        method: Method | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.camera = camera
        self.method = method or Method()
        self.map = Map(camera)
        self.budget = features
        self.features: Features | None = None  # of the latest frame
        self.mask: NDArray[np.bool_] | None = None  # as given; a matched frame's less what is at rest, and what moves
        self._extract = FeatureExtractor(camera, features)
        self._geometry = Geometry(camera)
        self._dynamic_mask = DynamicMask(self._geometry)
        self._refiner = Refiner(self.map) if self.method.refinement else None
        self._weighing = Weighing(camera, camera.fx * camera.baseline) if camera.baseline else Weighing(camera)
        self._mapper = None if executor is None else BackgroundMapper(executor, self._weighing)
        self._localizer = Localizer(self.map, self._weighing, seed, self.method.static_weights)
        self._loops = LoopCloser(self.map, self._weighing, seed) if self.method.loops else None
        self._flow = FlowTracker(self.map, self._weighing) if executor is not None and self.method.flow else None
        self._motion = Motion()
        self._last: Fit | None = None
        self._reference_inliers = 0
        self._since_keyframe = 0
        self._log = FrameLog()
        self._seen = SeenFrames()

    def track(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        t: float,
        mask: NDArray[np.bool_] | None = None,
        depth_t: float | None = None,
    ) -> Pose:
        """Find the camera of the next frame.

        rgb: [H, W, 3] uint8 RGB; depth_m: [H, W] m along the optical axis, 0 = no reading; t: s, rising;
        mask: [H, W] bool, True = dynamic: nothing is taken from there into the map. Where what is left does not carry
        a pose, the whole picture is matched against the map, whose points stand still; such a frame is no keyframe.
        depth_t: s, when depth was taken, where that differs from t.
        """
        start = time.perf_counter()
        self._take_in_mapping()
        late = None if depth_t is None else depth_t - t
        expected = None if self._last is None else self._motion.expected(t)
        fit = None if expected is None else self._by_flow(rgb, depth_m, expected, mask, late)
        if fit is not None:
            tracked = time.perf_counter()
            self._motion.found(t, fit.T_cw, fit.information, fit.pull)
            self._remember(fit, t, False)
            return _pose_of(fit, t, False, start, tracked)
        given, mask = mask, self._dynamic(mask, depth_m, expected, t)
        self.mask = mask
        if self._refiner is not None:
            self._refiner.look_at(gray_of(rgb))
        features, fit = self._matched(rgb, depth_m, mask, late, expected)
        covered = fit is None and mask is not None and bool(self.map.keyframes)
        if covered:
            features, fit = self._matched(rgb, depth_m, None, late, expected)
        self.features = features
        tracked = time.perf_counter()
        keyframe = fit is not None and not covered and self._wants_keyframe(fit)
        if fit is not None:
            self._motion.found(t, fit.T_cw, fit.information, fit.pull)
        if fit is not None and keyframe:
            before = fit.T_cw
            fit = self._add_keyframe(features, fit, t, rgb, depth_m)
            if self._loops is not None:
                fit = self._close_loop(fit, self._loops, take_picture(rgb, depth_m, mask, self.camera))
            if self.method.keyframe_culling:
                self._cull_keyframes()
            self._motion.carry(inverse(before) @ fit.T_cw)
        if self._flow is not None:
            self._flow.begin(rgb, features, fit, given)
        self._remember(fit, t, True)
        return _pose_of(fit, t, keyframe, start, tracked)

    def finish(self) -> None:
        """Wait for mapping that runs beside tracking, and adjust the whole map; the trajectory is better for it."""
        if self._mapper is not None:
            self._mapper.finish(self.map)
        if self.method.global_adjustment and len(self.map.keyframes) > 1:
            self._seen.adjust(self.map, self._weighing, self._log)

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return 0 if self._loops is None else self._loops.closed

    def trajectory(self) -> tuple[Array, Array]:
        """All tracked frames, each re-derived from its reference keyframe, or that one's heir, as the map has it now,
        and smoothed.

        Returns stamps [n] s and poses [n, 4, 4] T_wc camera to world, m.
        """
        return self._log.trajectory(self.map, self.method.smoothing)

    def _by_flow(
        self, rgb: _Rgb, depth_m: _Depth, expected: Expectation, mask: _Mask | None, late: float | None
    ) -> Fit | None:
        """The pose by what the last matched frame saw; None where this one is to be matched."""
        if self._flow is None:
            return None
        followed = self._flow.follow(rgb, mask, expected.prior.T_cw)
        if followed is None:
            return None
        features = self._measured(followed.corners, depth_m, mask, late)
        fit = self._flow.locate(followed, features, expected)
        if fit is None:
            return None
        self.features, self.mask = features, mask
        return fit

    def _matched(
        self, rgb: _Rgb, depth_m: _Depth, mask: _Mask | None, late: float | None, expected: Expectation | None
    ) -> tuple[Features, Fit | None]:
        """The corners of a frame and its pose against the map: by where patches put them, else by where they lie."""
        features = self._corners(rgb, depth_m, mask, late)
        fit = self._locate(features, rgb, expected)
        if fit is None or fit.reference is None:
            return features, fit
        refined = features if self._refiner is None else self._refiner.refine(features, fit.matches, fit.T_cw)
        settled = self._localizer.settle(refined, fit)
        return (features, self._localizer.settle(features, fit)) if settled is None else (refined, settled)

    def _dynamic(self, mask: _Mask | None, depth_m: _Depth, expected: Expectation | None, t: float) -> _Mask | None:
        """The mask after depth had its say, where the camera is expected."""
        if not self.method.geometry or self._last is None or expected is None:
            return mask
        around = self.map.covisible(self._last.matches.points, LOCAL_KEYFRAMES)
        return self._dynamic_mask.of(mask, depth_m, expected.prior.T_cw, around, t)

    def _corners(self, rgb: _Rgb, depth_m: _Depth, mask: _Mask | None, late: float | None) -> Features:
        return self._measured(self._extract.find(rgb, mask), depth_m, mask, late)

    def _measured(self, corners: Corners, depth_m: _Depth, mask: _Mask | None, late: float | None) -> Features:
        """The corners of a frame, all put at its one time; late: s by which depth was taken after colour."""
        twist = self._motion.twist
        lag = None if twist is None or late is None else exp_se3(twist * late)
        features = self._extract.measure(corners, depth_m, mask, lag)
        return features if twist is None else unrolled(features, self.camera, twist)

    def _locate(self, features: Features, rgb: _Rgb, expected: Expectation | None) -> Fit | None:
        if not self.map.keyframes:
            usable = np.count_nonzero(~np.isnan(features.depths))
            empty = np.zeros(0, dtype=np.int64)
            where_the_world_begins = Fit(np.eye(4), Matches(empty, empty), information=_CERTAIN * np.eye(6))
            return where_the_world_begins if usable >= MIN_START else None
        if self._last is None or expected is None:
            return self._localizer.anywhere(features, rgb)
        return self._localizer.near(features, rgb, self._last, expected)

    def _take_in_mapping(self) -> None:
        """What was mapped beside tracking, if anything, goes into the map; the last pose moves along."""
        motion = None if self._mapper is None else self._mapper.collect(self.map)
        if motion is not None and self._last is not None:
            self._last = replace(self._last, T_cw=self._last.T_cw @ motion)
            self._motion.carry(motion)

    def _wants_keyframe(self, fit: Fit) -> bool:
        if fit.reference is None:
            return True
        old = self.map.born[: self.map.size] < self.map.joined - _OLD
        if np.count_nonzero(old[fit.matches.points]) >= _KNOWN * len(fit.matches):
            return len(fit.matches) < _KNOWN_SHARE * float(old[fit.reference.seen_points()].sum())
        share, frames = _KEYFRAME if self._flow is None else _KEYFRAME_FLOW
        return self._since_keyframe >= frames or len(fit.matches) < share * self._reference_inliers

    def _add_keyframe(self, features: Features, fit: Fit, t: float, rgb: _Rgb, depth_m: _Depth) -> Fit:
        point_ids = np.full(len(features), -1)
        point_ids[fit.matches.corners] = fit.matches.points
        pictures = thumbnail(rgb), self._geometry.nearest(depth_m)
        keyframe = Keyframe(self.map.joined, t, fit.T_cw, features, point_ids, *pictures)
        insert_keyframe(self.map, keyframe, self._weighing, self._mapper)
        if self._refiner is not None:
            self._refiner.remember(keyframe)
        self._since_keyframe = 0
        self._reference_inliers = 0
        return _fit_of(keyframe, fit.information)

    def _cull_keyframes(self) -> None:
        in_use = set() if self._mapper is None else self._mapper.busy_with
        in_use |= set() if self._loops is None else self._loops.ends
        for keyframe in cull_keyframes(self.map, self.map.keyframes[-1], in_use):
            if self._loops is not None:
                self._loops.forget(keyframe)

    def _close_loop(self, fit: Fit, loops: LoopCloser, picture: Picture) -> Fit:
        """The newest keyframe's fit, after a loop where it is then."""
        keyframe = self.map.keyframes[-1]
        return _fit_of(keyframe, fit.information) if loops.close(keyframe, picture) else fit

    def _remember(self, fit: Fit | None, t: float, matched: bool) -> None:
        if fit is None or fit.reference is None:
            self._last = None
            self._motion.forget()
            self._dynamic_mask.forget()
            return
        self._last = fit
        if self._since_keyframe > 0 and matched:
            self._reference_inliers = max(self._reference_inliers, len(fit.matches))
        self._since_keyframe += 1
        row = self._log.append(t, fit, fit.reference)
        if self.method.every_frame and self.features is not None:
            self._seen.append(row, fit, self.features, self.map)


def _fit_of(keyframe: Keyframe, information: Array) -> Fit:
    corners = np.flatnonzero(keyframe.point_ids >= 0)
    return Fit(keyframe.T_cw, Matches(keyframe.point_ids[corners], corners), keyframe, information=information)


def _pose_of(fit: Fit | None, t: float, keyframe: bool, start: float, tracked: float) -> Pose:
    """start, tracked: when work on the frame began, and when its pose was found."""
    T_wc, inliers = (None, 0) if fit is None else (inverse(fit.T_cw), len(fit.matches))
    return Pose(t, T_wc, keyframe, inliers, 1e3 * (tracked - start), 1e3 * (time.perf_counter() - tracked))
