"""Masks and moving objects."""
