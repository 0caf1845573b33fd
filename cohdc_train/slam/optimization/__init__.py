"""Least squares over poses, points and images."""
