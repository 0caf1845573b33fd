"""Dynamic masks and moving objects."""
