"""Checkpoint to ONNX, float32 and int8, each proven before it gets its name."""
