"""Sources of images: an image file, a folder of images, a video or a webcam."""

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


class SourceImage(NamedTuple):
    """An image of a source.

    Attributes:
        name: its file name.
        stem: name of files about it, without ending; no two images of a source share it.
        rgb: uint8 [H, W, 3].
        path: its file; None for a frame of a video or webcam.
    """

    name: str
    stem: str
    rgb: Image
    path: Path | None = None


def read_images(source: Path, max_count: int | None = None) -> Iterator[SourceImage]:
    """Open a source, and read its images one at a time.

    Args:
        source: an image, a folder (by name, without subfolders), a video, or a webcam's number.
        max_count: largest number of images; when not given all, and 100 of a webcam.

    Raises:
        DataError: immediately when there is nothing to read, and later for an image that cannot be
            decoded.
    """
    if max_count is not None and max_count < 1:
        raise DataError(f"frames is {max_count}; at least 1 is needed")
    if str(source).isdecimal() and not source.exists():
        frames = _read_frames(Path(f"webcam{source}"), int(str(source)))
        return islice(frames, max_count or _WEBCAM_FRAMES)
    return islice(_open_path(source), max_count)


def _open_path(source: Path) -> Iterator[SourceImage]:
    if source.is_dir():
        files = sorted(
            file
            for file in source.iterdir()
            if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()
        )
        if not files:
            raise DataError(f"{source}: holds no image ({' '.join(sorted(IMAGE_SUFFIXES))})")
        return _read_files(files)
    if not source.is_file():
        raise DataError(f"{source}: no such file or folder")
    if source.suffix.lower() in VIDEO_SUFFIXES:
        return _read_frames(source, str(source))
    return _read_files([source])


def _read_files(files: list[Path]) -> Iterator[SourceImage]:
    counts = Counter([file.stem for file in files] + [file.name for file in files])
    for file in files:
        rgb = read_rgb(file)
        if rgb is None:
            raise DataError(f"{file}: cannot be decoded as an image")
        # a.jpg and a.png must not share the files that are written about them.
        stem = file.stem if counts[file.stem] == 1 else file.name
        yield SourceImage(file.name, stem, rgb, file)


def _read_frames(file: Path, origin: str | int) -> Iterator[SourceImage]:
    video = cv2.VideoCapture(origin)
    index = 0
    try:
        while (frame := video.read())[0]:
            stem = f"{file.stem}_{index:06d}"
            yield SourceImage(f"{stem}.jpg", stem, _to_rgb(frame[1]))
            index += 1
    finally:
        video.release()
    if not index:
        raise DataError(f"{file}: no image can be read from it")


def _to_rgb(bgr: Any) -> Image:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
