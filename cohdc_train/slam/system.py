"""RGB-D SLAM system that processes one frame at a time."""

import math
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.dynamics.dynamic_mask import DynamicMaskEstimator
from cohdc_train.slam.dynamics.free_space import FreeSpaceChecker
from cohdc_train.slam.features.keypoints import ScalePyramid
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import FrameResult, PoseCallback, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.loop_closing.loop_closer import LoopCloser, LoopCloserConfig
from cohdc_train.slam.mapping.frame_history import FrameHistory
from cohdc_train.slam.mapping.global_bundle_adjustment import IntermediateFrames
from cohdc_train.slam.mapping.local_mapper import LocalMapper, LocalMapperConfig
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.optimization.trajectory_smoothing import smooth_trajectory
from cohdc_train.slam.tracking.flow_tracker import FlowTracker
from cohdc_train.slam.tracking.frame_measurer import FrameMeasurer
from cohdc_train.slam.tracking.keyframe_policy import KeyframePolicy
from cohdc_train.slam.tracking.localizer import Localizer, LocalizerConfig
from cohdc_train.slam.tracking.motion_model import MotionModel
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.slam.tracking.tracker_parts import TrackerParts
from cohdc_train.trajectory.trajectory import Trajectory

Mask = NDArray[np.bool_]


