"""Real time: threads, processes, and the pace of frames."""
