"""A segmenter on images, folders and videos: overlays and annotation files."""
