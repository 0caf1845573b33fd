"""The tracker: every frame's pose against the map; decides on keyframes; finds the place again
after a loss.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.config import MAX_KEYPOINTS, Method
from cohdc_train.slam.dynamics.dynamic_mask import DynamicMaskEstimator
from cohdc_train.slam.dynamics.free_space import FreeSpaceChecker
from cohdc_train.slam.features.descriptors import thumbnail
from cohdc_train.slam.features.keypoints import Features, Keypoints
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import OrbExtractor, gray_of
from cohdc_train.slam.features.rolling_shutter import undo_rolling_shutter
from cohdc_train.slam.frame import Pose, PoseCallback
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.depth_image import make_depth_image
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse
from cohdc_train.slam.loop_closing.loop_closer import LoopCloser
from cohdc_train.slam.mapping.frame_history import FrameHistory
from cohdc_train.slam.mapping.global_bundle_adjustment import ObservedFrames
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.local_mapper import LocalMapper
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.tracking.flow_tracker import FlowTracker
from cohdc_train.slam.tracking.localizer import LOCAL_KEYFRAMES, Fit, Localizer
from cohdc_train.slam.tracking.motion_model import MotionModel, Prediction
from cohdc_train.slam.tracking.pose_reporter import PoseReporter

MIN_START = 50  # points a first keyframe needs
_KEYFRAME_SHARE = 0.82  # of the inliers right after the last keyframe: with fewer the next is due
_SELDOM_ASKED_SHARE = 0.86  # the same where flow tracks, and only every third frame can become one
_KEYFRAME_FRAMES = 20  # after which it is due in any case
_OLD = 10  # keyframes ago that a point joined the map: what is seen there is no new place
_KNOWN = 0.9  # share of a frame's points that are old, from which on its place is known
_KNOWN_SHARE = 0.7  # of the old points of the reference keyframe; where a known place is seen less well, it has changed
_MATCHES_UNTIL = 0.5  # of the time until the next frame has gone: matching takes about one whole, and two are too many
_WORKS_UNTIL = 0.75  # the same for mapping, whose parts take half
_CERTAIN = 1e9  # information of the first pose, which is where the world begins

_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _Frame:
    """What `Tracker.track` was given. late: s by which depth was taken after colour, None where
    nobody says.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    t: float
    mask: _Mask | None
    late: float | None


