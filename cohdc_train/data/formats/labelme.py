"""Read labelme: one JSON per image, with shapes of several types (no torch)."""

import base64
import functools
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cohdc_train.data.formats.base import (
    SourceDataset,
    SourceImage,
    SourceObject,
    annotation_files,
    ellipse,
    encode_mask,
    join_parts,
    open_image,
    parse_numbers,
    rectangle,
    skip_unlisted,
)
from cohdc_train.data.formats.splits import TEST, settle_splits, split_of
from cohdc_train.data.image_files import ImageFile
from cohdc_train.data.layout import load_json
from cohdc_train.errors import DataError
from cohdc_train.images import orientation_of

_NEEDS = {
    "polygon": "points [[x, y], ...]",
    "rectangle": "two opposite corners as points",
    "circle": "its center and a point on it as points",
    "mask": "points [[x0, y0], [x1, y1]] and a base64 PNG that fills them",
}


def read_labelme(root: Path) -> SourceDataset:
    """Read a folder of images and labelme's JSON files, or one such file.

    Polygons, rectangles, circles and masks become objects. Shapes of the same label and `group_id`
    become one object. Shapes of other types and images without a JSON are skipped and counted.
    Folders named train, val and test are the source's own split.

    Raises:
        DataError: a file cannot be used; one line names the file and the shape.
    """
    source = SourceDataset()
    for path in annotation_files(root):
        _read_file(root, path, source)
    skip_unlisted(root, source, "image without a JSON file")
    settle_splits(root, source)
    return source


def _read_file(root: Path, path: Path, source: SourceDataset) -> None:
    """Add the image of one JSON file, and its objects unless it is of the test split."""
    content = load_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("shapes"), list):
        raise DataError(f"{path}: not labelme's: no list 'shapes'")
    image = _image(path, content)
    split = split_of(root, path, image.path)
    objects = [] if split == TEST else _objects(path, content["shapes"], image, source)
    source.add(split, image.with_objects(objects))


def _image(path: Path, content: dict[str, Any]) -> SourceImage:
    """Return the image next to the JSON, else the one inside it."""
    size = (content.get("imageWidth"), content.get("imageHeight"))
    annotated: Any = None if None in size else size
    name = str(content.get("imagePath") or "").replace("\\", "/")
    for file in (path.parent / name, path.parent / Path(name).name):
        if name and os.path.isfile(file):  # False for a name that is too long
            return open_image(file, annotated)
    if not content.get("imageData"):
        raise DataError(f"{path}: imagePath {name!r} does not exist, and there is no imageData")
    try:
        with Image.open(io.BytesIO(_embedded(path, content))) as image_file:
            inside = ImageFile(image_file.size, orientation_of(image_file))
            file = path.with_suffix(".png" if image_file.format == "PNG" else ".jpg")
    except (OSError, TypeError, ValueError) as error:
        raise DataError(f"{path}: imageData cannot be read as an image") from error
    width, height = inside.size_for(annotated)
    if annotated not in (None, (width, height)):
        found = f"imageData is {width}x{height}"
        raise DataError(f"{path}: {found}, the annotation {size[0]}x{size[1]}")
    name, pixels = os.path.abspath(file), functools.partial(_embedded, path)
    return SourceImage(Path(name), width, height, inside.is_turned(annotated), pixels)


def _embedded(path: Path, content: dict[str, Any] | None = None) -> bytes:
    return base64.b64decode((content or load_json(path))["imageData"], validate=True)


def _objects(
    path: Path, shapes: Sequence[Any], image: SourceImage, source: SourceDataset
) -> list[SourceObject]:
    """Return the objects of one file; shapes of a group are joined."""
    groups: dict[tuple[str, str], list[Any]] = {}
    where_of: dict[tuple[str, str], str] = {}
    for number, shape in enumerate(shapes, start=1):
        where = f"{path}: shape {number}"
        label = shape.get("label") if isinstance(shape, dict) else None
        if not isinstance(label, str) or not label.strip():
            raise DataError(f"{where}: no label")
        part = _outline(shape, image, where)
        if part is None:
            source.skip(f"shape of type {shape['shape_type']!r}", where)
            continue
        group = shape.get("group_id")
        key = (label.strip(), f"shape {number}" if group is None else f"group {group}")
        groups.setdefault(key, []).append(part)
        where_of.setdefault(key, where)
    return [
        SourceObject(key[0], join_parts(parts, image.height, image.width), where_of[key])
        for key, parts in groups.items()
    ]


def _outline(shape: dict[str, Any], image: SourceImage, where: str) -> Any:
    """Return a polygon [x, y, ...] or an RLE; None for a shape that has no inside."""
    kind = str(shape.get("shape_type") or "polygon")
    if kind not in _NEEDS:
        return None
    try:
        points = [parse_numbers(point, 2) for point in shape["points"]]
        if kind == "mask":
            return _mask(points, shape["mask"], image)
        if kind == "circle":
            (cx, cy), (x, y) = points
            radius = float(np.hypot(x - cx, y - cy))
            return ellipse(cx, cy, radius, radius)
        if kind == "rectangle" and len(points) != 4:  # some versions write all four corners
            (x0, y0), (x1, y1) = points
            return rectangle(x0, y0, x1, y1)
        return [value for point in points for value in point]
    except (KeyError, OSError, TypeError, ValueError) as error:
        raise DataError(f"{where}: {kind} needs {_NEEDS[kind]}") from error


def _mask(points: Sequence[Sequence[float]], text: str, image: SourceImage) -> dict[str, Any]:
    """Return the RLE of a mask that begins at the first point, cut at the image's border.

    labelme counts the last row and column into the box of the two points, other programs do not.
    """
    (x0, y0), (x1, y1) = (tuple(map(math.floor, point)) for point in points)
    with Image.open(io.BytesIO(base64.b64decode(text, validate=True))) as image_file:
        inside = np.asarray(image_file.convert("L")) > 0
    if not (0 <= y1 - y0 + 1 - inside.shape[0] <= 1 and 0 <= x1 - x0 + 1 - inside.shape[1] <= 1):
        raise ValueError("size of the mask")
    whole = np.zeros((image.height, image.width), dtype=np.bool_)
    left, top = max(x0, 0), max(y0, 0)
    seen = inside[top - y0 : max(image.height - y0, 0), left - x0 : max(image.width - x0, 0)]
    whole[top : top + seen.shape[0], left : left + seen.shape[1]] = seen
    return encode_mask(whole)
