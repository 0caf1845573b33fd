"""Parts that a tracker works with."""

from dataclasses import dataclass

from cohdc_train.slam.dynamics.dynamic_mask import DynamicMaskEstimator
from cohdc_train.slam.dynamics.free_space import FreeSpaceChecker
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.mapping.frame_history import FrameHistory
from cohdc_train.slam.mapping.global_bundle_adjustment import IntermediateFrames
from cohdc_train.slam.mapping.local_mapper import LocalMapper
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner
from cohdc_train.slam.tracking.flow_tracker import FlowTracker
from cohdc_train.slam.tracking.frame_measurer import FrameMeasurer
from cohdc_train.slam.tracking.keyframe_policy import KeyframePolicy
from cohdc_train.slam.tracking.localizer import Localizer
from cohdc_train.slam.tracking.motion_model import MotionModel


@dataclass(frozen=True)
class TrackerParts:
    """Parts that a tracker works with; optional ones are None where they are switched off.

    mapper: inserts keyframes; history, intermediate_frames: what tracked frames leave for the end.
    """

    point_map: Map
    extractor: OrbExtractor
    motion: MotionModel
    measurer: FrameMeasurer
    localizer: Localizer
    keyframe_policy: KeyframePolicy
    mapper: LocalMapper
    free_space: FreeSpaceChecker
    dynamic_mask: DynamicMaskEstimator | None
    refiner: PatchRefiner | None
    flow: FlowTracker | None
    history: FrameHistory
    intermediate_frames: IntermediateFrames | None
