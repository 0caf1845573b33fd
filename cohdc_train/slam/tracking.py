"""The tracker: every frame's pose against the map; decides on keyframes; finds the place again after a loss."""

import time
from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.alignment import Picture, take_picture
from cohdc_train.slam.background_mapping import BackgroundMapper
from cohdc_train.slam.camera import Camera
from cohdc_train.slam.culling import grow
from cohdc_train.slam.features import FeatureExtractor, Features
from cohdc_train.slam.geometry import Geometry, Reference
from cohdc_train.slam.loop_closing import LoopCloser
from cohdc_train.slam.map import Keyframe, Map, observations
from cohdc_train.slam.mapping import insert_keyframe
from cohdc_train.slam.matching import Matches, match_descriptors, match_projected
from cohdc_train.slam.method import Method
from cohdc_train.slam.optimization import Array, Observations, Weighing, exp_se3, log_se3, optimize_pose
from cohdc_train.slam.ransac import ransac_pose
from cohdc_train.slam.refinement import Pyramid, Refiner
from cohdc_train.slam.rigidity import pose_of_rest

_MIN_START = 50  # points a first keyframe needs
_MIN_FIRST = 15  # inliers of the first, rough pose
_MIN_TRACKED = 25  # inliers of the pose against the local map
_MIN_FOUND_AGAIN = 40  # the same when the place was lost
_LOCAL_KEYFRAMES = 15
_KEYFRAME_SHARE = 0.75  # of the inliers right after the last keyframe
_KEYFRAME_FRAMES = 20
_REFERENCES = 8  # keyframes whose depth a frame is held against
_MOVER_BAND = 8.0  # px: as wide as a coarse pixel of that
_LONGEST = 0.2  # s between two frames whose velocity still says where the camera was in between
_CANDIDATES = 6  # keyframes tried per lost frame


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


@dataclass(frozen=True)
class _Fit:
    T_cw: Array
    matches: Matches


