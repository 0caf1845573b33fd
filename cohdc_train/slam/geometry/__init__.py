"""Rigid motions, cameras and depth images."""
