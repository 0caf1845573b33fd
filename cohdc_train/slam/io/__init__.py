"""Sources of frames, and the files of results."""
