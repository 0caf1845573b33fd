"""The pose of each frame."""
