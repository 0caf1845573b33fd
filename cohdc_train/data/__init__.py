"""Data sets in COCO format: read, check, convert and augment."""
