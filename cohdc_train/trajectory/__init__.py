"""Trajectories: TUM files, association with ground truth, ATE and RPE."""
