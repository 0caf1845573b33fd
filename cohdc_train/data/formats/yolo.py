"""Read YOLO segmentation in Ultralytics' layout: data.yaml, images, and text files of polygons.

No torch.
"""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from cohdc_train.data.formats.base import (
    SourceDataset,
    SourceImage,
    SourceObject,
    open_image,
    parse_numbers,
    read_lines,
    rectangle,
)
from cohdc_train.errors import DataError
from cohdc_train.images import IMAGE_SUFFIXES
from cohdc_train.types import Row

_SPLITS = ("train", "val")
_FARTHEST = 2.0  # sides of the image; a larger coordinate is not normalized


def read_yolo(root: Path) -> SourceDataset:
    """Read a data.yaml, or the folder with it.

    It has `names`, and `train` and `val`, each a folder, a list file, or several. A row `class x y
    x y ...` is an object. A row of five numbers is a box, which becomes a rectangle and is counted.
    Images without a label file have no objects. Class ids keep their order.

    Raises:
        DataError: a file cannot be used; one line names the file and the line.
    """
    path = _find_yaml(root)
    content = _load_yaml(path)
    source = SourceDataset(class_names=_names(path, content.get("names")))
    for split in _SPLITS:
        images = sorted(set(_images(path, content, split)))
        source.splits[split] = [_read_image(image, source) for image in images]
    if content.get("test"):
        source.skip("test split", str(path))
    return source


def _find_yaml(root: Path) -> Path:
    if root.is_file():
        return root
    found = [root / "data.yaml"] if (root / "data.yaml").is_file() else sorted(root.glob("*.y*ml"))
    if len(found) != 1:
        raise DataError(
            f"{root}: {len(found)} YAML files where data.yaml should be"
            if found
            else f"{root}: no data.yaml"
        )
    return found[0]


def _load_yaml(path: Path) -> Row:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise DataError(f"{path}: line {mark.line + 1 if mark else 1}: not YAML") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: no mapping with names, train and val")
    return content


def _names(path: Path, given: Any) -> tuple[str, ...]:
    """Return class names by index, from a list or a mapping."""
    if isinstance(given, list):
        given = dict(enumerate(given))
    if not isinstance(given, dict) or not given or set(given) != set(range(len(given))):
        raise DataError(f"{path}: names must be a list, or a mapping from 0, 1, ... to names")
    names = tuple(str(given[i]).strip() for i in range(len(given)))
    if len(set(names)) != len(names):
        raise DataError(f"{path}: a name twice in names")
    return names


def _images(path: Path, content: Row, split: str) -> Iterator[Path]:
    """Yield the image files of a split."""
    given = content.get(split)
    if not given:
        raise DataError(f"{path}: no {split!r}")
    # `path` may belong to another machine
    roots = [path.parent / str(content.get("path") or "."), path.parent]
    for entry in given if isinstance(given, list) else [given]:
        # exporters write ../train/images for what lies in the folder of the file
        names = [str(entry), str(entry).removeprefix("../")]
        place = next(
            (root / name for root in roots for name in names if os.path.exists(root / name)), None
        )
        if place is None:
            raise DataError(f"{path}: {split}: {entry} does not exist")
        if place.is_dir():
            yield from (
                Path(os.path.abspath(p))
                for p in place.rglob("*")
                if p.suffix.lower() in IMAGE_SUFFIXES
            )
        else:
            yield from _listed(place, roots)


def _listed(path: Path, roots: Sequence[Path]) -> Iterator[Path]:
    """Yield the image files of a list file, relative to it or to the root of the data set."""
    for number, line in read_lines(path):
        found = next(
            (root / line for root in (path.parent, *roots) if os.path.isfile(root / line)), None
        )
        if found is None:
            raise DataError(f"{path}:{number}: {line} does not exist")
        yield Path(os.path.abspath(found))


def _label_file(image: Path) -> Path:
    """Return the text file of an image.

    It lies below `labels` where the image lies below the last `images` of its path.
    """
    parts = list(image.parts)
    for i in range(len(parts) - 2, -1, -1):
        if parts[i] == "images":
            parts[i] = "labels"
            break
    return Path(*parts).with_suffix(".txt")


def _read_image(path: Path, source: SourceDataset) -> SourceImage:
    image = open_image(path)
    labels = _label_file(path)
    if not labels.exists():
        source.note("image without a label file: no objects", str(path))
        return image
    return image.with_objects(
        [_object(f"{labels}:{number}", line, image, source) for number, line in read_lines(labels)]
    )


def _object(where: str, line: str, image: SourceImage, source: SourceDataset) -> SourceObject:
    """Return the object of one row."""
    names = source.class_names or ()
    index, *words = line.split()
    try:
        values = parse_numbers(words)
        label = int(float(index)) if float(index).is_integer() else -1
    except ValueError as error:
        raise DataError(f"{where}: not a row of numbers") from error
    if not 0 <= label < len(names):
        raise DataError(f"{where}: class {index}; names has 0 to {len(names) - 1}")
    if len(values) != 4 and (len(values) < 6 or len(values) % 2):
        needed = "x y of three points or more, or a box of four"
        raise DataError(f"{where}: {len(values)} numbers after the class; {needed}")
    if max(map(abs, values)) > _FARTHEST:
        farthest = max(values, key=abs)
        unit = "they are shares of the image's width and height"
        raise DataError(f"{where}: coordinate {farthest:g}; {unit}")
    if len(values) == 4:
        source.note("box without a polygon, written as a rectangle", where)
        cx, cy, width, height = values
        values = rectangle(cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2)
    sides = (image.width, image.height)
    return SourceObject(
        names[label], [[round(value * sides[i % 2], 3) for i, value in enumerate(values)]], where
    )
