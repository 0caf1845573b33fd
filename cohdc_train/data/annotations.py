"""Check and read one annotation or one image of a COCO-format file (no torch)."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle

from cohdc_train.data.image_files import check_size
from cohdc_train.errors import DataError
from cohdc_train.images import read_rgb, size_of
from cohdc_train.types import Image

_MAX_COORDINATE = 1e5  # px; farther points are mistakes, which pycocotools fills until memory ends
_CLIP_TOLERANCE = 1.0  # px beyond the edge that is rounding, not a mistake worth counting


@dataclass(frozen=True)
class CocoObject:
    """One annotated object.

    Attributes:
        id: annotation id in the file.
        label: 1..C.
        box: x, y, width, height in px, clipped to the image.
        area: px^2, as annotated.
        segmentation: polygons [[x, y, ...], ...] in px, or a compressed RLE; empty for a crowd
            given by its box only.
        crowd: a region of uncounted objects: ignored by losses and scores.
    """

    id: int
    label: int
    box: tuple[float, float, float, float]
    area: float
    segmentation: Any
    crowd: bool

    def mask(self, height: int, width: int) -> NDArray[np.uint8]:
        """Return the mask, [height, width] uint8 of 0 and 1, cut off at the image's border."""
        if isinstance(self.segmentation, dict):
            encoded = self.segmentation
        else:
            encoded = rle.merge(rle.frPyObjects(self.segmentation, height, width))
        with warnings.catch_warnings():  # pycocotools 2.0.11 under numpy 2
            warnings.simplefilter("ignore", DeprecationWarning)
            decoded: NDArray[np.uint8] = rle.decode(encoded)
        return decoded


@dataclass(frozen=True)
class CocoImage:
    """One image and its objects. An image without objects is kept: it shows only background."""

    id: int
    path: Path
    height: int
    width: int
    objects: tuple[CocoObject, ...]


def read_image(image: CocoImage) -> Image:
    """Return the image as it was annotated, [height, width, 3] uint8 RGB.

    It is turned by its EXIF orientation, unless the annotated size is that of the stored pixels
    only.

    Raises:
        DataError: the image cannot be decoded, or its size is not the annotated one.
    """
    annotated = (image.width, image.height)
    pixels = read_rgb(image.path, annotated)
    if pixels is None:
        raise DataError(f"{image.path}: image {image.id} cannot be read as an image")
    check_size(image.path, image.id, size_of(pixels), annotated)
    return pixels


def read_segmentation(path: Path, row: dict[str, Any], image: CocoImage) -> Any:
    """Return the polygons that can be drawn, or a compressed RLE; empty when there is none.

    Polygons with fewer than three points or with a coordinate that is no finite number are skipped.

    Args:
        path: the annotation file, for error messages.
        row: the annotation.
        image: the image that it belongs to.

    Raises:
        DataError: the segmentation is neither polygons nor an RLE of the image's size.
    """
    given = row.get("segmentation") or []
    try:
        if not isinstance(given, dict | list):
            raise TypeError("segmentation")
        if isinstance(given, list):
            drawable = [part for part in given if len(part) >= 6 and len(part) % 2 == 0]
            polygons = [[float(value) for value in part] for part in drawable]
            return [polygon for polygon in polygons if _is_near_image(polygon)]
        if list(given["size"]) != [image.height, image.width]:
            sizes = f"size {given['size']} for an image of {image.height}x{image.width}"
            raise DataError(f"{path}: annotation {row.get('id')}: RLE of {sizes}")
        if not fills_image(given["counts"], image.height * image.width):
            raise ValueError("RLE counts")
        if isinstance(given["counts"], list):
            given = rle.frPyObjects(given, image.height, image.width)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: annotation {row.get('id')}: neither polygons nor RLE") from error
    return rle_as_text(given)


def _is_near_image(polygon: Sequence[float]) -> bool:
    """Return whether all coordinates can be drawn; not so for NaN and infinity."""
    return all(abs(value) <= _MAX_COORDINATE for value in polygon)


def rle_as_text(encoded: dict[str, Any]) -> dict[str, Any]:
    """Return a compressed RLE whose counts are text, as JSON needs them."""
    counts = encoded["counts"]
    text = counts.decode() if isinstance(counts, bytes) else counts
    return {"size": list(encoded["size"]), "counts": text}


