"""Options of `cohdc predict`."""

from dataclasses import dataclass
from typing import Literal

from cohdc_train.contour import ContourMethod
from cohdc_train.errors import DataError

AnnotationFormat = Literal["coco", "labelme", "yolo"]


@dataclass(frozen=True)
class PredictOptions:
    """Options of `cohdc predict`: which detections are kept, and how they are written.

    Attributes:
        score: lowest class score that is kept.
        quality: lowest mask quality that is kept; nothing is dropped for its quality when not
            given.
        format: coco, labelme or yolo.
        contour: how outlines become polygons: bas_dp has the fewest vertices, bisection is the
            fastest; dp has a fixed tolerance of 2 px and no floor.
        iou_floor: lowest IoU of a written polygon with its mask; 1 keeps every pixel.
        check_below: mask quality below which labelme files mark a contour to be checked.
        threads: number of threads of onnxruntime; 0 lets onnxruntime choose.
        frames: largest number of images; when not given all, and 100 of a webcam.
    """

    score: float = 0.5
    quality: float | None = None
    format: AnnotationFormat = "coco"
    contour: ContourMethod = "bas_dp"
    iou_floor: float = 0.95
    check_below: float = 0.7
    threads: int = 0
    frames: int | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("score", "quality", "iou_floor", "check_below"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= 1:
                raise DataError(f"{name} is {value:g}; it must lie within 0..1")
