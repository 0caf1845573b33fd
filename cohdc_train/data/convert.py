"""Convert labelme, VIA, YOLO and Pascal VOC to a COCO-format folder (no torch)."""

import io
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageOps

from cohdc_train.data.coco import CocoSplit, read_split
from cohdc_train.data.doctor.annotation_checks import check_annotation
from cohdc_train.data.doctor.doctor import summary
from cohdc_train.data.doctor.issues import ISSUE_KINDS
from cohdc_train.data.formats.base import SourceDataset, SourceImage
from cohdc_train.data.formats.labelme import read_labelme
from cohdc_train.data.formats.via import read_via
from cohdc_train.data.formats.voc import read_voc
from cohdc_train.data.formats.yolo import read_yolo
from cohdc_train.data.layout import find_split
from cohdc_train.errors import DataError
from cohdc_train.files import link_or_copy, new_folder, write_text

AnnotationFormat = Literal["labelme", "via", "yolo", "voc"]
_JPEG_QUALITY = 95  # of images that have to be turned
_TURNED = "image turned as its EXIF says, and written again"


def convert(
    format: AnnotationFormat,
    source: Path,
    out: Path,
    val: float = 0.2,
    seed: int = 0,
    attribute: str | None = None,
    names: Path | None = None,
) -> None:
    """Convert annotations of another format to a COCO-format folder.

    Skips what cannot be converted, and prints the counts. Writes `images/` (hard links where
    possible: do not edit them), `instances_train.json` and `instances_val.json`, all or nothing.

    Args:
        format: labelme: a folder of images, one JSON each. via: VGG Image Annotator's JSON in the
            folder of its images. yolo: Ultralytics' data.yaml, or its folder. voc: Pascal VOC's
            folder of segmentation PNGs, or CVAT's.
        source: the folder, or the annotation file.
        out: the folder to write, absent or empty.
        val: share of the images that go to validation, where the source has no split of its own.
            Images in folders (or of lists) named test are skipped and counted.
        seed: of the shuffle that chooses them; the same images for the same seed.
        attribute: via: the region attribute that holds the class, where there are several.
        names: voc: file with a class per line, or CVAT's labelmap.txt. via: file with the one class
            of all regions.

    Raises:
        DataError: a file cannot be used; one line names the file and the row.
    """
    with new_folder(out) as draft:
        dataset = _read_source(format, source, attribute, names)
        splits = _assign_splits(source, dataset, val, seed)
        classes = dataset.class_names or _class_names(splits)
        file_names = _write_images(splits.values(), draft / "images", dataset)
        for name, images in splits.items():
            content = _coco_content(images, file_names, classes, dataset)
            if not content["annotations"]:
                reasons = [f"{len(where)} skipped: {why}" for why, where in dataset.skipped.items()]
                problem = f"no object in {name} of {len(images)} images"
                raise DataError(f"{source}: {'; '.join([problem, *reasons])}")
            write_text(draft / f"instances_{name}.json", json.dumps(content))
        written = [_read_back(draft, name, out) for name in splits]
    print(f"split: {_describe_split(dataset, val, seed)}")
    print("\n".join(summary(split) for split in written))
    _print_counts("skipped", dataset.skipped)
    _print_counts("worth knowing", dataset.notes)
    print(f"next: cohdc data doctor {out}")


def _class_names(splits: Mapping[str, Sequence[SourceImage]]) -> list[str]:
    """Return the names of all classes that have an object, sorted."""
    images = [image for part in splits.values() for image in part]
    return sorted({o.name for image in images for o in image.objects})


def _describe_split(dataset: SourceDataset, val: float, seed: int) -> str:
    """Return where the split comes from."""
    if "" not in dataset.splits:
        return "the source's own"
    origin = f" from {dataset.drawn_from}" if dataset.drawn_from else ""
    return f"drawn{origin}, --val {val} --seed {seed}"


def _read_source(
    format: AnnotationFormat, source: Path, attribute: str | None, names: Path | None
) -> SourceDataset:
    if attribute is not None and format != "via":
        raise DataError(f"--attribute is for via, not for {format}")
    if names is not None and format not in ("via", "voc"):
        raise DataError(f"--names is for voc and via, not for {format}")
    if format == "labelme":
        return read_labelme(source)
    if format == "via":
        return read_via(source, attribute, names)
    return read_yolo(source) if format == "yolo" else read_voc(source, names)


