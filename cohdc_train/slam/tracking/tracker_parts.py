"""Components of a tracker."""

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
    """Components of a tracker; optional ones are None where they are disabled.

    mapper: inserts keyframes; history, intermediate_frames: poses and observations of tracked
    frames for the end of the sequence.
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
