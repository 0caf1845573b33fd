"""Trajectories, their association with ground truth, and their errors."""
