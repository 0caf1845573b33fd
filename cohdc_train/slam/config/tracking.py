"""Options of tracking: pose, keyframe decision, motion model, optical flow, and pace."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class TrackingConfig:
    """Pose of a frame against the map.

    Args:
        min_points_to_initialize: keypoints with depth that the first keyframe needs.
        local_keyframes: keyframes whose points make up the local map.
        min_inliers_rough: inliers of a rough pose, before the local map is searched.
        min_inliers: inliers of a pose against the local map.
        min_inliers_relocalization: the limit of min_inliers after the track was lost.
        min_match_ratio: share of the last frame's matches that a predicted pose must find again.
        relocalization_candidates: keyframes tried per lost frame.
        radius_predicted_px: search radius around projections by the predicted pose, px.
        radius_last_pose_px: search radius around projections by the last pose, px.
        radius_local_map_px: search radius around projections of the local map, px.
    """

    min_points_to_initialize: int = 50
    local_keyframes: int = 15
    min_inliers_rough: int = 15
    min_inliers: int = 25
    min_inliers_relocalization: int = 40
    min_match_ratio: float = 0.7
    relocalization_candidates: int = 6
    radius_predicted_px: float = 15.0
    radius_last_pose_px: float = 40.0
    radius_local_map_px: float = 5.0

    def __post_init__(self) -> None:
        check = Check("tracking", self)
        check.at_least(6, "min_points_to_initialize")
        check.at_least(1, "local_keyframes", "relocalization_candidates")
        check.at_least(6, "min_inliers_rough", "min_inliers", "min_inliers_relocalization")
        check.within(0, 1, "min_match_ratio")
        check.above(0, "radius_predicted_px", "radius_last_pose_px", "radius_local_map_px")


@dataclass(frozen=True)
class RansacConfig:
    """RANSAC pose of a frame from matches with depth.

    Args:
        hypotheses: triples drawn per frame.
        hypotheses_relocalization: triples drawn per candidate keyframe of a lost frame.
        max_reprojection_px: largest reprojection error of an inlier, px at pyramid level 0.
        max_depth_ratio: largest difference of measured and predicted depth, as a share of the
            depth.
    """

    hypotheses: int = 64
    hypotheses_relocalization: int = 256
    max_reprojection_px: float = 3.0
    max_depth_ratio: float = 0.1

    def __post_init__(self) -> None:
        check = Check("ransac", self)
        check.at_least(1, "hypotheses", "hypotheses_relocalization")
        check.above(0, "max_reprojection_px", "max_depth_ratio")


@dataclass(frozen=True)
class KeyframeConfig:
    """Decision whether a frame becomes a keyframe (as ORB-SLAM2, and stricter in known places).

    Args:
        min_tracked_ratio: share of the matches right after the last keyframe, below which the next
            one is due.
        min_tracked_ratio_flow: the limit of min_tracked_ratio where optical flow tracks, so that
            only every third frame can become a keyframe.
        max_interval_frames: frames after which a keyframe is due in any case.
        known_point_age: keyframes since a point was created, above which it counts as old.
        known_place_ratio: share of a frame's points that are old, from which on its place is known.
        min_known_ratio: share of the old points of the reference keyframe; a known place that is
            tracked worse has changed.
    """

    min_tracked_ratio: float = 0.82
    min_tracked_ratio_flow: float = 0.86
    max_interval_frames: int = 20
    known_point_age: int = 10
    known_place_ratio: float = 0.9
    min_known_ratio: float = 0.7

    def __post_init__(self) -> None:
        check = Check("keyframes", self)
        check.within(0, 1, "min_tracked_ratio", "min_tracked_ratio_flow")
        check.at_least(1, "max_interval_frames")
        check.at_least(0, "known_point_age")
        check.within(0, 1, "known_place_ratio", "min_known_ratio")


@dataclass(frozen=True)
class MotionModelConfig:
    """Constant-velocity Kalman filter of the camera's motion.

    A hand accelerates by 0.2 to 0.6 m/s^2 and 2 to 6 rad/s^2 per axis (RMS at 30 frames/s over the
    seven motion-captured sequences of TUM).

    Args:
        acceleration_sigma: standard deviation of the acceleration, m/s^2 and rad/s^2.
        initial_velocity_sigma: standard deviation of an unknown velocity, m/s and rad/s.
        pose_noise_floor: least standard deviation of a measured pose, m and rad.
        max_gap_s: longest gap between two frames over which the velocity is used, s.
        min_gap_s: shortest gap from which a velocity is computed, s.
        max_prediction_s: time after which the uncertainty stops growing, s.
        prior_below_points: points of a frame, below which the motion prior counts.
        nis_smoothing: weight of the latest frame in the mean normalized innovation squared.
        max_nis: normalized innovation squared above which a pose is a jump.
    """

    acceleration_sigma: tuple[float, float] = (1.0, 4.0)
    initial_velocity_sigma: tuple[float, float] = (1.0, 2.0)
    pose_noise_floor: float = 1e-4
    max_gap_s: float = 0.2
    min_gap_s: float = 1e-3
    max_prediction_s: float = 10.0
    prior_below_points: int = 150
    nis_smoothing: float = 0.2
    max_nis: float = 100.0

    def __post_init__(self) -> None:
        check = Check("motion", self)
        check.above(0, "acceleration_sigma", "initial_velocity_sigma", "pose_noise_floor")
        check.above(0, "max_gap_s", "min_gap_s", "max_prediction_s", "max_nis")
        check.at_least(0, "prior_below_points")
        check.within(0, 1, "nis_smoothing")


@dataclass(frozen=True)
class FlowConfig:
    """Optical-flow tracking between two matched frames, in real time only (Lucas-Kanade).

    Args:
        enabled: in real time, track by flow and match only every third frame with the map.
        frames_between_matches: frames in a row that flow alone tracks.
        max_frames_between_matches: the same while there is no time to match.
        window_px: side of the window around a point, px.
        pyramid_levels: levels of the image pyramid above the image itself.
        max_iterations: iterations per level.
        epsilon_px: step at which the iterations end, px.
        subsample_above: points from which on only some are tracked in a frame.
        subsample: every how many-th point is tracked then, in turns.
        min_inliers: points that must agree on a pose.
        min_inlier_ratio: share of the tracked points that must agree on a pose.
        rematch_below_ratio: share of agreeing points below which the frame is matched.
    """

    enabled: bool = True
    frames_between_matches: int = 2
    max_frames_between_matches: int = 5
    window_px: int = 13
    pyramid_levels: int = 2
    max_iterations: int = 10
    epsilon_px: float = 0.03
    subsample_above: int = 500
    subsample: int = 2
    min_inliers: int = 50
    min_inlier_ratio: float = 0.4
    rematch_below_ratio: float = 0.6

    def __post_init__(self) -> None:
        check = Check("flow", self)
        check.at_least(0, "frames_between_matches", "max_frames_between_matches", "pyramid_levels")
        check.within(3, 101, "window_px")
        check.at_least(1, "max_iterations", "subsample_above", "subsample")
        check.above(0, "epsilon_px")
        check.at_least(6, "min_inliers")
        check.within(0, 1, "min_inlier_ratio", "rematch_below_ratio")


@dataclass(frozen=True)
class RealtimeConfig:
    """Distribution of a frame's time in a real-time run.

    Args:
        match_until: share of the frame period until which a frame may still be matched.
        map_until: share of the frame period until which mapping may still begin a task.
        worker_nice: Unix niceness of the worker process, so that tracking comes first.
    """

    match_until: float = 0.5
    map_until: float = 0.75
    worker_nice: int = 15

    def __post_init__(self) -> None:
        check = Check("realtime", self)
        check.at_least(0, "match_until", "map_until")
        check.within(0, 19, "worker_nice")
