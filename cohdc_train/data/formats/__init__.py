"""Annotation formats that become COCO."""
