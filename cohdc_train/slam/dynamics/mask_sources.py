"""Masks of what moves: from a segmenter's ONNX or a folder of PNGs, dilated, True = dynamic."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.slam.config import Culling
from cohdc_train.slam.dynamics.masks import grow
from cohdc_train.slam.frame import View
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import read_mask
from cohdc_train.types import Mask

if TYPE_CHECKING:  # it loads onnxruntime, which a run without a model does not need
    from cohdc_train.segmenter import Detections, Segmenter

MaskSource = Callable[[View], Mask | None]


def dynamic_mask(detections: "Detections", labels: frozenset[int], culling: Culling) -> Mask:
    """The union of the dynamic objects' masks, each grown by what `growth` says of its quality.

    A contour that CQE doubts gets a wider band instead of being left out, for a missed person costs
    more than lost corners.
    Returns [H, W] bool, True = dynamic.
    """
    chosen = dynamic_objects(detections, labels, culling)
    union = np.zeros(detections.size, dtype=np.bool_)
    for mask, quality in zip(chosen.masks(), chosen.quality, strict=True):
        union |= grow(mask, growth(culling, float(quality)))
    return union


def dynamic_objects(
    detections: "Detections", labels: frozenset[int], culling: Culling
) -> "Detections":
    """Those of the dynamic classes that are sure enough."""
    sure = (detections.scores >= culling.score) & (detections.quality >= culling.quality)
    return detections.select(sure & np.isin(detections.labels, list(labels)))


def growth(culling: Culling, quality: float) -> float:
    """By how many px a contour of a CQE quality grows."""
    doubt = 1.0 if culling.doubt is None else culling.doubt
    return culling.dilate * (1.0 + doubt * (1.0 - min(max(quality, 0.0), 1.0)))


def no_masks(view: View) -> Mask | None:
    """The source for a world that stands still."""
    return None


class MaskFolder:
    """PNGs that bear the names of the colour images; values above 0 are dynamic."""

    def __init__(self, folder: Path, camera: Camera, culling: Culling) -> None:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of masks")
        self._folder, self._camera, self._culling = folder, camera, culling

    def __call__(self, view: View) -> Mask:
        """[H, W] bool. Raises DataError when the frame's mask is missing: a missed person would
        spoil the map.
        """
        return grow(*self.outline(view))

    def outline(self, view: View) -> tuple[Mask, float]:
        """The mask as the file has it, and by how many px it is to grow."""
        return read_mask(self._folder / f"{view.name}.png", self._camera), self._culling.dilate


class SegmenterMasks:
    """Every frame goes through the segmenter; raises DataError for a class that the model does not
    know.
    """

    def __init__(self, segmenter: "Segmenter", culling: Culling) -> None:
        names = segmenter.class_names
        wanted = names if culling.dynamic_classes is None else culling.dynamic_classes
        unknown = [name for name in wanted if name not in names]
        if unknown:
            raise DataError(
                f"dynamic class {unknown[0]!r} is not one of the model's: {', '.join(names)}"
            )
        self._labels = frozenset(names.index(name) for name in wanted)
        self._segmenter = segmenter
        self._culling = (
            replace(culling, doubt=0.0)
            if culling.doubt is None and segmenter.cut_by_quality
            else culling
        )

    def __call__(self, view: View) -> Mask:
        """[H, W] bool."""
        return dynamic_mask(self._segmenter(view.rgb), self._labels, self._culling)

    def outline(self, view: View) -> tuple[Mask, float]:
        """The mask before it grows, and by how many px it is to: as much as its contours should on
        average.
        """
        chosen = dynamic_objects(self._segmenter(view.rgb), self._labels, self._culling)
        quality = float(chosen.quality.mean()) if len(chosen) else 1.0
        return np.asarray(chosen.masks().any(axis=0)), growth(self._culling, quality)
