"""Sources of dynamic masks: an ONNX segmenter or a folder of PNG files."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.slam.config import MaskConfig
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import read_mask
from cohdc_train.types import Mask

if TYPE_CHECKING:  # it loads onnxruntime, which a run without a model does not need
    from cohdc_train.segmenter import Detections, Segmenter

MaskSource = Callable[[RGBDFrame], Mask | None]


def dynamic_mask(detections: "Detections", labels: frozenset[int], config: MaskConfig) -> Mask:
    """Merge the masks of dynamic objects, each dilated according to its CQE quality.

    A contour of low quality gets a wider margin rather than being dropped, because a missed person
    costs more accuracy than lost keypoints.

    Args:
        detections: of one image.
        labels: of the dynamic classes.
        config: thresholds and dilation.

    Returns:
        [H, W] bool, True = dynamic.
    """
    dynamic = select_dynamic(detections, labels, config)
    union = np.zeros(detections.size, dtype=np.bool_)
    for mask, quality in zip(dynamic.masks(), dynamic.quality, strict=True):
        union |= dilate_mask(mask, dilation_for(config, float(quality)))
    return union


def select_dynamic(
    detections: "Detections", labels: frozenset[int], config: MaskConfig
) -> "Detections":
    """Select the detections of dynamic classes whose score and quality suffice."""
    confident = (detections.scores >= config.min_score) & (detections.quality >= config.min_quality)
    return detections.select(confident & np.isin(detections.labels, list(labels)))


def dilation_for(config: MaskConfig, quality: float) -> float:
    """Return the dilation, px, of a contour with a CQE quality from 0 to 1."""
    factor = 1.0 if config.quality_dilation is None else config.quality_dilation
    doubt = 1.0 - min(max(quality, 0.0), 1.0)
    return config.dilation_px * (1.0 + factor * doubt)


def no_masks(frame: RGBDFrame) -> Mask | None:
    """Return None, for sequences without moving objects or without a segmenter."""
    return None


class MaskFolder:
    """Folder of PNG masks with the names of the color images; values above 0 are dynamic."""

    def __init__(self, folder: Path, camera: Camera, config: MaskConfig) -> None:
        """Check that the folder exists; raises DataError where it does not."""
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of masks")
        self._folder = folder
        self._camera = camera
        self._config = config

    def __call__(self, frame: RGBDFrame) -> Mask:
        """Read and dilate the mask of a frame.

        Returns:
            [H, W] bool, True = dynamic.

        Raises:
            DataError: the file is missing, for a person without a mask would spoil the map.
        """
        return dilate_mask(*self.segment(frame))

    def segment(self, frame: RGBDFrame) -> tuple[Mask, float]:
        """Return the mask as the file holds it [H, W], and the dilation that is due, px."""
        return read_mask(self._folder / f"{frame.name}.png", self._camera), self._config.dilation_px


class SegmenterMasks:
    """Masks of the dynamic classes that a segmenter detects in each frame."""

    def __init__(self, segmenter: "Segmenter", config: MaskConfig) -> None:
        """Look up the dynamic classes.

        Args:
            segmenter: that runs on each frame.
            config: classes, thresholds and dilation. Where `quality_dilation` is not given, a
                network whose masks are cut by quality gets no additional dilation.

        Raises:
            DataError: the model has no such class.
        """
        names = segmenter.class_names
        wanted = names if config.dynamic_classes is None else config.dynamic_classes
        unknown = [name for name in wanted if name not in names]
        if unknown:
            known = ", ".join(names)
            raise DataError(f"dynamic class {unknown[0]!r} is not one of the model's: {known}")
        if config.quality_dilation is None and segmenter.cut_by_quality:
            config = replace(config, quality_dilation=0.0)
        self._labels = frozenset(names.index(name) for name in wanted)
        self._segmenter = segmenter
        self._config = config

    def __call__(self, frame: RGBDFrame) -> Mask:
        """Segment a frame; returns the dilated mask [H, W] bool, True = dynamic."""
        return dynamic_mask(self._segmenter(frame.rgb), self._labels, self._config)

    def segment(self, frame: RGBDFrame) -> tuple[Mask, float]:
        """Segment a frame without dilation.

        Returns:
            The mask [H, W] bool, and the dilation in px that suits the mean quality of its objects.
        """
        dynamic = select_dynamic(self._segmenter(frame.rgb), self._labels, self._config)
        quality = float(dynamic.quality.mean()) if len(dynamic) else 1.0
        return np.asarray(dynamic.masks().any(axis=0)), dilation_for(self._config, quality)
