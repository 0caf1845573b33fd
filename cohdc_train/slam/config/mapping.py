"""Options of the map: points, keyframes, bundle adjustment, and smoothing."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class DepthConfig:
    """Range of usable depth, beyond which readings are too inaccurate.

    Args:
        max_depth_m: farthest usable reading of a depth camera, m; a Kinect's error is 4 cm there.
        max_depth_baselines: farthest usable depth of a stereo pair, in baselines (ORB-SLAM2's
            close points).
    """

    max_depth_m: float = 5.0
    max_depth_baselines: float = 40.0

    def __post_init__(self) -> None:
        Check("depth", self).above(0, "max_depth_m", "max_depth_baselines")

    def limit_m(self, baseline_m: float) -> float:
        """Return the farthest usable depth, m. baseline_m: of a stereo pair; 0 = depth camera."""
        return self.max_depth_baselines * baseline_m if baseline_m else self.max_depth_m


@dataclass(frozen=True)
class MappingConfig:
    """Map points: creation, fusion, and culling (as ORB-SLAM2's local mapping).

    Args:
        min_observations: keyframes that must observe a point after its probation.
        probation_keyframes: keyframes after which a new point must have been confirmed.
        min_found_ratio: share of the frames that should observe a point and do.
        min_depth_m: nearest depth at which a point is projected, m.
        observers_per_point: keyframes that a point remembers of those that observe it.
        covisibility_candidates: keyframes compared when the most covisible ones are searched.
        fuse_keyframes: neighbors in which a new keyframe's points are searched.
        fuse_radius_px: search radius for duplicates, px.
        fuse_max_hamming: largest descriptor distance of duplicates, of 256 bits.
        fuse_distance_m: largest distance of duplicates, m.
    """

    min_observations: int = 2
    probation_keyframes: int = 3
    min_found_ratio: float = 0.25
    min_depth_m: float = 0.1
    observers_per_point: int = 8
    covisibility_candidates: int = 64
    fuse_keyframes: int = 8
    fuse_radius_px: float = 3.0
    fuse_max_hamming: int = 60
    fuse_distance_m: float = 0.05

    def __post_init__(self) -> None:
        check = Check("mapping", self)
        check.at_least(1, "min_observations", "observers_per_point", "covisibility_candidates")
        check.at_least(0, "probation_keyframes", "fuse_keyframes")
        check.within(0, 1, "min_found_ratio")
        check.above(0, "min_depth_m", "fuse_radius_px", "fuse_distance_m")
        check.within(0, 256, "fuse_max_hamming")


@dataclass(frozen=True)
class KeyframeCullingConfig:
    """Culling of redundant keyframes (ORB-SLAM's criterion).

    Args:
        enabled: remove keyframes whose points others observe as well.
        redundancy_ratio: share of a keyframe's points that others must observe as well.
        min_other_observers: keyframes that must observe such a point.
        max_coarser_levels: pyramid levels by which their observation may be coarser.
        neighborhood: keyframes examined, those most covisible with the newest.
    """

    enabled: bool = True
    redundancy_ratio: float = 0.9
    min_other_observers: int = 3
    max_coarser_levels: int = 1
    neighborhood: int = 64

    def __post_init__(self) -> None:
        check = Check("keyframe_culling", self)
        check.within(0, 1, "redundancy_ratio")
        check.at_least(1, "min_other_observers", "neighborhood")
        check.within(0, 16, "max_coarser_levels")


@dataclass(frozen=True)
class BundleAdjustmentConfig:
    """Local and global bundle adjustment.

    Args:
        local_keyframes: keyframes of a local bundle adjustment.
        local_fixed: keyframes among them that stay fixed.
        robust_steps: Levenberg-Marquardt steps with the Huber kernel.
        final_steps: steps after that, without outliers and without the kernel.
        virtual_bf_px_m: focal length times virtual baseline of a depth camera, px m; 100 is a
            sigma of 1 cm at 1 m and of 9 cm at 3 m.
        global_enabled: adjust all keyframes when the sequence is over.
        use_all_frames: use what frames between keyframes observed in that adjustment.
        max_frames: frames between keyframes that are kept for it.
        point_subsample: every how many-th point of a matched frame is kept.
    """

    local_keyframes: int = 12
    local_fixed: int = 3
    robust_steps: int = 5
    final_steps: int = 3
    virtual_bf_px_m: float = 100.0
    global_enabled: bool = True
    use_all_frames: bool = True
    max_frames: int = 256
    point_subsample: int = 2

    def __post_init__(self) -> None:
        check = Check("bundle_adjustment", self)
        check.at_least(2, "local_keyframes", "max_frames")
        check.at_least(1, "local_fixed", "point_subsample")
        check.at_least(0, "robust_steps", "final_steps")
        check.above(0, "virtual_bf_px_m")


@dataclass(frozen=True)
class SmoothingConfig:
    """Smoothing of the trajectory by the motion model, when the sequence is over.

    Args:
        enabled: smooth the trajectory.
        pose_floor: standard deviation of a pose that its information does not cover, m and rad.
        min_information: least information of a pose, 1/m^2 and 1/rad^2.
        min_variance_ratio: least factor by which the stated variance of poses is reduced.
        window_frames: frames on either side over which the motion's variance is estimated.
        iterations: iterations of that estimate.
    """

    enabled: bool = True
    pose_floor: float = 2e-3
    min_information: float = 1.0
    min_variance_ratio: float = 0.01
    window_frames: int = 15
    iterations: int = 3

    def __post_init__(self) -> None:
        check = Check("smoothing", self)
        check.at_least(0, "pose_floor")
        check.above(0, "min_information", "min_variance_ratio")
        check.at_least(1, "window_frames", "iterations")
