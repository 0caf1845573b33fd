"""Images and objects of an annotation format before they become COCO (no torch)."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pycocotools import mask as rle

from cohdc_train.data.image_files import PROBLEMS, read_image_file
from cohdc_train.errors import DataError
from cohdc_train.images import IMAGE_SUFFIXES
from cohdc_train.types import Mask

_SAGITTA = 0.05  # px between an arc and the chord that replaces it, at most


class SourceObject(NamedTuple):
    """One object.

    Attributes:
        name: its class.
        segmentation: polygons [[x, y, ...], ...] in px, or a compressed RLE.
        where: file and row.
    """

    name: str
    segmentation: Any
    where: str


@dataclass(frozen=True)
class SourceImage:
    """One image and its objects.

    Attributes:
        path: its file, absolute; with `pixels`, the name that it would have.
        width: px, of the image that the objects are drawn on.
        height: px, likewise.
        apply_exif: the objects are drawn on the image as its EXIF orientation turns it.
        pixels: returns the file's bytes where they are inside the annotation file.
        objects: annotated objects.
    """

    path: Path
    width: int
    height: int
    apply_exif: bool = False
    pixels: Callable[[], bytes] | None = None
    objects: tuple[SourceObject, ...] = ()

    def with_objects(self, objects: Sequence[SourceObject]) -> "SourceImage":
        """Return the image with these objects."""
        return replace(self, objects=tuple(objects))


@dataclass
class SourceDataset:
    """Images of a source, with what was skipped and what was changed.

    Attributes:
        splits: "train" and "val" -> images; or only "" when the source has no split of its own.
            While it is read also "test", until `settle_splits` removes it.
        drawn_from: what a split is drawn from, where that is not the whole source.
        class_names: in the format's own order; None where it has none.
        skipped: reason -> places of what is not converted.
        notes: what -> places of what is converted, but not as it was.
    """

    splits: dict[str, list[SourceImage]] = field(default_factory=dict)
    drawn_from: str = ""
    class_names: tuple[str, ...] | None = None
    skipped: dict[str, list[str]] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def add(self, split: str, image: SourceImage) -> None:
        """Append an image to a split; "" where nothing tells its split."""
        self.splits.setdefault(split, []).append(image)

    def skip(self, why: str, where: str) -> None:
        """Count one thing that is not converted."""
        self.skipped.setdefault(why, []).append(where)

    def note(self, what: str, where: str) -> None:
        """Count one thing worth knowing."""
        self.notes.setdefault(what, []).append(where)


def annotation_files(root: Path) -> list[Path]:
    """Return the JSON files: a file alone, or all below a folder but those in hidden folders.

    Raises:
        DataError: the folder is missing or holds no JSON.
    """
    if root.is_file():
        return [root]
    files = _find_files(root, {".json"})
    if not files:
        raise DataError(
            f"{root}: {'no JSON file below it' if root.is_dir() else 'no such file or folder'}"
        )
    return files


def skip_unlisted(root: Path, source: SourceDataset, why: str) -> None:
    """Count the image files below a folder that no annotation file lists."""
    known = {image.path.resolve() for images in source.splits.values() for image in images}
    for path in _find_files(root, IMAGE_SUFFIXES):
        if path.resolve() not in known:
            source.skip(why, str(path))


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Return (number, text) of the lines that are not empty.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    return [(number, line.strip()) for number, line in enumerate(lines, start=1) if line.strip()]


def open_image(path: Path, annotated: tuple[int, int] | None = None) -> SourceImage:
    """Return the image of a file, without objects.

    Annotation tools show the upright image, so that is what the objects are drawn on, unless the
    annotated size is that of the stored pixels only.

    Args:
        path: the image file.
        annotated: (width, height), px, where the format gives it.

    Raises:
        DataError: the file cannot be read, or has another size.
    """
    file = read_image_file(path)
    if file.problem:
        raise DataError(f"{path}: {PROBLEMS[file.problem]}")
    path = Path(os.path.abspath(path))
    width, height = file.size_for(annotated)
    if annotated not in (None, (width, height)):
        found = f"is {width}x{height}"
        raise DataError(f"{path}: {found}, its annotation {annotated[0]}x{annotated[1]}")
    return SourceImage(path, width, height, apply_exif=file.is_turned(annotated))


def parse_numbers(values: Any, count: int | None = None) -> list[float]:
    """Return the values as finite floats.

    Raises:
        TypeError: a value is no number.
        ValueError: a value is no finite number, or there are not `count` of them.
    """
    try:
        found = [float(value) for value in values]
    except OverflowError as error:
        raise ValueError("too large") from error
    if not all(map(math.isfinite, found)) or (count is not None and len(found) != count):
        raise ValueError(f"{len(found)} numbers")
    return found


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[float]:
    """Return a polygon [x, y, ...] from two opposite corners, px."""
    return [x0, y0, x1, y0, x1, y1, x0, y1]


def ellipse(cx: float, cy: float, rx: float, ry: float, theta: float = 0.0) -> list[float]:
    """Return a polygon [x, y, ...] of an ellipse.

    Args:
        cx: center, px.
        cy: center, px.
        rx: half axis along x, px.
        ry: half axis along y, px.
        theta: angle by which it is turned from x toward y, rad.

    Raises:
        ValueError: a half axis is not positive.
    """
    if min(rx, ry) <= 0:
        raise ValueError("half axis")
    count = max(16, math.ceil(math.pi / math.acos(max(1 - _SAGITTA / max(rx, ry), 0.5))))
    angle = np.arange(count) * (2 * math.pi / count)
    along, across = rx * np.cos(angle), ry * np.sin(angle)
    x = cx + along * math.cos(theta) - across * math.sin(theta)
    y = cy + along * math.sin(theta) + across * math.cos(theta)
    flat: list[float] = np.stack([x, y], axis=1).ravel().round(3).tolist()
    return flat


def encode_mask(mask: Mask) -> dict[str, Any]:
    """Return the compressed RLE of a mask [H, W]."""
    return dict(rle.encode(np.asfortranarray(mask, dtype=np.uint8)))


def join_parts(parts: Sequence[Any], height: int, width: int) -> Any:
    """Join the parts of one object: polygons [x, y, ...], or an RLE where one is among them.

    height, width: px, of the image.
    """
    if all(isinstance(part, list) for part in parts):
        return list(parts)
    encoded = [
        rle.frPyObjects([part], height, width)[0] if isinstance(part, list) else part
        for part in parts
    ]
    return rle.merge(encoded)


def _find_files(root: Path, suffixes: frozenset[str] | set[str]) -> list[Path]:
    """Return files of these suffixes below a folder, sorted, without hidden ones."""
    found = (path for path in root.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    return sorted(path for path in found if not _is_hidden(path.relative_to(root)))


def _is_hidden(path: Path) -> bool:
    """Return whether the file, or a folder on the way to it, is hidden."""
    return any(part.startswith(".") for part in path.parts)
