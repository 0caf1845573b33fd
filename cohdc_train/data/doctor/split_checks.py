"""Check one split of a COCO-format folder row by row, and fix its rows (no torch)."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as rle

from cohdc_train.data.annotations import is_crowd
from cohdc_train.data.doctor.annotation_checks import check_annotation, fits_image
from cohdc_train.data.doctor.issues import Issues
from cohdc_train.data.image_files import ImageFile, fingerprint, read_image_file
from cohdc_train.data.layout import SplitPaths, read_json
from cohdc_train.types import Float32Array, Row

_SAME_OBJECT = 0.95  # mask IoU
_HUGE = 24_000_000  # px
_CROWDED = 100  # objects


@dataclass
class SplitReport:
    """Result of the checks of one split.

    Attributes:
        name: "train" or "val".
        files: the paths of its files.
        issues: what is wrong.
        content: the fixed COCO dict.
        removed: rows that are not in it, each with its `why`.
        fingerprints: fingerprint [256] of every readable image, by file name.
    """

    name: str
    files: SplitPaths
    issues: Issues = field(default_factory=Issues)
    content: dict[str, Any] = field(default_factory=dict)
    removed: list[Row] = field(default_factory=list)
    fingerprints: dict[str, Float32Array] = field(default_factory=dict)

    def remove(self, why: str, row: Any) -> None:
        """Store a row that is not in the fixed content, with the reason."""
        self.removed.append({"why": why, "row": row})

    def reject(self, kind: str, where: str, row: Any) -> None:
        """Add an issue for which a row has to be removed."""
        self.issues.add(kind, where)
        self.remove(kind, row)


def check_split(name: str, files: SplitPaths) -> SplitReport:
    """Check every category, image and annotation of a split.

    Raises:
        DataError: the file is not COCO format.
    """
    given = read_json(files.annotations)
    split = SplitReport(name, files)
    categories, join = _categories(split, given["categories"])
    rows = [row for row in given["annotations"] if _is_row(split, row)]
    images, joined = _images(split, given["images"], rows)
    for row in rows:
        row["image_id"] = joined.get(row.get("image_id"), row.get("image_id"))
        row["category_id"] = join.get(row.get("category_id"), row.get("category_id"))
    listed = {row.get("id") for row in given["images"] if isinstance(row, dict)}
    annotations = _annotations(split, rows, images, {row["id"] for row in categories}, listed)
    _note_objects(split, categories, images, annotations)
    split.content = given | {
        "images": list(images.values()),
        "annotations": annotations,
        "categories": categories,
    }
    return split


def _is_row(split: SplitReport, row: Any) -> bool:
    ids = ("id", "image_id", "category_id")
    if isinstance(row, dict) and not any(isinstance(row.get(key), list | dict) for key in ids):
        return True
    split.reject("annotation-broken", f"{row!r:.40}", row)
    return False


def _categories(split: SplitReport, given: Sequence[Any]) -> tuple[list[Row], dict[int, int]]:
    """Return the sound categories, and the first id of each name by every other id of that name."""
    kept: dict[int, Row] = {}
    first: dict[str, int] = {}
    join: dict[int, int] = {}
    for row in given:
        if not _is_category(row):
            split.reject("category-broken", f"{row!r:.40}", row)
            continue
        name, number = str(row["name"]), row["id"]
        if number in kept and kept[number]["name"] != name:
            split.reject("category-id-twice", f"{number}: {kept[number]['name']}, {name}", row)
        elif name in first:
            split.reject("category-name-twice", name, row)
            join[number] = first[name]
        else:
            kept[number], first[name] = row, number
    if sorted(kept) != list(range(1, len(kept) + 1)):
        split.issues.add(
            "category-gap",
            ", ".join(map(str, sorted(kept)[:8])) + (" ..." if len(kept) > 8 else ""),
        )
    return list(kept.values()), join


def _images(
    split: SplitReport, given: Sequence[Any], rows: Sequence[Row]
) -> tuple[dict[Any, Row], dict[Any, Any]]:
    """Return the sound images by id; and the first id of a file by each other id of it."""
    by_id: dict[Any, list[Row]] = defaultdict(list)
    for row in given:
        if not _is_image(row):
            split.reject("image-broken", f"{row!r:.60}", row)
        elif row not in by_id[row["id"]]:
            by_id[row["id"]].append(row)
    owned: dict[Any, list[Row]] = defaultdict(list)
    for row in rows:
        owned[row.get("image_id")].append(row)
    kept: dict[Any, Row] = {}
    first: dict[str, Any] = {}
    joined: dict[Any, Any] = {}
    for number, same in by_id.items():
        if len(same) > 1:
            for row in same:
                split.reject("image-id-twice", str(row["file_name"]), row)
            continue
        row = same[0]
        if row["file_name"] in first:
            split.issues.add("image-listed-twice", row["file_name"])
            split.remove("image-listed-twice", row)
            joined[number] = first[row["file_name"]]
        elif (fixed := _image(split, row, owned[number])) is not None:
            kept[number], first[row["file_name"]] = fixed, number
    return kept, joined


def _image(split: SplitReport, row: Row, annotations: Sequence[Row]) -> Row | None:
    """Compare one image row with its file; None when it has to be removed."""
    name = str(row["file_name"])
    path = split.files.images / name
    file = read_image_file(path, decode=True)
    if file.problem:
        split.reject(f"image-{file.problem}", name, row)
        return None
    for kind, found in (
        ("image-color", not file.is_8bit),
        ("image-huge", file.stored[0] * file.stored[1] > _HUGE),
    ):
        if found:
            split.issues.add(kind, name)
    split.fingerprints[name] = _fingerprint(path)
    sized = _with_file_size(split, row, file, annotations)
    if sized is not None and file.orientation > 1:
        is_turned = file.is_turned((sized["width"], sized["height"]))
        split.issues.add("image-turned" if is_turned else "image-exif", name)
    return sized


def _fingerprint(path: Path) -> Float32Array:
    try:
        return fingerprint(path)
    except OSError:  # a format that only OpenCV reads
        return np.zeros(256, dtype=np.float32)


def _with_file_size(
    split: SplitReport, row: Row, file: ImageFile, annotations: Sequence[Row]
) -> Row | None:
    """Return the image row under a size at which the file is read; None when no size fits.

    A file is read upright, or as stored where that is the only size that fits.
    """
    sizes = (file.upright, file.stored)
    if (row["width"], row["height"]) in sizes:
        return row | {"width": int(row["width"]), "height": int(row["height"])}
    split.issues.add("image-size", str(row["file_name"]))
    for width, height in sizes:
        if all(fits_image(annotation, height, width) for annotation in annotations):
            return row | {"width": width, "height": height}
    split.remove("image-size", row)
    return None


def _annotations(
    split: SplitReport,
    rows: Sequence[Row],
    images: dict[Any, Row],
    categories: set[int],
    listed: set[Any],
) -> list[Row]:
    """Return the fixed annotations. listed: ids of all images of the file, usable or not."""
    per_image: dict[Any, list[tuple[Row, dict[str, Any] | None]]] = defaultdict(list)
    for row in rows:
        image = images.get(row.get("image_id"))
        if image is None:
            if row.get("image_id") in listed:
                split.remove("its image was removed", row)
            else:
                split.reject("annotation-orphan", f"annotation {row.get('id')}", row)
            continue
        name = str(image["file_name"])
        if row.get("category_id") not in categories:
            split.reject("annotation-category", name, row)
            continue
        issues, fixed, shape = check_annotation(row, image["height"], image["width"])
        for kind in issues:
            split.issues.add(kind, name)
        if fixed is None:
            split.remove(issues[-1], row)
        else:
            per_image[image["id"]].append((fixed, shape))
    kept = [
        row
        for number, pairs in per_image.items()
        for row in _without_duplicates(split, images[number], pairs)
    ]
    return _with_unique_ids(split, kept, images)


def _without_duplicates(
    split: SplitReport, image: Row, pairs: Sequence[tuple[Row, dict[str, Any] | None]]
) -> list[Row]:
    """Return the annotations of an image without those that repeat one of their class."""
    duplicates: set[int] = set()
    classes: dict[Any, list[int]] = defaultdict(list)
    for i, (row, shape) in enumerate(pairs):
        if shape is not None and not is_crowd(row):
            classes[row["category_id"]].append(i)
    for members in classes.values():
        shapes = [pairs[i][1] for i in members]
        overlap = np.triu(rle.iou(shapes, shapes, [0] * len(shapes)), k=1) > _SAME_OBJECT
        duplicates |= {members[j] for j in np.nonzero(overlap.any(axis=0))[0]}
    for i in sorted(duplicates):
        split.reject("annotation-twice", str(image["file_name"]), pairs[i][0])
    return [row for i, (row, _) in enumerate(pairs) if i not in duplicates]


def _with_unique_ids(split: SplitReport, rows: Sequence[Row], images: dict[Any, Row]) -> list[Row]:
    """Return the annotations with an id each."""
    used: set[int] = set()
    following = max((row["id"] for row in rows if isinstance(row.get("id"), int)), default=0) + 1
    numbered = []
    for row in rows:
        if not isinstance(row.get("id"), int) or row["id"] in used:
            split.issues.add("annotation-id", str(images[row["image_id"]]["file_name"]))
            row, following = row | {"id": following}, following + 1
        used.add(row["id"])
        numbered.append(row)
    return numbered


def _note_objects(
    split: SplitReport,
    categories: Sequence[Row],
    images: dict[Any, Row],
    annotations: Sequence[Row],
) -> None:
    """Add issues about the number of objects per image and per class."""
    per_image: dict[Any, int] = defaultdict(int)
    for row in annotations:
        per_image[row["image_id"]] += 1
    for number, image in images.items():
        if not per_image[number]:
            split.issues.add("image-empty", str(image["file_name"]))
        elif per_image[number] > _CROWDED:
            split.issues.add("image-crowded", str(image["file_name"]))
    used = {row["category_id"] for row in annotations}
    for row in categories:
        if row["id"] not in used:
            split.issues.add("category-unused", str(row["name"]))


def _is_category(row: Any) -> bool:
    """Return whether a row has a whole-number id and a name."""
    if not isinstance(row, dict) or not isinstance(row.get("id"), int):
        return False
    return bool(str(row.get("name") or "").strip())


def _is_image(row: Any) -> bool:
    """Return whether a row has a file name, and id and size as whole numbers."""
    if not isinstance(row, dict) or not row.get("file_name"):
        return False
    return _are_whole(row, "id", "width", "height")


def _are_whole(row: Row, *keys: str) -> bool:
    return all(isinstance(row.get(key), int | float) and row[key] == int(row[key]) for key in keys)