def _assign_splits(
    source: Path, dataset: SourceDataset, val: float, seed: int
) -> dict[str, list[SourceImage]]:
    """Return the source's own split, or draw one: a share `val` of the images, at least one."""
    for images in dataset.splits.values():
        path, count = (
            Counter(image.path for image in images).most_common(1)[0] if images else (source, 1)
        )
        if count > 1:
            raise DataError(f"{path}: annotated {count} times")
    if "" not in dataset.splits:
        return dataset.splits
    images = sorted(dataset.splits[""], key=lambda image: image.path)
    if not 0 < val < 1:
        raise DataError(f"--val {val}: must be between 0 and 1")
    if len(images) < 2:
        raise DataError(
            f"{source}: {len(images)} image; two or more are needed, one for train and one for val"
        )
    count = min(max(round(val * len(images)), 1), len(images) - 1)
    drawn = set(np.random.default_rng(seed).permutation(len(images))[:count].tolist())
    parts = {"train": [image for i, image in enumerate(images) if i not in drawn]}
    return parts | {"val": [image for i, image in enumerate(images) if i in drawn]}


def _write_images(
    splits: Iterable[Sequence[SourceImage]], folder: Path, dataset: SourceDataset
) -> dict[Path, str]:
    """Write every image once, and return its file name by its path in the source.

    Images keep their bare names where these differ, else the folders that they do not share.
    """
    images = {image.path: image for part in splits for image in part}
    shared = Path(os.path.commonpath([path.parent for path in images])) if images else Path()
    flat = len({path.name.casefold() for path in images}) == len(images)
    names = {path: path.name if flat else path.relative_to(shared).as_posix() for path in images}
    for path, image in images.items():
        _write_image(image, folder / names[path])
        if image.apply_exif:
            dataset.note(_TURNED, str(path))
    return names


def _write_image(image: SourceImage, target: Path) -> None:
    """Link, copy, unpack or turn one image."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if image.apply_exif:
        with Image.open(io.BytesIO(image.pixels()) if image.pixels else image.path) as image_file:
            ImageOps.exif_transpose(image_file).save(target, quality=_JPEG_QUALITY)
    elif image.pixels:
        target.write_bytes(image.pixels())
    else:
        link_or_copy(image.path, target)


def _coco_content(
    images: Sequence[SourceImage],
    file_names: Mapping[Path, str],
    classes: Sequence[str],
    dataset: SourceDataset,
) -> dict[str, Any]:
    """Return the COCO dict of a split.

    Objects without a pixel are skipped; contours that leave the image are clipped.
    """
    ids = {name: i for i, name in enumerate(classes, start=1)}
    rows: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image_id, image in enumerate(images, start=1):
        size = {"width": image.width, "height": image.height}
        rows.append({"id": image_id, "file_name": file_names[image.path], **size})
        for o in image.objects:
            seen = check_annotation({"segmentation": o.segmentation}, image.height, image.width)
            kinds = [ISSUE_KINDS[kind].description for kind in seen.issues if kind != "box-missing"]
            if seen.row is None:
                dataset.skip(kinds.pop(), o.where)
            else:
                owner = {
                    "id": len(annotations) + 1,
                    "image_id": image_id,
                    "category_id": ids[o.name],
                    "iscrowd": 0,
                }
                annotations.append(owner | seen.row)
            for kind in kinds:
                dataset.note(kind, o.where)
    categories = [{"id": i, "name": name} for name, i in ids.items()]
    return {"images": rows, "annotations": annotations, "categories": categories}


def _read_back(draft: Path, name: str, out: Path) -> CocoSplit:
    """Read the written split as training will read it."""
    files = find_split(draft, name)
    if files.images != draft / "images":
        folder = files.images.relative_to(draft)
        fix = "rename the source's"
        raise DataError(
            f"{out}: images in {folder} would be taken for others of the same name; {fix}"
        )
    return read_split(name, files)


def _print_counts(title: str, counts: Mapping[str, Sequence[str]]) -> None:
    """Print how often each thing happened, and where first."""
    if counts:
        print(f"{title}:")
    for what, places in sorted(counts.items()):
        print(f"  {len(places):>6}  {what}: {places[0]}" + (" ..." if len(places) > 1 else ""))
