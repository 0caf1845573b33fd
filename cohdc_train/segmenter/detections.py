"""What was found in one image."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.masks import paste_roi_mask


@dataclass(frozen=True)
class Detections:
    """What was found in one image, rows falling by score.

    Attributes:
        boxes: float32 [N, 4] xyxy, px of the image.
        labels: int64 [N], index into class_names.
        scores: float32 [N], class score.
        quality: float32 [N], CQE's estimate of the mask's IoU with its object (1 where the network
            has no CQE head).
        roi_masks: float32 [N, M, M], probability inside the box.
        size: (height, width) of the image, px.
        class_names: name per label.
    """

    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    scores: NDArray[np.float32]
    quality: NDArray[np.float32]
    roi_masks: NDArray[np.float32]
    size: tuple[int, int]
    class_names: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.boxes)
        expected = {"boxes": (n, 4), "labels": (n,), "scores": (n,), "quality": (n,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} is {getattr(self, name).shape}, expected {shape}")
        if (
            self.roi_masks.ndim != 3
            or len(self.roi_masks) != n
            or self.roi_masks.shape[1] != self.roi_masks.shape[2]
        ):
            raise ValueError(f"roi_masks is {self.roi_masks.shape}, expected ({n}, M, M)")

    def __len__(self) -> int:
        return len(self.boxes)

    def select(self, keep: NDArray[np.bool_]) -> "Detections":
        """The rows where keep [N] is True."""
        rows = (
            self.boxes[keep],
            self.labels[keep],
            self.scores[keep],
            self.quality[keep],
            self.roi_masks[keep],
        )
        return Detections(*rows, self.size, self.class_names)

    def masks(self, threshold: float = 0.5) -> NDArray[np.bool_]:
        """[N, H, W] bool: each object's pixels in the image."""
        if not len(self):
            return np.zeros((0, *self.size), dtype=np.bool_)
        pairs = zip(self.roi_masks, self.boxes, strict=True)
        return np.stack([paste_roi_mask(mask, box, self.size, threshold) for mask, box in pairs])
