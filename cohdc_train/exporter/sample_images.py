"""Pictures to compare and to calibrate on: from a folder, or drawn."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from cohdc_train.errors import CohdcError
from cohdc_train.images import IMAGE_SUFFIXES, read_rgb
from cohdc_train.types import Image


def read_images(folder: Path, count: int) -> Iterator[Image]:
    """`count` pictures (all, when there are fewer) spread evenly over a folder by name, uint8 [H,
    W, 3] RGB.

    Raises CohdcError naming the folder at once when it holds none, and a file that is no picture
    when it is reached.
    """
    if not folder.is_dir():
        raise CohdcError(f"{folder}: no such folder")
    names = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not names:
        raise CohdcError(f"{folder}: 0 images")
    chosen = (
        names if len(names) <= count else [names[i * len(names) // count] for i in range(count)]
    )
    return map(_read, chosen)


def _read(path: Path) -> Image:
    pixels = read_rgb(path)
    if pixels is None:
        raise CohdcError(f"{path}: not an image")
    return pixels


def drawn_images(count: int) -> list[Image]:
    """Pictures of overlapping shapes on a noisy ground, always the same, uint8 [240, 320, 3]."""
    rng = np.random.default_rng(0)
    pictures = []
    for _ in range(count):
        picture = rng.integers(80, 140, (240, 320, 3)).astype(np.uint8)
        for _ in range(6):
            centre = (int(rng.integers(0, 320)), int(rng.integers(0, 240)))
            axes = (int(rng.integers(8, 40)), int(rng.integers(20, 80)))
            colour = [int(c) for c in rng.integers(0, 255, 3)]
            cv2.ellipse(picture, centre, axes, float(rng.uniform(-30, 30)), 0, 360, colour, -1)
        pictures.append(cv2.GaussianBlur(picture, (3, 3), 0).astype(np.uint8))
    return pictures
