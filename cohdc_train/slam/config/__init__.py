"""Options of the SLAM system, one frozen dataclass per component."""

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
from cohdc_train.slam.config.reading import as_plain
from cohdc_train.slam.config.sensors import DenseCloudConfig, StereoConfig
from cohdc_train.slam.config.slam_config import SlamConfig
from cohdc_train.slam.config.tracking import (
    FlowConfig,
    KeyframeConfig,
    MotionModelConfig,
    RansacConfig,
    RealtimeConfig,
    TrackingConfig,
)

__all__ = [
    "BundleAdjustmentConfig",
    "DenseCloudConfig",
    "DepthConfig",
    "FeatureConfig",
    "FlowConfig",
    "FreeSpaceConfig",
    "KeyframeConfig",
    "KeyframeCullingConfig",
    "LoopConfig",
    "LoopVerificationConfig",
    "MappingConfig",
    "MaskConfig",
    "MatchingConfig",
    "MotionModelConfig",
    "MotionSegmentationConfig",
    "RansacConfig",
    "RealtimeConfig",
    "RefinementConfig",
    "SlamConfig",
    "SmoothingConfig",
    "StereoConfig",
    "SurfaceConfig",
    "TrackingConfig",
    "as_plain",
]
