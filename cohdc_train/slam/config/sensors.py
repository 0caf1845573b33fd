"""Options of stereo depth and of the dense cloud."""

from dataclasses import dataclass

from cohdc_train.slam.config.checks import Check


@dataclass(frozen=True)
class StereoConfig:
    """Depth of a rectified stereo pair by semi-global matching.

    Args:
        max_time_difference_s: largest time between the two images of a pair, s.
        max_disparity_ratio: largest disparity, as a share of the image's width.
        block_px: side of the matched block, px, odd.
    """

    max_time_difference_s: float = 0.005
    max_disparity_ratio: float = 0.2
    block_px: int = 5

    def __post_init__(self) -> None:
        check = Check("stereo", self)
        check.at_least(0, "max_time_difference_s")
        check.within(0.01, 1, "max_disparity_ratio")
        check.within(1, 31, "block_px")


@dataclass(frozen=True)
class DenseCloudConfig:
    """Fusion of the keyframes' depth images into cloud.ply, and the points of map.ply.

    Args:
        voxel_m: side of a voxel of cloud.ply, m.
        max_voxels: voxels held before their side doubles.
        max_depth_step_ratio: depth step within two pixels, as a share of the depth, above which a
            reading is refused.
        mask_margin_ratio: dilation of masks, as a share of the image's width.
        depth_noise: noise a + b z^2 of depth z: a in m, and b in 1/m, of a Kinect.
        free_space_weight: observations of a point that one view through it outweighs.
        min_keyframes: keyframes that must show a voxel: 1 or 2.
        min_observations: keyframes that must observe a point of map.ply.
    """

    voxel_m: float = 0.01
    max_voxels: int = 4_000_000
    max_depth_step_ratio: float = 0.04
    mask_margin_ratio: float = 0.01
    depth_noise: tuple[float, float] = (0.03, 0.01)
    free_space_weight: int = 2
    min_keyframes: int = 2
    min_observations: int = 3

    def __post_init__(self) -> None:
        check = Check("dense_cloud", self)
        check.above(0, "voxel_m", "max_depth_step_ratio")
        check.at_least(1, "max_voxels", "min_observations")
        check.at_least(0, "mask_margin_ratio", "depth_noise", "free_space_weight")
        check.within(1, 2, "min_keyframes")
