"""The pictures to look at: an image, a folder of images, a video's or a webcam's frames."""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from cohdc_train.errors import DataError
from cohdc_train.images import IMAGE_SUFFIXES, read_rgb
from cohdc_train.types import Image

VIDEO_SUFFIXES = frozenset([".mp4", ".avi", ".mkv", ".mov", ".webm"])
_WEBCAM_FRAMES = 100


class Picture(NamedTuple):
    """One image to look at.

    name: its file name; stem: what files about it are called, no two alike; rgb: uint8 [H, W, 3];
    path: its file, None of a frame.
    """

    name: str
    stem: str
    rgb: Image
    path: Path | None = None


def read_pictures(source: Path, most: int | None = None) -> Iterator[Picture]:
    """The images behind a path, read one at a time: a file, a folder (by name, not its subfolders),
    a video's frames or those of the webcam of that number. most: how many at most; None is all, and
    100 of a webcam.

    Raises DataError at once when there is nothing to read, and on the way for an image that cannot
    be decoded.
    """
    if most is not None and most < 1:
        raise DataError(f"frames is {most}; at least 1 is needed")
    if str(source).isdecimal() and not source.exists():
        return islice(_frames(Path(f"webcam{source}"), int(str(source))), most or _WEBCAM_FRAMES)
    return islice(_stored(source), most)


def _stored(source: Path) -> Iterator[Picture]:
    if source.is_dir():
        files = sorted(
            file
            for file in source.iterdir()
            if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()
        )
        if not files:
            raise DataError(f"{source}: holds no image ({' '.join(sorted(IMAGE_SUFFIXES))})")
        return _images(files)
    if not source.is_file():
        raise DataError(f"{source}: no such file or folder")
    if source.suffix.lower() in VIDEO_SUFFIXES:
        return _frames(source, str(source))
    return _images([source])


def _images(files: list[Path]) -> Iterator[Picture]:
    stems = Counter([file.stem for file in files] + [file.name for file in files])
    for file in files:
        rgb = read_rgb(file)
        if rgb is None:
            raise DataError(f"{file}: cannot be decoded as an image")
        name = (
            file.stem if stems[file.stem] == 1 else file.name
        )  # a.jpg and a.png must not share a file
        yield Picture(file.name, name, rgb, file)


def _frames(file: Path, origin: str | int) -> Iterator[Picture]:
    video = cv2.VideoCapture(origin)
    index = 0
    try:
        while (frame := video.read())[0]:
            name = f"{file.stem}_{index:06d}"
            yield Picture(f"{name}.jpg", name, _rgb(frame[1]))
            index += 1
    finally:
        video.release()
    if not index:
        raise DataError(f"{file}: no picture comes out of it")


def _rgb(bgr: Any) -> Image:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
