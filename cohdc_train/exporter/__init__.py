"""Checkpoint to ONNX, float32 and int8, each compared with the network before it is kept."""