class Tracker:
    """RGB-D SLAM, one frame at a time; the same frames and seed give the same poses, bit for bit.

    With an executor bundle adjustment runs there, beside tracking (`background_mapping`); poses
    then depend on time.
    spent: asked when a frame's pose is known, which share of the time until the next frame has
    gone; what would hold that one up is put off.
    """

    def __init__(
        self,
        camera: Camera,
        features: int = MAX_KEYPOINTS,
        seed: int = 0,
        method: Method | None = None,
        executor: Executor | None = None,
        spent: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.camera = camera
        self.method = method or Method()
        self.map = Map(camera)
        self.budget = features
        self.features: Features | None = None  # of the latest frame
        self.mask: NDArray[np.bool_] | None = (
            None  # as given; a matched frame's less what is at rest, and what moves
        )
        self._extract = OrbExtractor(camera, features)
        self._geometry = FreeSpaceChecker(camera)
        self._dynamic_mask = DynamicMaskEstimator(self._geometry)
        self._refiner = PatchRefiner(self.map) if self.method.refinement else None
        self._reprojection = (
            ReprojectionModel(camera, camera.fx * camera.baseline)
            if camera.baseline
            else ReprojectionModel(camera)
        )
        self._localizer = Localizer(self.map, self._reprojection, seed, self.method.static_weights)
        self._flow = (
            FlowTracker(self.map, self._reprojection)
            if executor is not None and self.method.flow
            else None
        )
        in_parts = self._flow is not None
        loop_closer = LoopCloser(self.map, self._reprojection, seed) if self.method.loops else None
        self._mapping = LocalMapper(
            self.map,
            self._reprojection,
            self.method,
            self._refiner,
            loop_closer,
            executor,
            in_parts,
        )
        self._spent = spent
        self._motion = MotionModel()
        self._last: Fit | None = None
        self._latest_t: float | None = None  # s, of the latest frame
        self._reference_inliers = 0.0
        self._since_keyframe = 0
        self._log = FrameHistory()
        self._seen = ObservedFrames()

    def track(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        t: float,
        mask: NDArray[np.bool_] | None = None,
        depth_t: float | None = None,
        on_pose: PoseCallback | None = None,
    ) -> Pose:
        """Find the camera of the next frame.

        rgb: [H, W, 3] uint8 RGB; depth_m: [H, W] m along the optical axis, 0 = no reading; t: s,
        rising;
        mask: [H, W] bool, True = dynamic: nothing is taken from there into the map. Where what is
        left does not carry a pose, the whole picture is matched against the map, whose points stand
        still; such a frame is no keyframe.
        depth_t: s, when depth was taken, where that differs from t. on_pose: called as soon as
        there is an answer, before the work that the frame makes for those to come; what is returned
        may be more exact.
        """
        self._check_input(rgb, depth_m, t, mask)
        answer = PoseReporter(t, on_pose)
        self._let(self._mapping.collect)
        frame = _Frame(rgb, depth_m, t, mask, None if depth_t is None else depth_t - t)
        expected = None if self._last is None else self._motion.expected(t)
        flown = (
            None
            if self._flow is None or expected is None
            else self._by_flow(self._flow, frame, expected)
        )
        if flown is not None:
            answer.give(flown)
            spent = self._spent()
            assert self._flow is not None
            if not self._flow.over(spent > _MATCHES_UNTIL, self._mapping.busy):
                self._motion.found(t, flown.T_cw, flown.information, flown.pull)
                hurry = spent > _WORKS_UNTIL
                self._remember(flown, frame, matched=False, hurry=hurry)
                if not hurry:
                    self._let(self._mapping.work)
                return answer.pose(flown, keyframe=False)
        fit, can_join = self._by_map(frame, expected, flown)
        answer.give(fit)
        if fit is not None:
            self._motion.found(t, fit.T_cw, fit.information, fit.pull)
        wanted = fit is not None and can_join and self._wants_keyframe(fit)
        keyframe = wanted and not self._mapping.busy
        if fit is not None and keyframe:
            fit = self._add_keyframe(frame, fit)
        matched = fit is None or fit is not flown
        if fit is not None and matched and not keyframe:
            left = 1.0 if self._flow is None or flown is None else self._flow.left
            self._reference_inliers = max(self._reference_inliers, len(fit.matches) / left)
        if self._flow is not None and matched:
            assert self.features is not None
            self._flow.begin(rgb, self.features, fit, mask)
        self._remember(fit, frame, matched)
        if wanted and not keyframe:
            self._let(self._mapping.work)
        return answer.pose(fit, keyframe)

    def _check_input(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        t: float,
        mask: NDArray[np.bool_] | None,
    ) -> None:
        """Raise DataError where a frame has another shape or type than the camera's, or its time
        does not rise.
        """
        size = (self.camera.height, self.camera.width)
        if rgb.shape != (*size, 3) or rgb.dtype != np.uint8:
            raise DataError(
                f"frame at {t:.6f} s: rgb is {rgb.dtype} {rgb.shape}, not uint8 {(*size, 3)}"
            )
        if depth_m.shape != size or not np.issubdtype(depth_m.dtype, np.floating):
            raise DataError(
                f"frame at {t:.6f} s: depth is {depth_m.dtype} {depth_m.shape}, not float {size} in m"
            )
        if mask is not None and (mask.shape != size or mask.dtype != np.bool_):
            raise DataError(
                f"frame at {t:.6f} s: mask is {mask.dtype} {mask.shape}, not bool {size}"
            )
        if self._latest_t is not None and t <= self._latest_t:
            raise DataError(
                f"frame at {t:.6f} s: not after the frame before it, at {self._latest_t:.6f} s"
            )
        self._latest_t = t

    def finish(self) -> None:
        """Wait for mapping that runs beside tracking, and adjust the whole map; the trajectory is
        better for it.
        """
        self._mapping.finish()
        if self.method.global_adjustment and len(self.map.keyframes) > 1:
            self._seen.adjust(self.map, self._reprojection, self._log)

    @property
    def loops(self) -> int:
        """How many loops were closed."""
        return self._mapping.loops

    def trajectory(self) -> tuple[Array, Array]:
        """All tracked frames, each re-derived from its reference keyframe, or that one's heir, as
        the map has it now, and smoothed.

        Returns stamps [n] s and poses [n, 4, 4] T_wc camera to world, m.
        """
        return self._log.trajectory(self.map, self.method.smoothing)

    def _by_flow(self, flow: FlowTracker, frame: _Frame, expected: Prediction) -> Fit | None:
        """The pose by what the last matched frame saw; None where too little of it is found."""
        followed = flow.follow(frame.rgb, frame.mask, expected.prior.T_cw)
        if followed is None:
            return None
        features = self._measured(followed.keypoints, frame, frame.mask)
        fit = flow.locate(followed, features, expected)
        if fit is None:
            return None
        self.features, self.mask = features, frame.mask
        return fit

    def _by_map(
        self, frame: _Frame, expected: Prediction | None, flown: Fit | None
    ) -> tuple[Fit | None, bool]:
        """The pose against the map, or the one by flow where that does not answer; and whether the
        frame may become a keyframe."""
        mask = self._dynamic(frame, expected)
        if self._refiner is not None:
            self._refiner.look_at(gray_of(frame.rgb))
        features, fit = self._matched(frame, mask, expected, flown)
        covered = fit is None and mask is not None and bool(self.map.keyframes)
        if covered:
            features, fit = self._matched(frame, None, expected, flown)
        if fit is None and flown is not None:
            return flown, False
        self.features, self.mask = features, mask
        return fit, not covered

    def _matched(
        self, frame: _Frame, mask: _Mask | None, expected: Prediction | None, flown: Fit | None
    ) -> tuple[Features, Fit | None]:
        """The corners of a frame and its pose against the map: by where patches put them, else by
        where they lie.
        """
        features = self._measured(self._extract.find(frame.rgb, mask), frame, mask)
        fit = self._locate(features, frame.rgb, expected, flown)
        if fit is None or fit.reference is None:
            return features, fit
        refined = (
            features
            if self._refiner is None
            else self._refiner.refine(features, fit.matches, fit.T_cw)
        )
        settled = self._localizer.settle(refined, fit)
        return (
            (features, self._localizer.settle(features, fit))
            if settled is None
            else (refined, settled)
        )

    def _dynamic(self, frame: _Frame, expected: Prediction | None) -> _Mask | None:
        """The mask after depth had its say, where the camera is expected."""
        if not self.method.geometry or self._last is None or expected is None:
            return frame.mask
        around = self.map.covisible(self._last.matches.points, LOCAL_KEYFRAMES)
        return self._dynamic_mask.estimate(
            frame.mask, frame.depth_m, expected.prior.T_cw, around, frame.t
        )

    def _measured(self, keypoints: Keypoints, frame: _Frame, mask: _Mask | None) -> Features:
        """The corners of a frame, all put at its one time."""
        twist = self._motion.twist
        lag = None if twist is None or frame.late is None else exp_se3(twist * frame.late)
        features = self._extract.measure(keypoints, frame.depth_m, mask, lag)
        return features if twist is None else undo_rolling_shutter(features, self.camera, twist)

    def _locate(
        self,
        features: Features,
        rgb: NDArray[np.uint8],
        expected: Prediction | None,
        flown: Fit | None,
    ) -> Fit | None:
        if not self.map.keyframes:
            usable = np.count_nonzero(~np.isnan(features.depths))
            empty = np.zeros(0, dtype=np.int64)
            where_the_world_begins = Fit(
                np.eye(4), Matches(empty, empty), information=_CERTAIN * np.eye(6)
            )
            return where_the_world_begins if usable >= MIN_START else None
        if self._last is None or expected is None:
            return self._localizer.anywhere(features, rgb)
        return self._localizer.near(features, rgb, self._last, expected, flown)

    def _let(self, work: Callable[[], None]) -> None:
        """Let the map change; the latest pose moves along with the keyframe it hangs on."""
        last = self._last
        if last is None or last.reference is None:
            work()
            return
        index = last.reference.index
        before = self.map.pose(index)
        work()
        after = self.map.pose(index)
        if np.array_equal(before, after):
            return
        motion = inverse(before) @ after
        self._last = replace(last, T_cw=last.T_cw @ motion)
        self._motion.carry(motion)

    def _wants_keyframe(self, fit: Fit) -> bool:
        if fit.reference is None:
            return True
        old = self.map.first_keyframe[: self.map.size] < self.map.joined - _OLD
        if np.count_nonzero(old[fit.matches.points]) >= _KNOWN * len(fit.matches):
            return len(fit.matches) < _KNOWN_SHARE * float(old[fit.reference.seen_points()].sum())
        share = _KEYFRAME_SHARE if self._flow is None else _SELDOM_ASKED_SHARE
        fewer = len(fit.matches) < share * self._reference_inliers
        return fewer or self._since_keyframe >= _KEYFRAME_FRAMES

    def _add_keyframe(self, frame: _Frame, fit: Fit) -> Fit:
        """Take the frame into the map. Returns its fit there, which the motion goes along with."""
        assert self.features is not None
        features, mask = self.features, self.mask
        point_ids = np.full(len(features), -1)
        point_ids[fit.matches.keypoints] = fit.matches.points
        pictures = thumbnail(frame.rgb), self._geometry.min_depth_grid(frame.depth_m)
        keyframe = Keyframe(self.map.joined, frame.t, fit.T_cw, features, point_ids, *pictures)
        self._mapping.insert(
            keyframe, lambda: make_depth_image(frame.rgb, frame.depth_m, mask, self.camera)
        )
        self._motion.carry(inverse(fit.T_cw) @ keyframe.T_cw)
        self._since_keyframe = 0
        self._reference_inliers = 0.0
        keypoints = np.flatnonzero(keyframe.point_ids >= 0)
        matches = Matches(keyframe.point_ids[keypoints], keypoints)
        return Fit(keyframe.T_cw, matches, keyframe, information=fit.information)

    def _remember(self, fit: Fit | None, frame: _Frame, matched: bool, hurry: bool = False) -> None:
        if fit is None or fit.reference is None:
            self._last = None
            self._motion.forget()
            self._dynamic_mask.reset()
            return
        self._last = fit
        self._since_keyframe += 1
        row = self._log.append(
            frame.t, fit.T_cw, fit.reference, fit.information, fit.pull, self.map
        )
        chosen = self._seen.chosen(fit.matches, matched) if self.method.every_frame else None
        if chosen is None:
            return
        assert self.features is not None
        features = self.features
        if (
            self._refiner is not None and not matched and not hurry
        ):  # flow says only where the corner was matched to
            self._refiner.look_at(gray_of(frame.rgb))
            features = self._refiner.refine(features, chosen, fit.T_cw)
        self._seen.append(row, chosen, features, self.map)
