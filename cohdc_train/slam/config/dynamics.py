"""Options of masks and moving objects."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class MaskConfig:
    """Masks of dynamic objects from a segmenter or a folder, and their propagation.

    Args:
        dynamic_classes: names of the classes that may move; all classes of the model when not
            given.
        min_score: detections below this class score are ignored.
        min_quality: detections below this CQE quality are ignored; the paper's filter is 0.9. A
            missed person costs more than a doubtful contour: by default none is ignored.
        dilation_px: dilation of a mask, px; a detection of CQE quality q is dilated by
            dilation_px * (1 + quality_dilation * (1 - q)).
        quality_dilation: additional dilation of a contour of quality 0, as a share of dilation_px.
            When not given, 1, or 0 for a network whose masks are cut by quality.
        max_depth_change_m: largest change of an object's depth from one frame to the next, m.
        edge_band_px: radius within which one step may snap the mask's edge to a depth edge, px at
            half size.
        window_px: side of the window that the mask's own depth is averaged over, px at half size.
        max_history: frames through which a delayed mask is propagated one by one.
    """

    dynamic_classes: tuple[str, ...] | None = None
    min_score: float = 0.5
    min_quality: float = 0.0
    dilation_px: int = 10
    quality_dilation: float | None = None
    max_depth_change_m: float = 0.3
    edge_band_px: int = 2
    window_px: int = 15
    max_history: int = 45

    def __post_init__(self) -> None:
        check = Check("masks", self)
        check.within(0, 1, "min_score", "min_quality")
        check.at_least(0, "dilation_px", "edge_band_px", "window_px")
        if self.quality_dilation is not None:
            check.at_least(0, "quality_dilation")
        check.above(0, "max_depth_change_m")
        check.at_least(1, "max_history")


@dataclass(frozen=True)
class FreeSpaceConfig:
    """Moving objects of any class, by depth in space that keyframes saw free (as DynaSLAM).

    Args:
        enabled: detect moving objects by depth, and use masked objects again that stay static.
        cell_px: side of a cell of the depth grid, px.
        min_violation_m: depth by which a point must lie in front of a keyframe's reading, m.
        min_violation_per_m: the same per m of depth, in addition.
        min_depth_m: nearest depth the sensor measures, m.
        max_depth_m: farthest depth used, m.
        min_votes: keyframes that must see through a point.
        growth_cells: cells by which a moving object grows over its own surface.
        min_static_ratio: share of a masked object's readings that must agree with keyframes for it
            to be static.
        max_moving_ratio: free-space violations of a static object, as a share of the readings that
            agree.
        reference_keyframes: keyframes whose depth a frame is compared with.
        mask_margin_px: dilation of the moving objects detected by depth, px.
        recent_s: time for which a surface must be static not to join a moving one, s.
        rest_s: time after which a static object is used again, s.
    """

    enabled: bool = True
    cell_px: int = 8
    min_violation_m: float = 0.1
    min_violation_per_m: float = 0.03
    min_depth_m: float = 0.2
    max_depth_m: float = 5.0
    min_votes: int = 2
    growth_cells: int = 3
    min_static_ratio: float = 0.6
    max_moving_ratio: float = 0.05
    reference_keyframes: int = 8
    mask_margin_px: float = 8.0
    recent_s: float = 0.5
    rest_s: float = 2.0

    def __post_init__(self) -> None:
        check = Check("free_space", self)
        check.within(2, 64, "cell_px")
        check.at_least(0, "min_violation_m", "min_violation_per_m", "growth_cells")
        check.above(0, "min_depth_m", "max_depth_m")
        check.at_least(1, "min_votes", "reference_keyframes")
        check.within(0, 1, "min_static_ratio", "max_moving_ratio")
        check.at_least(0, "mask_margin_px", "recent_s", "rest_s")


@dataclass(frozen=True)
class SurfaceConfig:
    """Extension of moving cells to whole surfaces of the depth grid.

    Args:
        depth_jump_m: depth step between two cells that separates two surfaces, m.
        min_area: cells of a moving surface; smaller ones are noise at edges.
        min_moving_ratio: share of a surface that must move for all of it to move.
        min_continued_ratio: share of it that must have moved in the frame before, to go on.
        max_static_ratio: share of it, at most, that is known to be static.
        memory_s: time for which a surface goes on moving without new evidence, s.
        mask_rim_cells: cells by which a mask is wider than its object, at most.
        max_moving_ratio: share of moving readings above which the pose is taken for wrong.
    """

    depth_jump_m: float = 0.12
    min_area: int = 8
    min_moving_ratio: float = 0.4
    min_continued_ratio: float = 0.5
    max_static_ratio: float = 0.3
    memory_s: float = 0.5
    mask_rim_cells: int = 3
    max_moving_ratio: float = 0.95

    def __post_init__(self) -> None:
        check = Check("surfaces", self)
        check.above(0, "depth_jump_m")
        check.at_least(1, "min_area")
        check.within(0, 1, "min_moving_ratio", "min_continued_ratio", "max_static_ratio")
        check.within(0, 1, "max_moving_ratio")
        check.at_least(0, "memory_s", "mask_rim_cells")


@dataclass(frozen=True)
class MotionSegmentationConfig:
    """Clusters of map points that move against the rest, and the weight of points.

    Args:
        enabled: exclude clusters that move, and reduce the weight of their points.
        num_clusters: patches of neighboring points, the leaves of the tree of clusters.
        min_points: points of a cluster that is judged.
        max_ratio: share of all points above which a cluster is the static world.
        max_track_length: frames for which a point counts at most.
        min_median_chi2: median squared error, in sigmas, from which on a cluster moves.
        max_excess: factor of that limit above which more error counts no more.
        max_iterations: clusters excluded, one after the other.
        static_log_odds: log-odds that a new point is static.
        moving_step: log-odds of motion added by a frame in which a point moves.
        static_step: log-odds of motion subtracted by a frame in which it does not.
        max_log_odds: largest log-odds of motion.
    """

    enabled: bool = True
    num_clusters: int = 24
    min_points: int = 8
    max_ratio: float = 0.6
    max_track_length: int = 30
    min_median_chi2: float = 16.0
    max_excess: float = 4.0
    max_iterations: int = 4
    static_log_odds: float = 3.0
    moving_step: float = 2.0
    static_step: float = 0.25
    max_log_odds: float = 8.0

    def __post_init__(self) -> None:
        check = Check("motion_segmentation", self)
        check.at_least(1, "num_clusters", "min_points", "max_track_length", "max_excess")
        check.within(0, 1, "max_ratio")
        check.above(0, "min_median_chi2")
        check.at_least(0, "max_iterations", "static_log_odds", "moving_step", "static_step")
        check.at_least(0, "max_log_odds")
