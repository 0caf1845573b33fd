"""Options of the whole SLAM system."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cohdc_train.errors import DataError
from cohdc_train.slam.config.checks import Check
from cohdc_train.slam.config.dynamics import (
    FreeSpaceConfig,
    MaskConfig,
    MotionSegmentationConfig,
    SurfaceConfig,
)
from cohdc_train.slam.config.features import FeatureConfig, MatchingConfig, RefinementConfig
from cohdc_train.slam.config.loops import LoopConfig, LoopVerificationConfig
from cohdc_train.slam.config.mapping import (
    BundleAdjustmentConfig,
    DepthConfig,
    KeyframeCullingConfig,
    MappingConfig,
    SmoothingConfig,
)
from cohdc_train.slam.config.reading import changed, nested, read_yaml
from cohdc_train.slam.config.sensors import DenseCloudConfig, StereoConfig
from cohdc_train.slam.config.tracking import (
    FlowConfig,
    KeyframeConfig,
    MotionModelConfig,
    RansacConfig,
    RealtimeConfig,
    TrackingConfig,
)


@dataclass(frozen=True)
class SlamConfig:
    """Options of the SLAM system, one section per part; the defaults are the tested ones.

    Args:
        seed: seed of all random samples; the same seed and frames give the same numbers.
        features: keypoints and their depth.
        matching: matching of map points with keypoints.
        refinement: photometric refinement of matched keypoints.
        tracking: pose of a frame against the map.
        ransac: RANSAC pose.
        keyframes: keyframe decision.
        motion: constant-velocity motion model.
        flow: optical-flow tracking in real time.
        realtime: distribution of a frame's time in real time.
        depth: range of usable depth.
        mapping: map points.
        keyframe_culling: culling of redundant keyframes.
        bundle_adjustment: local and global bundle adjustment.
        smoothing: smoothing of the final trajectory.
        masks: masks of dynamic objects.
        free_space: moving objects by depth.
        surfaces: extension of moving cells to surfaces.
        motion_segmentation: clusters of moving points.
        loops: loop closing.
        loop_verification: verification of loop candidates.
        stereo: depth of a stereo pair.
        dense_cloud: dense cloud and map file.
    """

    seed: int = 0
    features: FeatureConfig = field(default_factory=FeatureConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    motion: MotionModelConfig = field(default_factory=MotionModelConfig)
    flow: FlowConfig = field(default_factory=FlowConfig)
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    keyframe_culling: KeyframeCullingConfig = field(default_factory=KeyframeCullingConfig)
    bundle_adjustment: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)
    surfaces: SurfaceConfig = field(default_factory=SurfaceConfig)
    motion_segmentation: MotionSegmentationConfig = field(default_factory=MotionSegmentationConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    loop_verification: LoopVerificationConfig = field(default_factory=LoopVerificationConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    dense_cloud: DenseCloudConfig = field(default_factory=DenseCloudConfig)

    def __post_init__(self) -> None:
        Check("settings", self).at_least(0, "seed")
        needed, given = self.tracking.min_points_to_initialize, self.features.max_keypoints
        if given < needed:
            limit = f"tracking.min_points_to_initialize, {needed}, or more"
            raise DataError(f"features.max_keypoints is {given}; allowed: {limit}")

    @classmethod
    def from_yaml(cls, path: Path) -> "SlamConfig":
        """Read options from a YAML file of sections, or from a run's config.yaml.

        Options that the file does not name keep their defaults.

        Raises:
            DataError: an option is unknown or has a wrong value; the message names file and option.
        """
        return changed(cls(), read_yaml(path), str(path))

    def override(self, options: Mapping[str, object]) -> "SlamConfig":
        """Return a copy with some options changed, such as {"loops.enabled": False}.

        Raises:
            DataError: an option is unknown, or a value has a wrong type or is out of range.
        """
        return changed(self, nested(options), "SlamConfig")
