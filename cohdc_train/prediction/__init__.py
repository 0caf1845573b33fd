"""Prediction on images, folders and videos: overlays and annotation files (no torch)."""
