"""Read JSON of the VGG Image Annotator (VIA), versions 1 and 2 (no torch)."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cohdc_train.data.formats.base import (
    SourceDataset,
    SourceImage,
    SourceObject,
    annotation_files,
    ellipse,
    open_image,
    parse_numbers,
    read_lines,
    rectangle,
    skip_unlisted,
)
from cohdc_train.data.formats.splits import TEST, settle_splits, split_named, split_of
from cohdc_train.data.layout import load_json
from cohdc_train.errors import DataError
from cohdc_train.types import Row

_NEEDS = {
    "polygon": ("all_points_x", "all_points_y"),
    "rect": ("x", "y", "width", "height"),
    "circle": ("cx", "cy", "r"),
    "ellipse": ("cx", "cy", "rx", "ry"),
}


def read_via(root: Path, attribute: str | None = None, names: Path | None = None) -> SourceDataset:
    """Read a folder of images and VIA's JSON files, or one such file with its images in its folder.

    Polylines, points and regions without exactly one class are skipped and counted. Folders, or
    JSON files, named train, val and test are the source's own split.

    Args:
        root: the folder or the file.
        attribute: the region attribute that holds the class; needed where there are several.
        names: a file with one class for all regions, instead.

    Raises:
        DataError: a file cannot be used; one line names the file, the image and the region, or the
            attributes to choose from.
    """
    source = SourceDataset()
    contents = {path: list(_entries(path)) for path in annotation_files(root)}
    split_of_file = {path: _split_of_file(root, path) for path in contents}
    learned = [content for path, content in contents.items() if split_of_file[path] != TEST]
    entries = [entry for content in learned or contents.values() for _, entry in content]
    chosen, only = _class_attribute(root, entries, attribute, names)
    for path, content in contents.items():
        for folder, entry in content:
            where = f"{path}: {entry['filename']}"
            image = _image(path, folder, str(entry["filename"]))
            split = split_of_file[path] or split_of(root, image.path)
            if split != TEST:
                image = image.with_objects(_objects(where, _regions(entry), chosen, only, source))
            source.add(split, image)
    skip_unlisted(root, source, "image that no JSON lists")
    settle_splits(root, source)
    return source


def _split_of_file(root: Path, path: Path) -> str:
    """Return the split that a JSON file, or a folder on the way to it, is named after; else ""."""
    if path == root:
        return ""
    return split_of(root, path) or split_named(path.stem)


def _entries(path: Path) -> Iterator[tuple[str, Row]]:
    """Yield (the project's folder of images, entry) of every image that a file lists."""
    content = load_json(path)
    folder = ""
    if isinstance(content, dict) and isinstance(content.get("_via_img_metadata"), dict):
        with contextlib.suppress(KeyError, TypeError):
            folder = str(content["_via_settings"]["core"]["default_filepath"])
        content = content["_via_img_metadata"]
    if not isinstance(content, dict) or not content:
        raise DataError(f"{path}: not VIA's: no images")
    for key, entry in content.items():
        listed = isinstance(entry, dict) and isinstance(entry.get("regions"), list | dict)
        if not listed or not isinstance(entry.get("filename"), str):
            raise DataError(f"{path}: not VIA's: {key!r:.60} has no filename and regions")
        for number, region in enumerate(_regions(entry), start=1):
            for part in ("shape_attributes", "region_attributes"):
                if not isinstance(region, dict) or not isinstance(region.get(part), dict):
                    raise DataError(f"{path}: {entry['filename']}: region {number}: no {part}")
        yield folder, entry


def _regions(entry: Row) -> list[Any]:
    """Return the regions, which version 1 numbers in a mapping and version 2 lists."""
    regions = entry["regions"]
    return list(regions.values() if isinstance(regions, dict) else regions)


def _class_attribute(
    root: Path, entries: Sequence[Row], attribute: str | None, names: Path | None
) -> tuple[str, str | None]:
    """Return the attribute that holds the class; or "" and the class of all regions."""
    regions = [region for entry in entries for region in _regions(entry)]
    found = {name for region in regions for name in region["region_attributes"]}
    candidates = ", ".join(sorted(found))
    if names is not None and attribute is None:
        lines = [text for _, text in read_lines(names)]
        if len(lines) != 1:
            fix = "--names gives all regions one, --attribute each its own"
            raise DataError(f"{names}: {len(lines)} classes; {fix}")
        return "", lines[0]
    if attribute is not None:
        if attribute not in found:
            raise DataError(
                f"{root}: no region attribute {attribute!r}; there is {candidates or 'none'}"
            )
        return attribute, None
    if len(found) > 1:
        raise DataError(
            f"{root}: several region attributes, name the class's with --attribute: {candidates}"
        )
    if not found:
        raise DataError(
            f"{root}: no region attribute to take the class from; name it in a file, --names FILE"
        )
    return found.pop(), None


def _image(path: Path, folder: str, name: str) -> SourceImage:
    places = [path.parent / name, path.parent / folder / name]
    # os.path.isfile is False for a name that is too long for a file
    file = next((place for place in places if os.path.isfile(place)), None)
    if file is None:
        raise DataError(f"{path}: image {name!r:.200} is not in its folder")
    return open_image(file)


def _objects(
    where: str, regions: Sequence[Row], attribute: str, only: str | None, source: SourceDataset
) -> list[SourceObject]:
    """Return the objects of one image.

    only: the class of all of them, where there is no attribute.
    """
    objects = []
    for number, region in enumerate(regions, start=1):
        here = f"{where}: region {number}"
        shape = region["shape_attributes"]
        kind = str(shape.get("name"))
        names = [only] if only else _classes(region["region_attributes"].get(attribute))
        if kind not in _NEEDS:
            source.skip(f"region of shape {kind!r}", here)
        elif len(names) != 1:
            source.skip(
                "region of several classes" if names else f"region without {attribute!r}", here
            )
        else:
            objects.append(SourceObject(names[0], [_outline(shape, here)], here))
    return objects


def _classes(value: Any) -> list[str]:
    """Return the classes that an attribute's value names: one of a text, several of checkboxes."""
    if isinstance(value, dict):
        return [str(name) for name, checked in value.items() if checked]
    return [str(value).strip()] if value is not None and str(value).strip() else []


def _outline(shape: Row, where: str) -> list[float]:
    """Return a polygon [x, y, ...], px."""
    kind = shape["name"]
    try:
        if kind == "polygon":
            points = zip(
                parse_numbers(shape["all_points_x"]),
                parse_numbers(shape["all_points_y"]),
                strict=True,
            )
            return [value for point in points for value in point]
        values = parse_numbers(shape[key] for key in _NEEDS[kind])
        if kind == "rect":
            x, y, width, height = values
            return rectangle(x, y, x + width, y + height)
        cx, cy, rx, ry = values if kind == "ellipse" else (*values, values[-1])
        return ellipse(cx, cy, rx, ry, *parse_numbers([shape.get("theta", 0)]))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where}: {kind} needs {', '.join(_NEEDS[kind])}") from error
