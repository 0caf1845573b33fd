"""Annotated images side by side in one picture (OpenCV, no torch)."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.data.annotations import CocoImage, read_image
from cohdc_train.data.coco import CocoSplit
from cohdc_train.files import write_bytes

_TILE = (240, 320)  # px, height and width
_FILL = 0.45


def draw_grid(splits: Sequence[CocoSplit], path: Path, columns: int = 4, rows: int = 3) -> None:
    """Write a JPEG of images drawn at random, always the same ones, half of them of each split;
    objects are tinted by class and outlined, crowds white. Raises DataError naming an image that
    cannot be read."""
    tiles = []
    for split in splits:
        filled = [image for image in split.images if image.objects]
        order = np.random.default_rng(0).permutation(len(filled))[: columns * rows // len(splits)]
        tiles += [_tile(filled[i], split) for i in order]
    tiles += [np.zeros((*_TILE, 3), np.uint8)] * (-len(tiles) % columns)
    picture = np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])
    write_bytes(path, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def _tile(image: CocoImage, split: CocoSplit) -> NDArray[np.uint8]:
    """One image, BGR, fitted into a tile."""
    shown = read_fitted(image, _TILE)
    size = shown.shape[1::-1]
    for o in image.objects:
        if not o.segmentation:
            continue
        mask = cv2.resize(
            o.mask(image.height, image.width), size, interpolation=cv2.INTER_NEAREST
        ).astype(np.uint8)
        colour = (255, 255, 255) if o.crowd else _colour(o.label)
        tint(shown, mask, colour, _FILL)
    tile = np.zeros((*_TILE, 3), np.uint8)
    tile[: size[1], : size[0]] = shown
    write_outlined(tile, f"{split.name} {image.path.name}", (4, _TILE[0] - 6))
    return tile


def read_fitted(image: CocoImage, tile: tuple[int, int]) -> NDArray[np.uint8]:
    """The image, BGR, as large as fits into (height, width) px. Raises DataError when it cannot be
    read.
    """
    pixels = np.ascontiguousarray(read_image(image)[:, :, ::-1])
    scale = min(tile[0] / image.height, tile[1] / image.width)
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def tint(
    shown: NDArray[np.uint8], mask: NDArray[np.uint8], colour: tuple[int, int, int], fill: float
) -> None:
    """Colour and outline, in place, what a mask covers. shown: [H, W, 3]; mask: [H, W] of 0 and 1;
    fill: share of the colour, 0..1."""
    inside = mask.astype(bool)
    shown[inside] = ((1 - fill) * shown[inside] + fill * np.array(colour)).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, outlines, -1, colour, 1)


def write_outlined(
    shown: NDArray[np.uint8], text: str, place: tuple[int, int], scale: float = 0.4
) -> None:
    """White letters with a black rim, in place. place: (x, y) of the text's lower left corner, px."""
    for thick, ink in ((3, (0, 0, 0)), (1, (255, 255, 255))):
        cv2.putText(shown, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, thick, cv2.LINE_AA)


def _colour(label: int) -> tuple[int, int, int]:
    """A colour of its own per class, BGR: hues a golden section apart."""
    hue = np.array([[[round(label * 0.618 * 180) % 180, 220, 255]]], np.uint8)
    b, g, r = (int(v) for v in cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0])
    return b, g, r
