"""Helpers of the tests of `cohdc data convert`."""

import json
from pathlib import Path
from typing import Any

import foreign_toys as toys
import numpy as np
import pytest
from numpy.typing import NDArray

from cohdc_train.data.annotations import CocoObject
from cohdc_train.data.coco import CocoImage, CocoSplit, find_split, read_split
from cohdc_train.data.convert import convert
from cohdc_train.errors import DataError

BUILD = {"labelme": toys.labelme, "via": toys.via, "yolo": toys.yolo, "voc": toys.voc}
FORMATS = tuple(BUILD)


def converted(format: Any, source: Path, **options: Any) -> dict[str, CocoSplit]:
    """Convert a source, and return both splits of the new folder."""
    out = source.with_name(f"{source.name}_coco")
    convert(format, source, out, **options)
    return {name: read_split(name, find_split(out, name)) for name in ("train", "val")}


def image_of(splits: dict[str, CocoSplit], name: str) -> CocoImage:
    """Return the image of this file name, from either split."""
    (found,) = [
        image for split in splits.values() for image in split.images if image.path.stem == name
    ]
    return found


def masks_of(splits: dict[str, CocoSplit], name: str) -> list[tuple[str, NDArray[np.uint8]]]:
    """Return (class, mask) of the objects of an image."""
    image = image_of(splits, name)
    names = splits["train"].class_names
    return [(names[o.label - 1], o.mask(image.height, image.width)) for o in image.objects]


def drawn(
    *polygons: list[float], size: tuple[int, int] = (toys.HEIGHT, toys.WIDTH)
) -> NDArray[np.uint8]:
    """Return the mask of polygons."""
    return CocoObject(1, 1, (0, 0, 1, 1), 1, list(polygons), False).mask(*size)


def iou(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def file_names(split: CocoSplit) -> list[str]:
    return [row["file_name"] for row in json.loads(split.annotations.read_text())["images"]]


def assert_refused(tmp_path: Path, format: Any, source: Path, message: str, **options: Any) -> None:
    """Assert that converting ends in an error of one line and writes nothing."""
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match=message) as caught:
        convert(format, source, tmp_path / "out", **options)
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before
