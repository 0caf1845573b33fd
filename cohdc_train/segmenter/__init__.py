"""Instance segmentation by an ONNX file (onnxruntime, no torch)."""

from cohdc_train.segmenter.detections import Detections
from cohdc_train.segmenter.segmenter import Segmenter

__all__ = ["Detections", "Segmenter"]
