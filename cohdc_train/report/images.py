"""Images of a page: read, made as small as the page's size asks for, and embedded."""

import base64
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.report.page import EmbeddedImage

PAGE_BYTES = 5_000_000
IMAGES_BYTES = 2_000_000  # of a page, before base64 makes four bytes of three
_LARGEST = 800_000  # bytes of one image
_STEPS = (
    (2400, 85),
    (2000, 82),
    (1600, 80),
    (1280, 78),
    (960, 75),
    (640, 72),
    (480, 65),
    (320, 60),
)


def embed(file: Path, images: int) -> EmbeddedImage:
    """Return an image file as a image of a page.

    images: how many the page has, which share `IMAGES_BYTES`. Raises DataError for a file that is
    no image.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    array = np.frombuffer(content, np.uint8)
    decoded = cv2.imdecode(array, cv2.IMREAD_COLOR) if len(array) else None
    if decoded is None:
        raise DataError(f"{file}: cannot be read as an image")
    image = np.asarray(decoded, np.uint8)
    limit = min(_LARGEST, IMAGES_BYTES // max(1, images))
    height, width = image.shape[:2]
    kind = _kind(content)
    if kind and len(content) <= limit and max(height, width) <= _STEPS[0][0]:
        return EmbeddedImage(_url(content, kind), width, height)
    return _smaller(image, limit)


def embed_image(image: NDArray[np.uint8], images: int) -> EmbeddedImage:
    """Return an image, [H, W, 3] BGR, as a image of a page that has so many."""
    return _smaller(image, min(_LARGEST, IMAGES_BYTES // max(1, images)))


def _smaller(image: NDArray[np.uint8], limit: int) -> EmbeddedImage:
    """Return an image as the best JPEG below a limit of bytes, or else as the smallest."""
    content, size = b"", (0, 0)
    for longest, quality in _STEPS:
        height, width = image.shape[:2]
        scale = min(1.0, longest / max(height, width))
        size = max(1, round(scale * width)), max(1, round(scale * height))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1 else image
        content = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(content) <= limit:
            break
    return EmbeddedImage(_url(content, "image/jpeg"), *size)


def _kind(content: bytes) -> str:
    """Return the media type of an image that every browser shows; empty for another."""
    if content.startswith(b"\x89PNG"):
        return "image/png"
    return "image/jpeg" if content.startswith(b"\xff\xd8") else ""


def _url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