def fills_image(counts: str | bytes | list[int], pixels: int) -> bool:
    """Return whether the runs of an RLE, compressed (text) or not, fill so many pixels.

    pycocotools decodes a damaged RLE into wrong pixels without an error.
    """
    try:
        text = counts.decode() if isinstance(counts, bytes) else counts
        runs = _decompressed(text) if isinstance(text, str) else [int(run) for run in text]
    except (IndexError, TypeError, UnicodeDecodeError, ValueError):
        return False
    return min(runs, default=-1) >= 0 and sum(runs) == pixels


def _decompressed(text: str) -> list[int]:
    """Return the run lengths of COCO's compressed RLE.

    Each number is written in groups of 5 bits, lowest first. Bit 32 of a character marks that
    another group follows; the highest bit of the last group marks a negative number. From the
    fourth number on, each is the difference to the run before the last.
    """
    runs: list[int] = []
    value, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"character {character!r}")
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        value, shift = 0, 0
    if shift:
        raise ValueError("ends within a number")
    return runs


def find_defect(row: dict[str, Any], segmentation: Any, image: CocoImage) -> str:
    """Return why an annotation cannot be used; empty when it can."""
    box = row.get("bbox")
    if box is not None and not (is_number_list(box, 4) and _has_extent(_clip_box(box, image))):
        return "degenerate box"
    if not segmentation:
        return "" if is_crowd(row) and box is not None else "no contour"
    return (
        "" if _has_extent(_clip_box(_bounding_box(segmentation), image)) else "degenerate contour"
    )


def build_object(
    row: dict[str, Any], label: int, segmentation: Any, image: CocoImage
) -> CocoObject:
    """Return the object of a sound annotation. A missing box is taken from the contour."""
    box = _clip_box(
        row["bbox"] if row.get("bbox") is not None else _bounding_box(segmentation), image
    )
    area, number = row.get("area"), row.get("id")
    area = float(area) if area and is_number_list([area], 1) else box[2] * box[3]
    return CocoObject(
        number if isinstance(number, int) else 0, label, box, area, segmentation, is_crowd(row)
    )


def is_crowd(row: dict[str, Any]) -> bool:
    """Return whether `iscrowd` is 1, given as a number, a truth value or text."""
    return row.get("iscrowd") in (1, "1", "true")


def _bounding_box(segmentation: Any) -> tuple[float, float, float, float]:
    """Return x, y, width and height of a segmentation, px."""
    if isinstance(segmentation, dict):
        x, y, width, height = (float(v) for v in rle.toBbox(segmentation))
        return x, y, width, height
    points = np.concatenate([np.asarray(part).reshape(-1, 2) for part in segmentation])
    low, high = points.min(axis=0), points.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def _clip_box(box: Sequence[float], image: CocoImage) -> tuple[float, float, float, float]:
    """Return x, y, width and height, px, of the part of a box that lies in the image."""
    x0, y0 = max(float(box[0]), 0.0), max(float(box[1]), 0.0)
    x1, y1 = (
        min(float(box[0]) + float(box[2]), image.width),
        min(float(box[1]) + float(box[3]), image.height),
    )
    return x0, y0, x1 - x0, y1 - y0


def is_number_list(values: Any, count: int) -> bool:
    """Return whether the values are a list of `count` finite numbers."""
    listed = isinstance(values, list | tuple) and len(values) == count
    return listed and all(
        isinstance(value, int | float) and math.isfinite(value) for value in values
    )


def _has_extent(box: Sequence[float]) -> bool:
    return box[2] > 0 and box[3] > 0


def broken_polygons(row: dict[str, Any], segmentation: Any) -> int:
    """Return how many polygons of an annotation `read_segmentation` skipped, if it kept others."""
    return (
        len(row["segmentation"]) - len(segmentation)
        if isinstance(segmentation, list) and segmentation
        else 0
    )


def exceeds_image(box: Sequence[float] | None, image: CocoImage) -> bool:
    """Return whether an annotated box leaves the image by more than the tolerance."""
    if box is None:
        return False
    inside = _clip_box(box, image)
    return max(abs(inside[0] - box[0]), abs(inside[1] - box[1])) > _CLIP_TOLERANCE or (
        max(box[2] - inside[2], box[3] - inside[3]) > _CLIP_TOLERANCE
    )
