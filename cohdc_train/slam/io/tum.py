"""A sequence folder in the layout of the TUM RGB-D benchmark: rgb.txt and depth.txt, paired by
nearest time stamp.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.trajectory.association import associate


@dataclass(frozen=True)
class Entry:
    """A line of a list. t: s; stamp: t as the line writes it; image: the file it names."""

    t: float
    stamp: str
    image: Path


def read_pairs(
    first: Path, second: Path, max_difference: float
) -> tuple[list[tuple[Entry, Entry]], int]:
    """Read two lists and pair their images one to one, nearest stamps first.

    Args:
        first: list of the first images, such as rgb.txt.
        second: list of the second images, such as depth.txt.
        max_difference: largest difference of a pair's stamps, s.

    Returns:
        The pairs in the order of time, and how many images of the first list have no partner.

    Raises:
        DataError: a list is missing or broken, its stamps do not rise, an image is missing, or
            nothing pairs. The message names file and line.
    """
    ours, theirs = _read_list(first), _read_list(second)
    times = np.array([entry.t for entry in ours]), np.array([entry.t for entry in theirs])
    pairs = [(ours[i], theirs[j]) for i, j in associate(*times, max_difference).tolist()]
    if not pairs:
        message = (
            f"no image of {first.name} lies within {max_difference:g} s of one of {second.name}"
        )
        raise DataError(f"{first.parent}: {message}")
    return pairs, len(ours) - len(pairs)


def read_rgb(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """[height, width, 3] uint8 RGB. Raises DataError when the file is missing, broken or of another
    size.
    """
    image = _decode(path, cv2.IMREAD_COLOR)
    _check_size(path, image.shape[:2], camera)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """[height, width] m, 0 = no reading. Raises DataError unless it is a 16 bit image of the
    camera's size.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise DataError(
            f"{path}: depth must be one channel of 16 bit, not {image.dtype} of shape {image.shape}"
        )
    _check_size(path, image.shape, camera)
    return image.astype(np.float32) / np.float32(camera.depth_scale)


def read_mask(path: Path, camera: Camera) -> NDArray[np.bool_]:
    """[height, width] bool, True = dynamic (any value above 0 in the file). Raises DataError as
    read_rgb does.
    """
    image = _decode(path, cv2.IMREAD_GRAYSCALE)
    _check_size(path, image.shape, camera)
    return np.asarray(image > 0)


def _decode(path: Path, flags: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise DataError(f"{path}: not an image that can be decoded ({len(data)} bytes)")
    return cast("NDArray[np.uint8] | NDArray[np.uint16]", image)


def _check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if tuple(shape) != (camera.height, camera.width):
        found, expected = f"{shape[1]}x{shape[0]}", f"{camera.width}x{camera.height}"
        raise DataError(f"{path}: image is {found}, the camera says {expected}")


def _read_list(path: Path) -> list[Entry]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        layout = "a TUM sequence has rgb.txt and depth.txt, a stereo one left.txt and right.txt"
        raise DataError(f"{path}: cannot be read; {layout} ({error})") from error
    entries: list[Entry] = []
    for number, line in enumerate(lines, start=1):
        entry = read_entry(path, number, line)
        if entry is None:
            continue
        if entries and entry.t <= entries[-1].t:
            raise DataError(
                f"{path}:{number}: time stamp {entry.stamp} does not come after {entries[-1].stamp}"
            )
        if not entry.image.is_file():
            raise DataError(f"{path}:{number}: {line.split()[1]} does not exist in {path.parent}")
        entries.append(entry)
    if not entries:
        raise DataError(f"{path}: lists no image")
    return entries


def read_entry(path: Path, number: int, line: str) -> Entry | None:
    """A line of the list `path`; None for a comment and a blank one. Raises DataError naming file
    and line.
    """
    words = line.split()
    if not words or words[0].startswith("#"):
        return None
    if len(words) != 2:
        raise DataError(f"{path}:{number}: expected 'timestamp filename', found {len(words)} words")
    try:
        stamp = float(words[0])
    except ValueError as error:
        raise DataError(f"{path}:{number}: time stamp {words[0]!r} is not a number") from error
    if not math.isfinite(stamp):
        raise DataError(f"{path}:{number}: time stamp {words[0]!r} is not finite")
    return Entry(stamp, words[0], path.parent / words[1])
