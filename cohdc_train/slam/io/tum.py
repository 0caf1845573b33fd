"""Lists and images of the TUM RGB-D benchmark's format."""

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
class TimestampedImage:
    """Line of a list such as rgb.txt.

    Attributes:
        timestamp: s.
        timestamp_text: as the line writes it.
        path: of the image.
    """

    timestamp: float
    timestamp_text: str
    path: Path


Pair = tuple[TimestampedImage, TimestampedImage]


def read_pairs(first: Path, second: Path, max_difference_s: float) -> tuple[list[Pair], int]:
    """Read two lists and pair their images, one to one, nearest timestamps first.

    TUM's associate tool does the same.

    Args:
        first: list such as rgb.txt.
        second: list such as depth.txt.
        max_difference_s: largest time between the images of a pair, s.

    Returns:
        Pairs in the order of time, and how many images of the first list have no partner.

    Raises:
        DataError: a list or image is missing or broken, timestamps do not rise, or nothing pairs;
            the message names file and line.
    """
    ours, theirs = _read_list(first), _read_list(second)
    our_times = np.array([image.timestamp for image in ours])
    their_times = np.array([image.timestamp for image in theirs])
    indices = associate(our_times, their_times, max_difference_s).tolist()
    pairs = [(ours[i], theirs[j]) for i, j in indices]
    if not pairs:
        names = f"no image of {first.name} lies within {max_difference_s:g} s of one of"
        raise DataError(f"{first.parent}: {names} {second.name}")
    return pairs, len(ours) - len(pairs)


def read_rgb(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Read a color image.

    Returns:
        [height, width, 3] uint8 RGB.

    Raises:
        DataError: the file is missing, broken, or of another size than the camera's.
    """
    image = _decode(path, cv2.IMREAD_COLOR)
    _check_size(path, image.shape[:2], camera)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """Read a depth image.

    Returns:
        [height, width] float32 m, 0 = no reading.

    Raises:
        DataError: the file is no 16-bit image of one channel, or as for `read_rgb`.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        found = f"{image.dtype} of shape {image.shape}"
        raise DataError(f"{path}: depth must be one channel of 16 bits, not {found}")
    _check_size(path, image.shape, camera)
    return image.astype(np.float32) / np.float32(camera.depth_scale)


def read_mask(path: Path, camera: Camera) -> NDArray[np.bool_]:
    """Read a mask.

    Returns:
        [height, width] bool, True = dynamic, where the file is above 0.

    Raises:
        DataError: as for `read_rgb`.
    """
    image = _decode(path, cv2.IMREAD_GRAYSCALE)
    _check_size(path, image.shape, camera)
    return np.asarray(image > 0)


def parse_line(path: Path, number: int, line: str) -> TimestampedImage | None:
    """Parse a line of a list.

    Args:
        path: of the list; images are relative to its folder.
        number: of the line.
        line: its text.

    Returns:
        None for a comment and for an empty line.

    Raises:
        DataError: the line is broken; the message names file and line.
    """
    words = line.split()
    if not words or words[0].startswith("#"):
        return None
    if len(words) != 2:
        raise DataError(f"{path}:{number}: expected 'timestamp filename', found {len(words)} words")
    text, name = words
    try:
        timestamp = float(text)
    except ValueError as error:
        raise DataError(f"{path}:{number}: timestamp {text!r} is not a number") from error
    if not math.isfinite(timestamp):
        raise DataError(f"{path}:{number}: timestamp {text!r} is not finite")
    return TimestampedImage(timestamp, text, path.parent / name)


def check_order(
    path: Path, number: int, image: TimestampedImage, previous: TimestampedImage | None
) -> None:
    """Raise DataError unless the timestamp of a line is later than that of the line before."""
    if previous is not None and image.timestamp <= previous.timestamp:
        problem = f"{image.timestamp_text} does not come after {previous.timestamp_text}"
        raise DataError(f"{path}:{number}: timestamp {problem}")


def _read_list(path: Path) -> list[TimestampedImage]:
    """Read a whole list, with DataError for the first line that cannot be used."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        hint = "a TUM sequence has rgb.txt and depth.txt, a stereo one left.txt and right.txt"
        raise DataError(f"{path}: cannot be read; {hint} ({error})") from error
    images: list[TimestampedImage] = []
    for number, line in enumerate(lines, start=1):
        image = parse_line(path, number, line)
        if image is None:
            continue
        check_order(path, number, image, images[-1] if images else None)
        if not image.path.is_file():
            raise DataError(f"{path}:{number}: {line.split()[1]} does not exist in {path.parent}")
        images.append(image)
    if not images:
        raise DataError(f"{path}: lists no image")
    return images


def _decode(path: Path, flags: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Read and decode an image file, with DataError for one that is missing or broken."""
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise DataError(f"{path}: not an image that can be decoded ({len(data)} bytes)")
    return cast("NDArray[np.uint8] | NDArray[np.uint16]", image)


def _check_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    """Raise DataError unless an image has the camera's size."""
    if tuple(shape) != (camera.height, camera.width):
        found, expected = f"{shape[1]}x{shape[0]}", f"{camera.width}x{camera.height}"
        raise DataError(f"{path}: image is {found}, but the camera is {expected}")