class Slam:
    """RGB-D SLAM, one frame at a time.

    The same frames, options, and seed give the same poses, bit for bit, unless an executor runs
    bundle adjustment in parallel.

    Args:
        camera: intrinsics of the frames.
        config: options; the defaults are the tested ones.
        executor: where bundle adjustment runs in real time, in parallel with tracking. With it,
            optical flow tracks most frames.
        frame_time_used: returns which share of the time until the next frame has elapsed; work that
            would delay that frame is postponed.
    """

    def __init__(
        self,
        camera: Camera,
        config: SlamConfig = SlamConfig(),
        *,
        executor: Executor | None = None,
        frame_time_used: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.camera = camera
        self.config = config
        self.map = Map(
            camera,
            ScalePyramid.from_config(config.features),
            config.mapping,
            config.matching,
            config.motion_segmentation,
        )
        self._reprojection = _reprojection_model(camera, config)
        self._last_timestamp: float | None = None
        parts = self._build_parts(executor)
        self._mapper = parts.mapper
        self._history = parts.history
        self._intermediate_frames = parts.intermediate_frames
        self.tracker = Tracker(camera, parts, config.tracking, config.realtime, frame_time_used)

    def track(
        self, frame: RGBDFrame, mask: Mask | None = None, on_pose: PoseCallback | None = None
    ) -> FrameResult:
        """Track the next frame.

        Args:
            frame: color, depth, and a timestamp later than that of the frame before.
            mask: [H, W] bool, True = dynamic, such as a segmenter's mask of persons.
            on_pose: called as soon as the pose is known, before the map is extended.

        Raises:
            DataError: the frame or mask has another shape or type than the camera's, or its
                timestamp does not rise.
        """
        self._check(frame, mask)
        self._last_timestamp = frame.timestamp
        return self.tracker.track(frame, mask, on_pose)

    def finish(self) -> Trajectory:
        """Finish mapping, adjust the whole map, and return the final trajectory."""
        self._mapper.finish()
        config = self.config.bundle_adjustment
        if config.global_enabled and len(self.map.keyframes) > 1:
            frames = self._intermediate_frames or self._new_intermediate_frames()
            frames.adjust(self.map, self._reprojection, self._history)
        return self.trajectory()

    def trajectory(self) -> Trajectory:
        """Return the poses of all tracked frames as the map has them now, smoothed.

        Each pose is relative to a keyframe, and moves with it.
        """
        tracked = self._history.tracked_poses(self.map)
        poses = tracked.T_cw
        if self.config.smoothing.enabled and len(poses):
            poses = smooth_trajectory(tracked, self.config.smoothing, self.config.motion)
        return Trajectory(tracked.timestamps, inverse(poses))

    @property
    def num_loops(self) -> int:
        """Return the number of loops closed so far."""
        return self._mapper.num_loops

    def _build_parts(self, executor: Executor | None) -> TrackerParts:
        """Build the components of the tracker, each with its own options."""
        config, camera = self.config, self.camera
        motion = MotionModel(config.motion)
        extractor = OrbExtractor(camera, config.features)
        measurer = FrameMeasurer(extractor, motion)
        localizer_config = LocalizerConfig(
            config.tracking, config.ransac, config.matching, config.motion_segmentation
        )
        has_flow = executor is not None and config.flow.enabled
        refiner = PatchRefiner(self.map, config.refinement) if config.refinement.enabled else None
        free_space = FreeSpaceChecker(camera, config.free_space, config.surfaces)
        return TrackerParts(
            point_map=self.map,
            extractor=extractor,
            motion=motion,
            measurer=measurer,
            localizer=Localizer(self.map, self._reprojection, localizer_config, config.seed),
            keyframe_policy=KeyframePolicy(config.keyframes, has_flow),
            mapper=self._build_mapper(refiner, executor, has_flow),
            free_space=free_space,
            dynamic_mask=DynamicMaskEstimator(free_space) if config.free_space.enabled else None,
            refiner=refiner,
            flow=(
                FlowTracker(self.map, self._reprojection, measurer, config.flow)
                if has_flow
                else None
            ),
            history=FrameHistory(),
            intermediate_frames=(
                self._new_intermediate_frames() if config.bundle_adjustment.use_all_frames else None
            ),
        )

    def _build_mapper(
        self, refiner: PatchRefiner | None, executor: Executor | None, incremental: bool
    ) -> LocalMapper:
        """Build the mapper with its loop closer."""
        config = self.config
        loop_closer = None
        if config.loops.enabled:
            loop_config = LoopCloserConfig(
                config.loops,
                config.loop_verification,
                config.matching,
                config.ransac,
                config.bundle_adjustment,
            )
            loop_closer = LoopCloser(self.map, self._reprojection, loop_config, config.seed)
        mapper_config = LocalMapperConfig(
            config.bundle_adjustment,
            config.keyframe_culling,
            config.depth.limit_m(self.camera.baseline),
        )
        return LocalMapper(
            self.map,
            self._reprojection,
            mapper_config,
            refiner,
            loop_closer,
            executor,
            incremental,
        )

    def _new_intermediate_frames(self) -> IntermediateFrames:
        """Return an empty store of the observations of frames between keyframes."""
        config = self.config
        return IntermediateFrames(config.bundle_adjustment, config.motion.prior_below_points)

    def _check(self, frame: RGBDFrame, mask: Mask | None) -> None:
        """Raise DataError for a frame that does not fit the camera or does not follow the last."""
        size = (self.camera.height, self.camera.width)
        where, rgb, depth = f"frame at {frame.timestamp:.6f} s", frame.rgb, frame.depth
        if rgb.shape != (*size, 3) or rgb.dtype != np.uint8:
            raise DataError(f"{where}: rgb is {rgb.dtype} {rgb.shape}, not uint8 {(*size, 3)}")
        if depth.shape != size or not np.issubdtype(depth.dtype, np.floating):
            raise DataError(f"{where}: depth is {depth.dtype} {depth.shape}, not float {size} in m")
        if mask is not None and (mask.shape != size or mask.dtype != np.bool_):
            raise DataError(f"{where}: mask is {mask.dtype} {mask.shape}, not bool {size}")
        last = self._last_timestamp
        if not math.isfinite(frame.timestamp) or (last is not None and frame.timestamp <= last):
            after = "" if last is None else f", at {last:.6f} s"
            raise DataError(f"{where}: not after the frame before it{after}")


def _reprojection_model(camera: Camera, config: SlamConfig) -> ReprojectionModel:
    """Return the camera model of measurements, with a stereo pair's baseline or a virtual one."""
    if camera.baseline:
        return ReprojectionModel(camera, camera.fx * camera.baseline)
    return ReprojectionModel(camera, config.bundle_adjustment.virtual_bf_px_m)
