"""Check image files before training: readable, of which size, alike (Pillow, no torch)."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from cohdc_train.errors import DataError
from cohdc_train.images import (
    Size,
    is_read_as_stored,
    orientation_of,
    read_rgb,
    size_of,
    turn_upright,
    upright_size,
)
from cohdc_train.types import Float32Array

_TAIL = 4096  # bytes at the end of a file that are searched for its end mark
_END_MARKS = {"JPEG": b"\xff\xd9", "PNG": b"IEND"}
_PLAIN_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
_SIDE = 16  # px, of a fingerprint
PROBLEMS = {
    "missing": "does not exist",
    "truncated": "ends early",
    "corrupt": "cannot be read as an image",
}


class ImageFile(NamedTuple):
    """Size, orientation and condition of an image file.

    Attributes:
        stored: (width, height), px, before EXIF turns it; 0 when it cannot be read.
        orientation: EXIF's, 1..8; 1 is upright.
        is_8bit: 8-bit gray, palette or RGB.
        problem: "", "missing", "corrupt" or "truncated".
    """

    stored: Size = (0, 0)
    orientation: int = 1
    is_8bit: bool = True
    problem: str = ""

    @property
    def upright(self) -> Size:
        """Width and height, px, of the image as viewers show it."""
        return upright_size(self.stored, self.orientation)

    def is_turned(self, annotated: Size | None) -> bool:
        """Return whether EXIF turns or mirrors the image when it is read for an annotation.

        annotated: (width, height) of the annotation, px; None when it is not known.
        """
        as_stored = is_read_as_stored(self.stored, self.orientation, annotated)
        return self.orientation > 1 and not as_stored

    def size_for(self, annotated: Size | None) -> Size:
        """Return the size at which the image is read for an annotation of a size."""
        return self.upright if self.is_turned(annotated) else self.stored


def read_image_file(path: Path, decode: bool = False) -> ImageFile:
    """Read a file's header and end; with `decode`, all of it, which finds any damage."""
    if not path.is_file():
        return ImageFile(problem="missing")
    try:
        with Image.open(path) as image:
            facts = ImageFile(image.size, orientation_of(image), image.mode in _PLAIN_MODES)
            if decode or not _has_end(path, image.format):
                image.load()
    except UnidentifiedImageError:
        pixels = read_rgb(path)
        return ImageFile(problem="corrupt") if pixels is None else ImageFile(size_of(pixels))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        problem = "truncated" if "truncated" in str(error) else "corrupt"
        return ImageFile(problem=problem)
    return facts


def check_image(path: Path, image_id: int, size: Size) -> None:
    """Raise DataError naming file and id unless the image can be read at the annotated size."""
    file = read_image_file(path)
    if file.problem:
        raise DataError(f"{path}: image {image_id} {PROBLEMS[file.problem]}")
    check_size(path, image_id, file.size_for(size), size)


def check_size(path: Path, image_id: int, found: Size, annotated: Size) -> None:
    """Raise DataError naming file and id when two sizes (width, height), px, differ."""
    if found != annotated:
        swapped = found == annotated[::-1]
        turned = ": swapped, or the file lost its EXIF orientation?" if swapped else ""
        sizes = f"{found[0]}x{found[1]}, its annotation {annotated[0]}x{annotated[1]}"
        raise DataError(f"{path}: image {image_id} is {sizes}{turned}")


def fingerprint(path: Path) -> Float32Array:
    """Return [256] gray values of the upright image at 16x16, of mean 0 and norm 1.

    The product of two compares the images. All values are 0 for an image of one gray level.
    """
    with Image.open(path) as image:
        orientation = orientation_of(image)
        image.draft("L", (8 * _SIDE, 8 * _SIDE))
        small = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    values = turn_upright(np.asarray(small), orientation).astype(np.float32).ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-6)


def mirror_fingerprints(prints: Float32Array) -> Float32Array:
    """Return the fingerprints [N, 256] of the same images, flipped left to right."""
    return prints.reshape(-1, _SIDE, _SIDE)[:, :, ::-1].reshape(-1, _SIDE * _SIDE)


def _has_end(path: Path, kind: str | None) -> bool:
    """Return whether the end mark of the format ends the file; False for other formats."""
    mark = _END_MARKS.get(kind or "")
    if mark is None:
        return False
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        return mark in file.read()
