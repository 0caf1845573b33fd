"""Image files before training: can they be read, how large are they, do two show the same (Pillow,
no torch).
"""

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

_TAIL = 4096  # bytes at a file's end in which its end mark is looked for
_END_MARKS = {"JPEG": b"\xff\xd9", "PNG": b"IEND"}
_PLAIN_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
_SIDE = 16  # px, of a fingerprint
PROBLEMS = {
    "missing": "does not exist",
    "truncated": "ends early",
    "corrupt": "cannot be read as an image",
}


class ImageFile(NamedTuple):
    """What a file says of itself.

    stored: width and height in px, before any turning by EXIF; 0 when it cannot be read.
    orientation: EXIF's, 1..8; 1 is upright.
    plain: 8-bit gray, palette or RGB. problem: "", "missing", "corrupt" or "truncated".
    """

    stored: Size = (0, 0)
    orientation: int = 1
    is_8bit: bool = True
    problem: str = ""

    @property
    def upright(self) -> Size:
        """Width and height in px of the image as viewers show it."""
        return upright_size(self.stored, self.orientation)

    def is_turned(self, annotated: Size | None) -> bool:
        """Whether EXIF turns or mirrors the image when it is read for an annotation of a size."""
        as_stored = is_read_as_stored(self.stored, self.orientation, annotated)
        return self.orientation > 1 and not as_stored

    def size_for(self, annotated: Size | None) -> Size:
        """Return the size at which the image is read for an annotation of a size."""
        return self.upright if self.is_turned(annotated) else self.stored


def read_image_file(path: Path, decode: bool = False) -> ImageFile:
    """Read a file's header and end; with `decode` all of it, which finds damage in between too."""
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
    """Raise DataError naming file and id unless it can be read at the annotated size."""
    file = read_image_file(path)
    if file.problem:
        raise DataError(f"{path}: image {image_id} {PROBLEMS[file.problem]}")
    check_size(path, image_id, file.size_for(size), size)


def check_size(path: Path, image_id: int, found: Size, annotated: Size) -> None:
    """Raise DataError naming file and id when the two sizes (width, height), px, differ."""
    if found != annotated:
        swapped = found == annotated[::-1]
        turned = ": swapped, or the file lost its EXIF orientation?" if swapped else ""
        sizes = f"{found[0]}x{found[1]}, its annotation {annotated[0]}x{annotated[1]}"
        raise DataError(f"{path}: image {image_id} is {sizes}{turned}")


def fingerprint(path: Path) -> Float32Array:
    """Return [256] gray values of the upright image at 16x16, of mean 0 and norm 1.

    The product of two compares the images. All values are 0 for an image of one gray.
    """
    with Image.open(path) as image:
        orientation = orientation_of(image)
        image.draft("L", (8 * _SIDE, 8 * _SIDE))
        small = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    values = turn_upright(np.asarray(small), orientation).astype(np.float32).ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-6)


def mirror_fingerprints(prints: Float32Array) -> Float32Array:
    """Fingerprints [N, 256] of the same pictures, flipped left to right."""
    return prints.reshape(-1, _SIDE, _SIDE)[:, :, ::-1].reshape(-1, _SIDE * _SIDE)


def _has_end(path: Path, kind: str | None) -> bool:
    """Whether the format's end mark stands at the file's end; False when the format has none we
    know.
    """
    mark = _END_MARKS.get(kind or "")
    if mark is None:
        return False
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        return mark in file.read()
