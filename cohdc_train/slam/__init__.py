"""RGB-D SLAM that survives moving people (no torch)."""
