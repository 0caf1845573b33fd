"""Read Pascal VOC segmentation: PNGs of objects and of classes, as VOC 2012 and CVAT write them.

No torch.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from cohdc_train.data.formats.base import (
    SourceDataset,
    SourceImage,
    SourceObject,
    encode_mask,
    open_image,
    read_lines,
)
from cohdc_train.data.formats.splits import TEST, TEST_SKIPPED, split_named
from cohdc_train.errors import DataError
from cohdc_train.images import IMAGE_SUFFIXES
from cohdc_train.types import Int32Array

# fmt: off
VOC_NAMES = (
    "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow",
    "diningtable", "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train",
    "tvmonitor",
)
# fmt: on
_BACKGROUND = frozenset(["background", "_background_"])
_IGNORED = frozenset(["ignored", "__ignore__"])
_VOID = 255
_NUMBERS = ("P", "L", "1")  # modes of PNGs whose pixels are numbers
_MODES = (*_NUMBERS, "RGB", "RGBA")


class ClassTable(NamedTuple):
    """Classes of a source and their colors.

    Attributes:
        names: name of class i + 1 at index i.
        colors: 0xRRGGBB -> class (0 background, 255 void).
        painted: the colors come from a file.
    """

    names: tuple[str, ...]
    colors: dict[int, int]
    painted: bool


def read_voc(root: Path, names: Path | None = None) -> SourceDataset:
    """Read JPEGImages/, SegmentationObject/, SegmentationClass/ and ImageSets/Segmentation/.

    Where there is no train.txt and val.txt, a split is drawn from trainval.txt or CVAT's
    default.txt. The images of test.txt are skipped and counted, unless val.txt has them, too. An
    object's class is that of most class pixels under it; 255 is void and belongs to nothing. Class
    ids keep the order of the names.

    Args:
        root: the folder.
        names: a file with a class per line, or CVAT's labelmap.txt; without it the folder's
            labelmap.txt, else VOC's 20 classes.

    Raises:
        DataError: a file cannot be used; one line names the file and the line.
    """
    table = _class_table(
        names or (root / "labelmap.txt" if (root / "labelmap.txt").is_file() else None)
    )
    source = SourceDataset(class_names=table.names)
    image_files = {
        path.relative_to(root / "JPEGImages").with_suffix("").as_posix(): path
        for path in sorted((root / "JPEGImages").rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES
    }
    lists = _lists(root)
    tests = _skip_test(lists, source)
    for split, listed in lists.items():
        source.splits[split] = []
        for number, stem in read_lines(listed):
            if stem not in image_files:
                raise DataError(f"{listed}:{number}: no image {stem!r} in {root / 'JPEGImages'}")
            if split == "val" or stem not in tests:
                source.splits[split].append(
                    _read_image(root, stem, image_files[stem], table, source)
                )
        if not split:
            source.drawn_from = listed.name
    return source


def _skip_test(lists: dict[str, Path], source: SourceDataset) -> set[str]:
    """Remove the list of the test split, count its images, and return their names."""
    listed = lists.pop(TEST, None)
    if listed is None:
        return set()
    val = {stem for _, stem in read_lines(lists["val"])} if "val" in lists else set()
    rows = read_lines(listed)
    for number, stem in rows:
        if stem not in val:
            source.skip(TEST_SKIPPED, f"{listed}:{number}: {stem}")
    return {stem for _, stem in rows}


def _lists(root: Path) -> dict[str, Path]:
    """Return split -> the file that lists its images; "" -> one that a split is drawn from."""
    folder = root / "ImageSets" / "Segmentation"
    files = {path.stem.lower(): path for path in sorted(folder.glob("*.txt"))}
    named = {split: path for stem, path in files.items() if (split := split_named(stem))}
    test = {TEST: named.pop(TEST)} if TEST in named else {}
    if len(named) == 2:
        return {"train": named["train"], "val": named["val"]} | test
    whole = files.get("trainval") or files.get("default")
    if whole is None:
        places = "no train.txt and val.txt, and no trainval.txt or default.txt"
        raise DataError(f"{folder}: {places}")
    return {"": whole} | test


def _class_table(path: Path | None) -> ClassTable:
    """Return the classes of a file of lines `name` or `name:R,G,B:...`; VOC's without a file."""
    rows = [(0, name) for name in VOC_NAMES] if path is None else read_lines(path)
    names: list[str] = []
    colors = {0x000000: 0, _voc_color(_VOID): _VOID}
    painted = False
    for number, row in rows:
        name, _, rest = (part.strip() for part in row.partition(":"))
        if row.startswith("#"):
            continue
        known = 0 if name in _BACKGROUND else _VOID if name in _IGNORED else len(names) + 1
        if not name or name in names:
            fault = f"class {name!r} is listed twice" if name else "no name"
            raise DataError(f"{path}:{number}: {fault}")
        if known == len(names) + 1:
            names.append(name)
        words = rest.partition(":")[0].split(",")
        try:
            color = _packed(*map(int, words)) if rest.strip(": ") else _voc_color(known)
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}:{number}: not name:R,G,B") from error
        painted |= bool(rest.strip(": "))
        if 0 < colors.get(color, 0) < _VOID:
            raise DataError(f"{path}:{number}: {name} has the color of {names[colors[color] - 1]}")
        colors[color] = known
    if not 0 < len(names) < _VOID:
        raise DataError(f"{path}: {len(names)} classes; 1 to {_VOID - 1} can be told apart")
    return ClassTable(tuple(names), colors, painted)


