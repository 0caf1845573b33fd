"""Nonlinear least squares over poses, points, and images."""
