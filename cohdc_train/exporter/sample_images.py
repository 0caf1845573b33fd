"""Sample images to compare and to calibrate on: from a folder, or drawn."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from cohdc_train.errors import CohdcError
from cohdc_train.images import IMAGE_SUFFIXES, read_rgb
from cohdc_train.types import Image


def read_samples(folder: Path, count: int) -> Iterator[Image]:
    """Read images that are spread evenly over a folder by name.

    Args:
        folder: folder of images.
        count: number of images; all when the folder has fewer.

    Returns:
        uint8 [H, W, 3] RGB each, read one at a time.

    Raises:
        CohdcError: immediately when the folder holds no image, and later for a broken one.
    """
    if not folder.is_dir():
        raise CohdcError(f"{folder}: no such folder")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise CohdcError(f"{folder}: 0 images")
    if len(files) > count:
        files = [files[i * len(files) // count] for i in range(count)]
    return map(_read, files)


def _read(path: Path) -> Image:
    rgb = read_rgb(path)
    if rgb is None:
        raise CohdcError(f"{path}: not an image")
    return rgb


def draw_samples(count: int) -> list[Image]:
    """Draw images of overlapping shapes on noise, always the same: uint8 [240, 320, 3] each."""
    rng = np.random.default_rng(0)
    images = []
    for _ in range(count):
        image = rng.integers(80, 140, (240, 320, 3)).astype(np.uint8)
        for _ in range(6):
            center = (int(rng.integers(0, 320)), int(rng.integers(0, 240)))
            axes = (int(rng.integers(8, 40)), int(rng.integers(20, 80)))
            color = [int(c) for c in rng.integers(0, 255, 3)]
            angle = float(rng.uniform(-30, 30))
            cv2.ellipse(image, center, axes, angle, 0, 360, color, -1)
        images.append(cv2.GaussianBlur(image, (3, 3), 0).astype(np.uint8))
    return images
