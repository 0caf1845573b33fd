"""Matching of a frame with the map: extraction of its keypoints, and its pose."""

from dataclasses import replace

import numpy as np

from cohdc_train.slam.config import TrackingConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import gray_of
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.tracking.motion_model import Prediction
from cohdc_train.slam.tracking.pose_estimate import FrameFeatures, PoseEstimate
from cohdc_train.slam.tracking.tracker_parts import TrackerParts
from cohdc_train.types import Mask

_FIRST_INFORMATION = 1e9  # of the first pose, which is the origin of the world


class FrameMatcher:
    """Matcher that extracts a frame's keypoints and estimates its pose against the map."""

    def __init__(self, parts: TrackerParts, config: TrackingConfig) -> None:
        self._parts = parts
        self._map = parts.point_map
        self._config = config

    def match(
        self,
        frame: RGBDFrame,
        mask: Mask | None,
        last: PoseEstimate | None,
        prediction: Prediction | None,
        flow_estimate: PoseEstimate | None = None,
    ) -> tuple[PoseEstimate | None, FrameFeatures]:
        """Estimate the pose of a frame against the map; the flow estimate is the fallback.

        Args:
            frame: the frame.
            mask: [H, W] bool, as given.
            last: estimate of the frame before, None unless tracking.
            prediction: predicted pose of this frame.
            flow_estimate: pose by optical flow.

        Returns:
            The pose, None where both fail, and the frame's keypoints.
        """
        dynamic_mask = self._estimate_dynamic_mask(frame, mask, last, prediction)
        refiner = self._parts.refiner
        pyramid = None if refiner is None else refiner.pyramid(gray_of(frame.rgb))

        extracted = FrameFeatures(self._extract(frame, dynamic_mask), dynamic_mask, pyramid)
        estimate = self._localize(frame, extracted, last, prediction, flow_estimate)

        # The mask may cover all mapped points. They are static: match the whole image.
        if estimate is None and dynamic_mask is not None and self._map.keyframes:
            extracted = replace(extracted, features=self._extract(frame, None))
            estimate = self._localize(frame, extracted, last, prediction, flow_estimate)
            if estimate is not None:
                estimate = replace(estimate, allows_keyframe=False)

        if estimate is None and flow_estimate is not None:
            return flow_estimate, flow_estimate.frame_features
        return estimate, extracted

    def _estimate_dynamic_mask(
        self,
        frame: RGBDFrame,
        mask: Mask | None,
        last: PoseEstimate | None,
        prediction: Prediction | None,
    ) -> Mask | None:
        """Return the mask without static objects, and with the moving objects that depth shows."""
        if self._parts.dynamic_mask is None or last is None or prediction is None:
            return mask
        neighbors = self._map.covisible(last.matches.point_ids, self._config.local_keyframes)
        T_cw = prediction.prior.T_cw
        return self._parts.dynamic_mask.estimate(
            mask, frame.depth, T_cw, neighbors, frame.timestamp
        )

    def _extract(self, frame: RGBDFrame, mask: Mask | None) -> Features:
        """Extract the keypoints of a frame outside a mask, with depth."""
        keypoints = self._parts.extractor.find(frame.rgb, mask)
        return self._parts.measurer.measure(keypoints, frame, mask)

    def _localize(
        self,
        frame: RGBDFrame,
        extracted: FrameFeatures,
        last: PoseEstimate | None,
        prediction: Prediction | None,
        flow_estimate: PoseEstimate | None,
    ) -> PoseEstimate | None:
        """Estimate the pose against the map, by refined keypoints if possible."""
        if not self._map.keyframes:
            return self._initialize(extracted)
        localizer = self._parts.localizer
        if last is None or prediction is None:
            estimate = localizer.relocalize(extracted, frame.rgb)
        else:
            estimate = localizer.track_local_map(
                extracted, frame.rgb, last, prediction, flow_estimate
            )
        if estimate is None:
            return None
        if self._parts.refiner is not None and extracted.pyramid is not None:
            features = self._parts.refiner.refine(
                extracted.features, estimate.matches, estimate.T_cw, extracted.pyramid
            )
            refined = localizer.refine_pose(replace(extracted, features=features), estimate)
            if refined is not None or features is extracted.features:
                return refined
        return localizer.refine_pose(extracted, estimate)

    def _initialize(self, extracted: FrameFeatures) -> PoseEstimate | None:
        """Return the first pose of a map, None where the frame has too few points with depth."""
        num_points = np.count_nonzero(~np.isnan(extracted.features.depths))
        if num_points < self._config.min_points_to_initialize:
            return None
        none = np.zeros(0, dtype=np.int64)
        information = _FIRST_INFORMATION * np.eye(6)
        return PoseEstimate(np.eye(4), Matches(none, none), extracted, information=information)
