"""Options of keypoints and of their matching."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class FeatureConfig:
    """ORB keypoints and their depth.

    Pyramid, grid, and FAST thresholds follow ORB-SLAM2's extractor.

    Args:
        max_keypoints: keypoints per frame.
        scale_factor: size ratio of two neighboring levels of the image pyramid.
        num_levels: levels of the image pyramid, the image itself included.
        fast_thresholds: FAST thresholds, gray levels, tried from the first to the last until enough
            keypoints are detected.
        grid_cell_px: side of a grid cell, px at the keypoint's level; keypoints are spread over
            cells.
        oversampling: keypoints detected per keypoint kept.
        min_oversampling: keypoints detected per keypoint kept, below which the next threshold is
            tried.
        subpixel_sigma_px: standard deviation of a keypoint refined by its patch, px at its level;
            an unrefined keypoint has 1.
        depth_patch_radius_px: radius around a keypoint that must be free of depth edges, px.
        max_depth_step_ratio: depth step inside that patch, as a share of the depth, above which it
            is an edge.
        mask_margin_px: distance from the dynamic mask within which depth is refused, px.
    """

    max_keypoints: int = 1500
    scale_factor: float = 1.2
    num_levels: int = 8
    fast_thresholds: tuple[int, ...] = (40, 20, 12, 7)
    grid_cell_px: int = 32
    oversampling: float = 2.0
    min_oversampling: float = 1.6
    subpixel_sigma_px: float = 0.3
    depth_patch_radius_px: int = 2
    max_depth_step_ratio: float = 0.04
    mask_margin_px: int = 2

    def __post_init__(self) -> None:
        check = Check("features", self)
        check.at_least(1, "max_keypoints", "grid_cell_px", "oversampling")
        check.within(1.01, 4, "scale_factor")
        check.within(1, 16, "num_levels")
        check.within(1, 255, "fast_thresholds")
        check.at_least(0, "min_oversampling", "depth_patch_radius_px", "mask_margin_px")
        check.within(0.01, 1, "subpixel_sigma_px")
        check.above(0, "max_depth_step_ratio")


@dataclass(frozen=True)
class MatchingConfig:
    """Matching of map points with keypoints.

    Args:
        max_radius_scale: largest factor by which a search radius grows with a keypoint's level.
        max_hamming: largest descriptor distance of a match near a projection, of 256 bits.
        ratio: share of the second-best distance that the best must stay below (Lowe's ratio test).
        max_hamming_unguided: the limit of max_hamming where no pose is known.
        min_view_cosine: least cosine between the direction of view and the mean direction from
            which a point was observed, as in ORB-SLAM2.
    """

    max_radius_scale: float = 2.0
    max_hamming: int = 90
    ratio: float = 0.9
    max_hamming_unguided: int = 60
    min_view_cosine: float = 0.5

    def __post_init__(self) -> None:
        check = Check("matching", self)
        check.at_least(1, "max_radius_scale")
        check.within(0, 256, "max_hamming", "max_hamming_unguided")
        check.within(0, 1, "ratio")
        check.within(-1, 1, "min_view_cosine")


@dataclass(frozen=True)
class RefinementConfig:
    """Photometric refinement of matched keypoints by the patch of their point (paper eqs. 8, 9).

    Args:
        enabled: move matched keypoints to where their points' patches fit best.
        patch_px: side of a stored patch, px at its keypoint's level.
        template_px: side of the part of it that is compared, px.
        max_level: coarsest pyramid level whose keypoints are refined; coarser patches are large,
            and rarely show a plane.
        max_iterations: Gauss-Newton iterations.
        max_shift_px: largest shift, px at the keypoint's level; a better fit further away is
            another place.
        epsilon_px: step at which the iterations end, px.
        min_correlation: least normalized correlation of patch and image.
        min_eigenvalue: least eigenvalue of the patch's gradient matrix, squared gray levels; a
            patch below has no texture.
    """

    enabled: bool = True
    patch_px: int = 16
    template_px: int = 8
    max_level: int = 4
    max_iterations: int = 3
    max_shift_px: float = 1.5
    epsilon_px: float = 0.03
    min_correlation: float = 0.8
    min_eigenvalue: float = 400.0

    def __post_init__(self) -> None:
        check = Check("refinement", self)
        check.within(4, 64, "patch_px")
        check.within(2, 64, "template_px")
        check.at_least(0, "max_level", "max_shift_px", "min_eigenvalue")
        check.at_least(1, "max_iterations")
        check.above(0, "epsilon_px")
        check.within(-1, 1, "min_correlation")
