"""Read image files as viewers show them: turned by their EXIF orientation (no torch).

This is the one reader of users' photographs. Annotation tools show the upright image, so labels are
relative to it.
"""

import io
import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

IMAGE_SUFFIXES = frozenset([".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff"])
Size = tuple[int, int]  # width, height, px
_BROKEN_EXIF = (LookupError, OSError, SyntaxError, TypeError, ValueError, struct.error)


def orientation_of(image: Image.Image) -> int:
    """Return the EXIF orientation 1..8 of an image that Pillow opened.

    It is 1 where there is none or it is damaged, and for TIFF, whose pixels OpenCV and Pillow turn
    while they decode.
    """
    if image.format == "TIFF":
        return 1
    try:
        value = image.getexif().get(ExifTags.Base.Orientation, 1)
    except _BROKEN_EXIF:  # viewers show such an image as it is stored
        return 1
    return value if isinstance(value, int) and value in range(1, 9) else 1


def size_of(pixels: NDArray[np.uint8]) -> Size:
    """Return the size of pixels [H, W, ...]."""
    return pixels.shape[1], pixels.shape[0]


def upright_size(stored: Size, orientation: int) -> Size:
    """Return the size of the upright image."""
    return (stored[1], stored[0]) if orientation >= 5 else stored


def is_read_as_stored(stored: Size, orientation: int, annotated: Size | None) -> bool:
    """Return whether an annotation can only be of the pixels as they are stored.

    That is so where only they have the annotated size, as in COCO's own annotations of images
    turned by 90 degrees. Such an image must not be turned.
    """
    return annotated == stored != upright_size(stored, orientation)


def turn_upright(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Return pixels [H, W, ...] turned and mirrored as an EXIF orientation 1..8 tells."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def read_rgb(path: Path, annotated: Size | None = None) -> NDArray[np.uint8] | None:
    """Return the pixels of an image file, uint8 [H, W, 3] RGB, upright; None if it is not readable.

    Args:
        path: the image file.
        annotated: (width, height) of the image that labels were drawn on, px. The pixels stay as
            they are stored where `is_read_as_stored` says so.
    """
    try:
        data = path.read_bytes()
    except OSError:
        return None
    orientation = _orientation(data)
    flags = cv2.IMREAD_COLOR_RGB | (cv2.IMREAD_IGNORE_ORIENTATION if orientation else 0)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if decoded is None:
        return None
    pixels = np.asarray(decoded, np.uint8)
    if is_read_as_stored(size_of(pixels), orientation, annotated):
        return pixels
    return turn_upright(pixels, orientation)


def _orientation(data: bytes) -> int:
    """Return the orientation 1..8 of a file's bytes; 0 where Pillow cannot open them.

    OpenCV has to turn the latter.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            return orientation_of(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return 0
