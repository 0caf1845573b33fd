"""Image files before training: can they be read, how large are they, do two show the same (Pillow, no torch)."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from cohdc_train.errors import DataError

_TAIL = 4096  # bytes at a file's end in which its end mark is looked for
_END_MARKS = {"JPEG": b"\xff\xd9", "PNG": b"IEND"}
_PLAIN_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
_SIDE = 16  # px, of a fingerprint
PROBLEMS = {"missing": "does not exist", "truncated": "ends early", "corrupt": "cannot be read as an image"}


class ImageFile(NamedTuple):
    """What a file says of itself.

    width, height: px as stored, before any turning by EXIF; 0 when it cannot be read.
    turned: its EXIF orientation turns it by 90 degrees; oriented: EXIF asks for any turning or mirroring.
    plain: 8-bit grey, palette or RGB. problem: "", "missing", "corrupt" or "truncated".
    """

    width: int = 0
    height: int = 0
    turned: bool = False
    oriented: bool = False
    plain: bool = True
    problem: str = ""


def look(path: Path, decode: bool = False) -> ImageFile:
    """Read a file's header and end; with `decode` all of it, which finds damage in between too."""
    if not path.is_file():
        return ImageFile(problem="missing")
    try:
        with Image.open(path) as image:
            width, height = image.size
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
            facts = ImageFile(width, height, orientation in (5, 6, 7, 8), orientation in range(2, 9))
            facts = facts._replace(plain=image.mode in _PLAIN_MODES)
            if decode or not _has_end(path, image.format):
                image.load()
    except UnidentifiedImageError:
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return ImageFile(problem="corrupt") if pixels is None else ImageFile(pixels.shape[1], pixels.shape[0])
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        problem = "truncated" if "truncated" in str(error) else "corrupt"
        return ImageFile(problem=problem)
    return facts


def check(path: Path, image_id: int, size: tuple[int, int]) -> None:
    """Raise DataError naming file and id unless it can be read and is of the annotated size (width, height), px."""
    file = look(path)
    if file.problem:
        raise DataError(f"{path}: image {image_id} {PROBLEMS[file.problem]}")
    check_size(path, image_id, (file.width, file.height), size)


def check_size(path: Path, image_id: int, found: tuple[int, int], annotated: tuple[int, int]) -> None:
    """Raise DataError naming file and id when the two sizes (width, height), px, differ."""
    if found != annotated:
        turned = ": annotated as shown turned by EXIF?" if found == annotated[::-1] else ""
        sizes = f"{found[0]}x{found[1]}, its annotation {annotated[0]}x{annotated[1]}"
        raise DataError(f"{path}: image {image_id} is {sizes}{turned}")


def fingerprint(path: Path) -> NDArray[np.float32]:
    """[256] grey values of the picture at 16x16, mean 0 and norm 1 (all 0 for a plain one): their product compares."""
    with Image.open(path) as image:
        image.draft("L", (8 * _SIDE, 8 * _SIDE))
        small = image.convert("L").resize((_SIDE, _SIDE), Image.Resampling.BOX)
    values = np.asarray(small, dtype=np.float32).ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-6)


def mirrored(prints: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fingerprints [N, 256] of the same pictures, flipped left to right."""
    return prints.reshape(-1, _SIDE, _SIDE)[:, :, ::-1].reshape(-1, _SIDE * _SIDE)


def _has_end(path: Path, kind: str | None) -> bool:
    """Whether the format's end mark stands at the file's end; False when the format has none we know."""
    mark = _END_MARKS.get(kind or "")
    if mark is None:
        return False
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        return mark in file.read()
