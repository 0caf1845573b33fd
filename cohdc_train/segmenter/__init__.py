"""An ONNX file -> detections (onnxruntime, never torch)."""

from cohdc_train.segmenter.detections import Detections
from cohdc_train.segmenter.segmenter import Segmenter

__all__ = ["Detections", "Segmenter"]
