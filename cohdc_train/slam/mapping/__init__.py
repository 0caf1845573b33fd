"""Map of keyframes and points, and its maintenance."""