class Tracker:
    """RGB-D SLAM, one frame at a time; the same frames and seed give the same poses, bit for bit.

    With an executor bundle adjustment runs there, beside tracking (`background_mapping`); poses then depend on time.
    """

    def __init__(
        self,
        camera: Camera,
        features: int = 1000,
        seed: int = 0,
        method: Method | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.camera = camera
        self.method = method or Method()
        self.map = Map(camera)
        self.budget = features
        self.features: Features | None = None  # of the latest frame
        self.mask: NDArray[np.bool_] | None = None  # what was left out of it: as given, and what geometry found
        self._extract = FeatureExtractor(camera, features)
        self._geometry = Geometry(camera)
        self._refiner = Refiner(self.map) if self.method.refinement else None
        self._weighing = Weighing(camera, camera.fx * camera.baseline) if camera.baseline else Weighing(camera)
        self._mapper = None if executor is None else BackgroundMapper(executor, self._weighing)
        self._rng = np.random.default_rng(seed)
        self._loops = LoopCloser(self.map, self._weighing, seed) if self.method.loops else None
        self._velocity = np.eye(4)
        self._last: _Fit | None = None
        self._reference: Keyframe | None = None
        self._reference_inliers = 0
        self._since_keyframe = 0
        self._log: list[tuple[float, Keyframe, Array]] = []  # stamp, reference keyframe, T of the frame in it

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
        mask = self.mask = self._with_movers(mask, depth_m)
        features = self._extract(rgb, depth_m, mask, self._lag(t, depth_t))
        fit = self._locate(features, rgb)
        covered = fit is None and mask is not None and bool(self.map.keyframes)
        if covered:
            features = self._extract(rgb, depth_m)
            fit = self._locate(features, rgb)
        self.features = features
        tracked = time.perf_counter()
        keyframe = fit is not None and not covered and self._wants_keyframe(fit)
        if fit is not None and keyframe:
            fit = self._add_keyframe(features, fit, t, rgb, depth_m)
            if self._loops is not None:
                fit = self._close_loop(fit, self._loops, take_picture(rgb, depth_m, mask, self.camera))
        self._remember(fit, t)
        inliers = 0 if fit is None else len(fit.matches)
        mapped = time.perf_counter()
        T_wc = None if fit is None else np.linalg.inv(fit.T_cw).astype(np.float64)
        return Pose(t, T_wc, keyframe, inliers, 1e3 * (tracked - start), 1e3 * (mapped - tracked))

    def finish(self) -> None:
        """Wait for mapping that runs beside tracking; the trajectory is better for it."""
        if self._mapper is not None:
            self._mapper.finish(self.map)

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return 0 if self._loops is None else self._loops.closed

    def trajectory(self) -> tuple[Array, Array]:
        """All tracked frames, each re-derived from its reference keyframe as the map has it now.

        Returns stamps [n] s and poses [n, 4, 4] T_wc camera to world, m.
        """
        stamps = np.array([t for t, _, _ in self._log])
        poses = [np.linalg.inv(relative @ keyframe.T_cw) for _, keyframe, relative in self._log]
        return stamps, np.stack(poses) if poses else np.zeros((0, 4, 4))

    def _with_movers(self, mask: NDArray[np.bool_] | None, depth_m: NDArray[np.float32]) -> NDArray[np.bool_] | None:
        """The mask, and what depth says moves where the camera is expected."""
        if not self.method.geometry or self._last is None:
            return mask
        around = self.map.covisible(self._last.matches.points, _LOCAL_KEYFRAMES)
        around.sort(key=lambda keyframe: keyframe.index)
        spread = np.unique(np.linspace(0, len(around) - 1, _REFERENCES).round().astype(int)).tolist()
        references = [Reference(around[i].T_cw, around[i].nearest) for i in spread]
        movers = self._geometry.movers(depth_m, self._velocity @ self._last.T_cw, references)
        if not movers.any():
            return mask
        movers = grow(movers, _MOVER_BAND)
        return movers if mask is None else mask | movers

    def _lag(self, t: float, depth_t: float | None) -> Array | None:
        """[4, 4] from the camera's frame at t to that at depth_t, by the velocity between the last two frames."""
        if depth_t is None or self._last is None or len(self._log) < 2:
            return None
        step = self._log[-1][0] - self._log[-2][0]
        if not 0 < step <= _LONGEST:
            return None
        return exp_se3(log_se3(self._velocity) * ((depth_t - t) / step))

    def _locate(self, features: Features, rgb: NDArray[np.uint8]) -> _Fit | None:
        if not self.map.keyframes:
            usable = np.count_nonzero(~np.isnan(features.depths))
            empty = np.zeros(0, dtype=np.int64)
            return _Fit(np.eye(4), Matches(empty, empty)) if usable >= _MIN_START else None
        if self._last is None:
            return self._relocalise(features, rgb)
        rough = self._follow(features, self._last)
        if rough is None:
            return self._relocalise(features, rgb)
        return self._against_local_map(features, rough, _MIN_TRACKED)

    def _take_in_mapping(self) -> None:
        """What was mapped beside tracking, if anything, goes into the map; the last pose moves along."""
        motion = None if self._mapper is None else self._mapper.collect(self.map)
        if motion is not None and self._last is not None:
            self._last = _Fit(self._last.T_cw @ motion, self._last.matches)

    def _follow(self, features: Features, last: _Fit) -> _Fit | None:
        """A rough pose from the points of the last frame, first near where the velocity puts them, then further off."""
        for guess, radius in ((self._velocity @ last.T_cw, 15.0), (last.T_cw, 40.0)):
            projected = self.map.project(last.matches.points, guess)
            matches = match_projected(projected, features, radius)
            fit = self._solve(features, matches, guess, hypotheses=64)
            if fit is not None:
                return fit
        return None

    def _solve(self, features: Features, matches: Matches, guess: Array | None, hypotheses: int) -> _Fit | None:
        if len(matches) < _MIN_FIRST:
            return None
        points, seen = self._seen(features, matches)
        found = ransac_pose(points, seen, self.camera, self._rng, hypotheses, guess=guess)
        if found is None or found[1].sum() < _MIN_FIRST:
            return None
        T_cw, agree = found
        matches = matches.take(agree)
        T_cw, inlier = optimize_pose(T_cw, points[agree], seen.take(agree), self._weighing, rounds=1)
        return _Fit(T_cw, matches.take(inlier)) if inlier.sum() >= _MIN_FIRST else None

    def _against_local_map(self, features: Features, rough: _Fit, minimum: int) -> _Fit | None:
        """The final pose, from all points of the keyframes around."""
        keyframes = self.map.covisible(rough.matches.points, _LOCAL_KEYFRAMES)
        projected = self.map.project(self.map.points_of(keyframes), rough.T_cw)
        matches = match_projected(projected, features, radius=5.0)
        points, seen = self._seen(features, matches)
        if self.method.static_weights:
            T_cw, inlier, moving = pose_of_rest(rough.T_cw, points, seen, self._weighing)
            self.map.judge(matches.points[inlier], matches.points[moving])
        else:
            T_cw, inlier = optimize_pose(rough.T_cw, points, seen, self._weighing)
        if inlier.sum() < minimum:
            return None
        matches = matches.take(inlier)
        self.map.visible[projected.ids] += 1
        self.map.found[matches.points] += 1
        best = self.map.covisible(matches.points, 1)
        self._reference = best[0]
        return _Fit(T_cw, matches)

    def _seen(self, features: Features, matches: Matches) -> tuple[Array, Observations]:
        """Where the map has the matched points, [m, 3] m, and what the frame measured of them."""
        seen = observations(features, matches.corners, self.map.trust(matches.points))
        return self.map.positions[matches.points], seen

    def _relocalise(self, features: Features, rgb: NDArray[np.uint8]) -> _Fit | None:
        """Try the keyframes that look most like the frame, and the newest."""
        picture = thumbnail(rgb)
        likeness = np.array([float((k.thumbnail * picture).sum()) for k in self.map.keyframes])
        order = [*np.argsort(-likeness, kind="stable")[: _CANDIDATES - 1], len(likeness) - 1]
        for index in dict.fromkeys(int(i) for i in order):
            ids = self.map.keyframes[index].seen_points()
            matches = match_descriptors(ids, self.map.descriptors[ids], features)
            rough = self._solve(features, matches, None, hypotheses=256)
            fit = None if rough is None else self._against_local_map(features, rough, _MIN_FOUND_AGAIN)
            if fit is not None:
                return fit
        return None

    def _wants_keyframe(self, fit: _Fit) -> bool:
        if not self.map.keyframes:
            return True
        if self._since_keyframe >= _KEYFRAME_FRAMES:
            return True
        return len(fit.matches) < _KEYFRAME_SHARE * self._reference_inliers

    def _add_keyframe(
        self, features: Features, fit: _Fit, t: float, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]
    ) -> _Fit:
        pyramid = Pyramid(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)) if self._refiner else None
        if self._refiner is not None and pyramid is not None:
            features = self._refiner.refine(features, fit.matches, fit.T_cw, pyramid)
        point_ids = np.full(len(features), -1)
        point_ids[fit.matches.corners] = fit.matches.points
        pictures = thumbnail(rgb), self._geometry.nearest(depth_m)
        keyframe = Keyframe(len(self.map.keyframes), t, fit.T_cw, features, point_ids, *pictures)
        insert_keyframe(self.map, keyframe, self._weighing, self._mapper)
        if self._refiner is not None and pyramid is not None:
            self._refiner.remember(keyframe, pyramid)
        self._reference = keyframe
        self._since_keyframe = 0
        self._reference_inliers = 0
        return _fit_of(keyframe)

    def _close_loop(self, fit: _Fit, loops: LoopCloser, picture: Picture) -> _Fit:
        """The newest keyframe's fit; after a loop the last frame's pose goes along, so that the velocity stays."""
        keyframe = self.map.keyframes[-1]
        if not loops.close(keyframe, picture):
            return fit
        if self._last is not None:
            moved = self._last.T_cw @ np.linalg.inv(fit.T_cw) @ keyframe.T_cw
            self._last = _Fit(moved, self._last.matches)
        return _fit_of(keyframe)

    def _remember(self, fit: _Fit | None, t: float) -> None:
        if fit is None or self._reference is None:
            self._last = None
            self._velocity = np.eye(4)
            return
        self._velocity = np.eye(4) if self._last is None else fit.T_cw @ np.linalg.inv(self._last.T_cw)
        self._last = fit
        if self._since_keyframe > 0:
            self._reference_inliers = max(self._reference_inliers, len(fit.matches))
        self._since_keyframe += 1
        self._log.append((t, self._reference, fit.T_cw @ np.linalg.inv(self._reference.T_cw)))


def _fit_of(keyframe: Keyframe) -> _Fit:
    corners = np.flatnonzero(keyframe.point_ids >= 0)
    return _Fit(keyframe.T_cw, Matches(keyframe.point_ids[corners], corners))


def thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[30, 40] float32, blurred, zero mean and unit norm: the product of two is their normalised correlation."""
    small = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (40, 30), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5)
    image -= image.mean()
    return np.asarray(image / (np.linalg.norm(image) + 1e-6), dtype=np.float32)
