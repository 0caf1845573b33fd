"""Draw masks and text over images, and write JPEG files (no torch)."""

from pathlib import Path

import cv2
import numpy as np

from cohdc_train.files import write_bytes
from cohdc_train.types import Image, Mask

JPEG_QUALITY = 90
Color = tuple[int, int, int]  # RGB, 0..255
_WHITE: Color = (255, 255, 255)
_BLACK: Color = (0, 0, 0)


def encode_jpeg(rgb: Image, quality: int = JPEG_QUALITY) -> bytes:
    """Return an image as the content of a JPEG file.

    Args:
        rgb: [H, W, 3] uint8 RGB.
        quality: of OpenCV's encoder, 0..100.
    """
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(encoded)


def write_jpeg(path: Path, rgb: Image, quality: int = JPEG_QUALITY) -> None:
    """Write a JPEG file whole or not at all.

    Args:
        path: the file.
        rgb: [H, W, 3] uint8 RGB.
        quality: of OpenCV's encoder, 0..100.

    Raises:
        DataError: the file cannot be written.
    """
    write_bytes(path, encode_jpeg(rgb, quality))


def fill_mask(image: Image, mask: Mask, color: Color, opacity: float) -> None:
    """Blend a color over the masked pixels of an image, in place.

    Args:
        image: [H, W, 3] uint8 RGB.
        mask: [H, W] bool.
        color: RGB.
        opacity: share of the color, 0..1.
    """
    blended = (1 - opacity) * image[mask] + opacity * np.array(color)
    image[mask] = blended.astype(np.uint8)


def draw_outline(image: Image, mask: Mask, color: Color, thickness: int = 1) -> None:
    """Draw the borders of a mask and of its holes over an image, in place.

    Args:
        image: [H, W, 3] uint8 RGB.
        mask: [H, W] bool.
        color: RGB.
        thickness: of the line, px.
    """
    pixels = mask.astype(np.uint8)
    contours, _ = cv2.findContours(pixels, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, color, thickness)


def write_text(image: Image, text: str, position: tuple[int, int], scale: float = 0.4) -> None:
    """Write white letters with a black rim over an image, in place.

    Args:
        image: [H, W, 3] uint8.
        text: one line of ASCII.
        position: (x, y) of the text's lower left corner, px.
        scale: size of OpenCV's Hershey font.
    """
    font = cv2.FONT_HERSHEY_SIMPLEX
    for thickness, color in ((3, _BLACK), (1, _WHITE)):
        cv2.putText(image, text, position, font, scale, color, thickness, cv2.LINE_AA)
