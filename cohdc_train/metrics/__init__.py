"""Scores of instance segmentation."""
