"""Recognition of places seen before, and loop closure."""
