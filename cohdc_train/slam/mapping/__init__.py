"""The map of keyframes and points, and its upkeep."""
