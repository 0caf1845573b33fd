"""Draw annotated images into one grid (OpenCV, no torch)."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from cohdc_train.data.annotations import CocoImage, read_image
from cohdc_train.data.coco import CocoSplit
from cohdc_train.drawing import Color, draw_outline, fill_mask, write_jpeg, write_text
from cohdc_train.types import Image

_TILE = (240, 320)  # px, height and width
_OPACITY = 0.45
_CROWD: Color = (255, 255, 255)


def draw_grid(splits: Sequence[CocoSplit], path: Path, columns: int = 4, rows: int = 3) -> None:
    """Write a JPEG of images drawn at random, always the same ones, the same number of each split.

    Objects are tinted by class and outlined, crowds white.

    Raises:
        DataError: an image cannot be read; the message names it.
    """
    tiles = []
    for split in splits:
        filled = [image for image in split.images if image.objects]
        order = np.random.default_rng(0).permutation(len(filled))[: columns * rows // len(splits)]
        tiles += [_tile(filled[i], split) for i in order]
    tiles += [np.zeros((*_TILE, 3), np.uint8)] * (-len(tiles) % columns)
    rows_of_tiles = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    write_jpeg(path, np.vstack(rows_of_tiles))


def _tile(image: CocoImage, split: CocoSplit) -> Image:
    """Return one image, RGB, fitted into a tile."""
    shown = read_fitted(image, _TILE)
    size = shown.shape[1::-1]
    for o in image.objects:
        if not o.segmentation:
            continue
        whole = o.mask(image.height, image.width)
        mask = cv2.resize(whole, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        color = _CROWD if o.crowd else _class_color(o.label)
        fill_mask(shown, mask, color, _OPACITY)
        draw_outline(shown, mask, color)
    tile = np.zeros((*_TILE, 3), np.uint8)
    tile[: size[1], : size[0]] = shown
    write_text(tile, f"{split.name} {image.path.name}", (4, _TILE[0] - 6))
    return tile


def read_fitted(image: CocoImage, tile: tuple[int, int]) -> Image:
    """Read an image, RGB, as large as fits into (height, width) px.

    Raises:
        DataError: the image cannot be read.
    """
    scale = min(tile[0] / image.height, tile[1] / image.width)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return np.asarray(cv2.resize(read_image(image), size, interpolation=cv2.INTER_AREA), np.uint8)


def _class_color(label: int) -> Color:
    """Return a color of its own for each class, RGB: hues a golden section apart."""
    hue = np.array([[[round(label * 0.618 * 180) % 180, 220, 255]]], np.uint8)
    red, green, blue = (int(value) for value in cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0])
    return red, green, blue