def _packed(red: int, green: int, blue: int) -> int:
    return red << 16 | green << 8 | blue


def _voc_color(index: int) -> int:
    """Return VOC's color of a class, 0xRRGGBB.

    Every third bit of the index goes to red, green or blue, lowest bits highest.
    """
    channels = [0, 0, 0]
    for bit in range(8):
        channels[bit % 3] |= (index >> bit & 1) << (7 - bit // 3)
    return _packed(*channels)


def _read_image(
    root: Path, stem: str, image_file: Path, table: ClassTable, source: SourceDataset
) -> SourceImage:
    files = [
        root / folder / f"{stem}.png" for folder in ("SegmentationObject", "SegmentationClass")
    ]
    objects, void = _object_labels(files[0])
    classes = _class_labels(files[1], table)
    height, width = objects.shape
    if classes.shape != objects.shape:
        raise DataError(
            f"{files[1]}: {classes.shape[1]}x{classes.shape[0]}, {files[0]} {width}x{height}"
        )
    image = open_image(image_file, (width, height))
    found = []
    for value in np.unique(objects):
        if value in (0, void):
            continue
        mask = objects == value
        votes = np.bincount(classes[mask], minlength=_VOID + 1)[1:_VOID]
        where = f"{files[0]}: object {value}"
        if votes.any():
            found.append(SourceObject(table.names[int(votes.argmax())], encode_mask(mask), where))
        else:
            source.skip("object without a pixel of a class under it", where)
    return image.with_objects(found)


def _object_labels(path: Path) -> tuple[Int32Array, int]:
    """Return the number of the object at each pixel, [H, W], 0: none; and the number of void."""
    with _open_png(path) as image_file:
        if image_file.mode in _NUMBERS:
            return np.asarray(image_file).astype(np.int32), _VOID
        return _packed_colors(image_file), _voc_color(_VOID)


def _class_labels(path: Path, table: ClassTable) -> Int32Array:
    """Return the class at each pixel, [H, W]: 1..C, 0 background, 255 void."""
    with _open_png(path) as image_file:
        if image_file.mode in _NUMBERS and not (image_file.mode == "P" and table.painted):
            labels = np.asarray(image_file).astype(np.int32)
            unknown = labels[(labels > len(table.names)) & (labels != _VOID)]
            if unknown.size:
                raise DataError(f"{path}: class {unknown.max()} where there are {len(table.names)}")
            return labels
        colors = _packed_colors(image_file)
    values, place = np.unique(colors, return_inverse=True)
    unknown = [value for value in values.tolist() if value not in table.colors]
    if unknown:
        red, green, blue = int(unknown[0]).to_bytes(3, "big")
        raise DataError(f"{path}: color {red},{green},{blue} is no class's")
    known = np.array([table.colors[value] for value in values.tolist()], dtype=np.int32)
    return known[place.reshape(colors.shape)]


def _packed_colors(image_file: Image.Image) -> Int32Array:
    """Return the color at each pixel, [H, W], 0xRRGGBB."""
    rgb = np.asarray(image_file.convert("RGB")).astype(np.int32)
    packed: Int32Array = rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]
    return packed


def _open_png(path: Path) -> Any:
    try:
        image_file = Image.open(path)
        image_file.load()
    except FileNotFoundError as error:
        raise DataError(f"{path}: does not exist") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as an image") from error
    if image_file.mode not in _MODES:
        raise DataError(
            f"{path}: a PNG of mode {image_file.mode}; a palette, 8-bit gray and RGB can be read"
        )
    return image_file
