"""Train an instance segmenter on COCO-format data, verify its ONNX, and run RGB-D SLAM with it."""

__version__ = "0.1.0"
