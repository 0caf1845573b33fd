"""Point clouds, figures and viewers."""
