"""Detections of one image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.masks import paste_roi_mask
from cohdc_train.types import Float32Array, IntArray, Mask


@dataclass(frozen=True)
class Detections:
    """Detections of one image, sorted by score, the highest first.

    Attributes:
        boxes: float32 [N, 4] xyxy, px of the image.
        labels: int64 [N], index into class_names.
        scores: float32 [N], class score, 0..1.
        quality: float32 [N], CQE's estimate of the mask's IoU with its object, 0..1; 1 where the
            network has no CQE head.
        roi_masks: float32 [N, M, M], probability of the object inside its box.
        size: (height, width) of the image, px.
        class_names: name of each label.

    Raises:
        ValueError: an array has the wrong shape.
    """

    boxes: Float32Array
    labels: IntArray
    scores: Float32Array
    quality: Float32Array
    roi_masks: Float32Array
    size: tuple[int, int]
    class_names: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check the shapes."""
        n = len(self.boxes)
        expected = {"boxes": (n, 4), "labels": (n,), "scores": (n,), "quality": (n,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} is {getattr(self, name).shape}, expected {shape}")
        shape = self.roi_masks.shape
        if len(shape) != 3 or shape[0] != n or shape[1] != shape[2]:
            raise ValueError(f"roi_masks is {shape}, expected ({n}, M, M)")

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.boxes)

    def select(self, keep: NDArray[np.bool_]) -> "Detections":
        """Return the detections where `keep` is True. keep: bool [N]."""
        return Detections(
            self.boxes[keep],
            self.labels[keep],
            self.scores[keep],
            self.quality[keep],
            self.roi_masks[keep],
            self.size,
            self.class_names,
        )

    def masks(self, threshold: float = 0.5) -> NDArray[np.bool_]:
        """Paste the masks into the image.

        Args:
            threshold: lowest probability of a pixel of the object.

        Returns:
            bool [N, H, W].
        """
        if not len(self):
            return np.zeros((0, *self.size), dtype=np.bool_)
        pairs = zip(self.roi_masks, self.boxes, strict=True)
        return np.stack([paste_roi_mask(mask, box, self.size, threshold) for mask, box in pairs])

    def mask(self, threshold: float = 0.5) -> Mask:
        """Return the union of all masks: bool [H, W], True on any object.

        Args:
            threshold: lowest probability of a pixel of an object.
        """
        union = np.zeros(self.size, dtype=np.bool_)
        for roi_mask, box in zip(self.roi_masks, self.boxes, strict=True):
            union |= paste_roi_mask(roi_mask, box, self.size, threshold)
        return union
