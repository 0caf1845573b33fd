"""Faults of a COCO-format folder, and their fixes."""
