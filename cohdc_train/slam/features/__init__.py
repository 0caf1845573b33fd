"""Keypoints, descriptors and matching."""
