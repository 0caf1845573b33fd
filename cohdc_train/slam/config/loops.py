"""Options of place recognition, loop verification, and the pose graph."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class LoopConfig:
    """Place recognition, and the pose graph that closes loops (paper section 2.3).

    Args:
        enabled: close loops.
        min_gap_keyframes: newest keyframes that are no loop candidates.
        covisible_points: shared points that make two keyframes neighbors.
        candidates: candidates verified per keyframe.
        min_similarity_ratio: share of the similarity of a keyframe's neighbors that a candidate
            must reach.
        candidate_spacing: keyframes between two candidates.
        fuse_keyframes: keyframes on either side whose duplicate points are fused.
        graph_neighbors: older neighbors of a keyframe in the pose graph, beside the one before it.
        edge_sigma: standard deviation of the relative pose of two keyframes that share edge_points
            points, m and rad.
        edge_points: number of shared points to which edge_sigma applies.
        min_edge_weight: weight that the pose graph must leave to a new loop.
        hash_tables: tables of the locality-sensitive hashing.
        hash_bits: bits of a descriptor per table, of 256.
        graph_rounds: rounds in which the Cauchy kernel narrows.
        graph_steps: Levenberg-Marquardt steps per round.
        cauchy_width: sigmas at which a loop edge has half its weight in the last round.
    """

    enabled: bool = True
    min_gap_keyframes: int = 10
    covisible_points: int = 15
    candidates: int = 2
    min_similarity_ratio: float = 0.7
    candidate_spacing: int = 5
    fuse_keyframes: int = 6
    graph_neighbors: int = 3
    edge_sigma: tuple[float, float] = (0.01, 0.003)
    edge_points: int = 100
    min_edge_weight: float = 0.3
    hash_tables: int = 8
    hash_bits: int = 16
    graph_rounds: int = 6
    graph_steps: int = 4
    cauchy_width: float = 3.0

    def __post_init__(self) -> None:
        check = Check("loops", self)
        check.at_least(1, "min_gap_keyframes", "covisible_points", "candidates", "edge_points")
        check.at_least(0, "min_similarity_ratio", "candidate_spacing", "graph_neighbors")
        check.above(0, "edge_sigma", "cauchy_width")
        check.within(0, 1, "min_edge_weight")
        check.within(1, 24, "hash_bits")
        check.at_least(1, "fuse_keyframes", "hash_tables", "graph_rounds", "graph_steps")


@dataclass(frozen=True)
class LoopVerificationConfig:
    """Verification of a loop candidate by points, neighbors, and images (paper eqs. 10 to 12).

    Args:
        place_keyframes: keyframes around the old one whose points make up the place.
        min_inliers_rough: inliers of descriptor matches alone.
        min_inliers: inliers of all of the place's points.
        hypotheses: RANSAC triples.
        radius_rough_px: search radius after RANSAC, px.
        radius_px: search radius of the final pose, px.
        neighbors: covisible keyframes that are located in the place as well.
        min_agreeing: neighbors that must agree.
        agree_m: largest distance between agreeing positions, m.
        agree_rad: largest angle between agreeing orientations, rad.
        max_error_ratio: photometric error after image alignment over the error before.
        min_correlation: least correlation of the aligned images.
        min_overlap: least share of the old image's pixels that the new one sees.
        min_depth_agreement: least share of these pixels whose depth agrees.
        max_correction_m: largest motion by image alignment, m.
        max_correction_rad: largest rotation by image alignment, rad.
        image_px: longer side of the aligned images, px.
        levels: pyramid levels of image alignment.
        iterations: Gauss-Newton iterations per level.
        max_depth_step_ratio: depth step to a neighboring pixel, as a share of the depth, above
            which a pixel is not used.
        same_depth_ratio: depth difference, as a share of the depth, within which two pixels show
            the same surface.
        clip_sigma: robust sigmas at which residuals are clipped.
        min_pixels: pixels that both images must see.
    """

    place_keyframes: int = 8
    min_inliers_rough: int = 20
    min_inliers: int = 40
    hypotheses: int = 256
    radius_rough_px: float = 10.0
    radius_px: float = 5.0
    neighbors: int = 4
    min_agreeing: int = 2
    agree_m: float = 0.03
    agree_rad: float = 0.02
    max_error_ratio: float = 1.02
    min_correlation: float = 0.75
    min_overlap: float = 0.2
    min_depth_agreement: float = 0.7
    max_correction_m: float = 0.05
    max_correction_rad: float = 0.02
    image_px: int = 160
    levels: int = 2
    iterations: int = 20
    max_depth_step_ratio: float = 0.05
    same_depth_ratio: float = 0.07
    clip_sigma: float = 1.5
    min_pixels: int = 200

    def __post_init__(self) -> None:
        check = Check("loop_verification", self)
        check.at_least(1, "place_keyframes", "hypotheses", "levels", "iterations", "min_pixels")
        check.at_least(6, "min_inliers_rough", "min_inliers")
        check.at_least(0, "neighbors", "min_agreeing", "max_error_ratio")
        check.above(0, "radius_rough_px", "radius_px", "agree_m", "agree_rad")
        check.above(0, "max_correction_m", "max_correction_rad", "clip_sigma")
        check.above(0, "max_depth_step_ratio", "same_depth_ratio")
        check.within(-1, 1, "min_correlation")
        check.within(0, 1, "min_overlap", "min_depth_agreement")
        check.within(32, 2048, "image_px")
