"""Masks of what moves: from a segmenter's ONNX or a folder of PNGs, dilated, True = dynamic."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import View
from cohdc_train.slam.io.tum import read_mask

Mask = NDArray[np.bool_]
MaskSource = Callable[[View], Mask | None]


@dataclass(frozen=True)
class Culling:
    """How a frame's mask is made of what a segmenter or a folder gives.

    Args:
        dynamic_classes: names of the classes that may move; all classes of the model when not given.
        score: detections below this class score are ignored.
        quality: detections below this CQE quality are ignored; the paper's filter is 0.9. A contour left out is a
            person left in: by default none is.
        dilate: px by which a mask grows; a detection of CQE quality q grows by dilate * (1 + doubt * (1 - q)).
        doubt: how much more a contour grows that CQE trusts not at all; at 0 all grow alike. When not given, 1, or 0
            for a network whose masks are cut by quality: a doubtful contour has its doubtful rim already.
    """

    dynamic_classes: list[str] | None = None
    score: float = 0.5
    quality: float = 0.0
    dilate: int = 10
    doubt: float | None = None

    def __post_init__(self) -> None:
        if self.dilate < 0:
            raise DataError(f"dilate is {self.dilate}; it cannot be below 0")
        if self.doubt is not None and not 0 <= self.doubt < float("inf"):
            raise DataError(f"doubt is {self.doubt:g}; it cannot be below 0 or infinite")
        for name in ("score", "quality"):
            if not 0 <= getattr(self, name) <= 1:
                raise DataError(f"{name} is {getattr(self, name):g}; it must lie within 0..1")


def grow(mask: Mask, radius: float) -> Mask:
    """[H, W] bool, True within `radius` px of a True pixel of `mask`."""
    if radius <= 0 or not mask.any():
        return mask
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    window = (_reach(rows, radius), _reach(columns, radius))
    distance = cv2.distanceTransform((~mask[window]).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    grown = np.zeros_like(mask)
    grown[window] = distance <= radius
    return grown


def _reach(places: NDArray[np.int64], radius: float) -> slice:
    """From the first of rising places to the last, with `radius` more on both sides."""
    margin = int(np.ceil(radius))
    return slice(max(int(places[0]) - margin, 0), int(places[-1]) + margin + 1)


def dynamic_mask(detections: Detections, labels: frozenset[int], culling: Culling) -> Mask:
    """The union of the dynamic objects' masks, each grown by what `growth` says of its quality.

    A contour that CQE doubts gets a wider band instead of being left out, for a missed person costs more than lost
    corners.
    Returns [H, W] bool, True = dynamic.
    """
    chosen = dynamic_objects(detections, labels, culling)
    union = np.zeros(detections.size, dtype=np.bool_)
    for mask, quality in zip(chosen.masks(), chosen.quality, strict=True):
        union |= grow(mask, growth(culling, float(quality)))
    return union


def dynamic_objects(detections: Detections, labels: frozenset[int], culling: Culling) -> Detections:
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


class FolderMasks:
    """PNGs that bear the names of the colour images; values above 0 are dynamic."""

    def __init__(self, folder: Path, camera: Camera, culling: Culling) -> None:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of masks")
        self._folder, self._camera, self._culling = folder, camera, culling

    def __call__(self, view: View) -> Mask:
        """[H, W] bool. Raises DataError when the frame's mask is missing: a missed person would spoil the map."""
        return grow(*self.outline(view))

    def outline(self, view: View) -> tuple[Mask, float]:
        """The mask as the file has it, and by how many px it is to grow."""
        return read_mask(self._folder / f"{view.name}.png", self._camera), self._culling.dilate


class ModelMasks:
    """Every frame goes through the segmenter; raises DataError for a class that the model does not know."""

    def __init__(self, segmenter: Segmenter, culling: Culling) -> None:
        names = segmenter.class_names
        wanted = names if culling.dynamic_classes is None else culling.dynamic_classes
        unknown = [name for name in wanted if name not in names]
        if unknown:
            raise DataError(f"dynamic class {unknown[0]!r} is not one of the model's: {', '.join(names)}")
        self._labels = frozenset(names.index(name) for name in wanted)
        self._segmenter = segmenter
        self._culling = replace(culling, doubt=0.0) if culling.doubt is None and segmenter.cut_by_quality else culling

    def __call__(self, view: View) -> Mask:
        """[H, W] bool."""
        return dynamic_mask(self._segmenter(view.rgb), self._labels, self._culling)

    def outline(self, view: View) -> tuple[Mask, float]:
        """The mask before it grows, and by how many px it is to: as much as its contours should on average."""
        chosen = dynamic_objects(self._segmenter(view.rgb), self._labels, self._culling)
        quality = float(chosen.quality.mean()) if len(chosen) else 1.0
        return np.asarray(chosen.masks().any(axis=0)), growth(self._culling, quality)
