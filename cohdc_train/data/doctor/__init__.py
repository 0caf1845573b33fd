"""Find what is wrong with a COCO-format folder, and fix it."""
