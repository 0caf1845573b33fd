"""Read COCO-format annotations into checked objects with labels 1..C (no torch).

The number of classes is read from the file. Category ids are remapped through `categories`, sorted
by id, to 1..C.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cohdc_train.data.annotations import (
    CocoImage,
    CocoObject,
    broken_polygons,
    build_object,
    exceeds_image,
    find_defect,
    read_segmentation,
)
from cohdc_train.data.layout import CocoPaths, SplitPaths, find_split, read_json
from cohdc_train.errors import DataError


@dataclass(frozen=True)
class CocoSplit:
    """One split, ready to train on or to score against.

    Attributes:
        name: "train" or "val".
        annotations: the file that it was read from.
        class_names: name of label i + 1 at index i.
        images: sorted by id.
        dropped: number of annotations that were skipped, by reason.
        clipped: number of annotations that reached more than 1 px out of their image.
        broken_polygons: number of polygons skipped from contours that have others.
    """

    name: str
    annotations: Path
    class_names: tuple[str, ...]
    images: tuple[CocoImage, ...]
    dropped: dict[str, int] = field(default_factory=dict)
    clipped: int = 0
    broken_polygons: int = 0

    def with_class_order(self, class_names: Sequence[str]) -> "CocoSplit":
        """Return the split with labels in another order of the same class names.

        Raises:
            DataError: the names differ.
        """
        if tuple(class_names) == self.class_names:
            return self
        if set(class_names) != set(self.class_names):
            ours, theirs = ", ".join(self.class_names), ", ".join(class_names)
            raise DataError(
                f"{self.annotations}: classes are {ours}; the training split's are {theirs}"
            )
        labels = {
            label: class_names.index(name) + 1 for label, name in enumerate(self.class_names, 1)
        }
        return self._relabeled(class_names, labels)

    def with_classes(self, class_names: Sequence[str]) -> "CocoSplit":
        """Return the split with the objects of some of its classes only.

        Raises:
            DataError: no object is left.
        """
        kept = [name for name in self.class_names if name in class_names]
        labels = {self.class_names.index(name) + 1: kept.index(name) + 1 for name in kept}
        split = self._relabeled(kept, labels)
        split.check_objects()
        return split

    def _relabeled(self, class_names: Sequence[str], labels: dict[int, int]) -> "CocoSplit":
        """Return the split with new labels, without objects whose label has no new one."""
        images = []
        for image in self.images:
            kept = [o for o in image.objects if o.label in labels]
            objects = tuple(replace(o, label=labels[o.label]) for o in kept)
            images.append(replace(image, objects=objects))
        return replace(self, class_names=tuple(class_names), images=tuple(images))

    def check_objects(self) -> None:
        """Raise DataError when there is no object to learn or to score."""
        if not self.without_empty_images().images:
            why = dict(self.dropped) or "no annotation of these classes"
            raise DataError(f"{self.annotations}: no object to learn: {why}")

    def subset(self, count: int | None) -> "CocoSplit":
        """Return the split with `count` images, drawn at random but always the same; None for all.

        A larger subset contains the smaller.

        Raises:
            DataError: the split has fewer images.
        """
        if count is None:
            return self
        if not 0 < count <= len(self.images):
            wanted = f"{count} {self.name} images asked for, {len(self.images)} there"
            raise DataError(f"{self.annotations}: {wanted}")
        chosen = sorted(np.random.default_rng(0).permutation(len(self.images))[:count])
        return replace(self, images=tuple(self.images[i] for i in chosen))

    def without_empty_images(self) -> "CocoSplit":
        """Return the split without images that have no object."""
        return replace(
            self,
            images=tuple(image for image in self.images if any(not o.crowd for o in image.objects)),
        )

    def reading_report(self) -> str:
        """Return one line that counts what reading skipped or clipped; empty when nothing was."""
        parts = [
            f"{number} annotations dropped ({reason})"
            for reason, number in sorted(self.dropped.items())
        ]
        parts += [f"{self.clipped} clipped to the image"] if self.clipped else []
        parts += (
            [f"{self.broken_polygons} broken polygons skipped in contours"]
            if self.broken_polygons
            else []
        )
        return f"{self.annotations}: {', '.join(parts)}" if parts else ""

    def ground_truth(self) -> dict[str, Any]:
        """Return the kept objects as a COCO dict with category ids 1..C, for the scores."""
        categories = [{"id": i + 1, "name": name} for i, name in enumerate(self.class_names)]
        images = [
            {"id": image.id, "height": image.height, "width": image.width} for image in self.images
        ]
        annotations: list[dict[str, Any]] = []
        for image in self.images:
            for o in image.objects:
                row = {
                    "id": len(annotations) + 1,
                    "image_id": image.id,
                    "category_id": o.label,
                    "bbox": list(o.box),
                }
                shape = o.segmentation or _box_polygon(o.box)
                annotations.append(
                    {**row, "area": o.area, "iscrowd": int(o.crowd), "segmentation": shape}
                )
        return {"images": images, "categories": categories, "annotations": annotations}


@dataclass(frozen=True)
class CocoFolder:
    """Training splits, one per root, and the first root's validation split, of the same classes."""

    train: tuple[CocoSplit, ...]
    val: CocoSplit

    @property
    def class_names(self) -> tuple[str, ...]:
        """Name of label i + 1 at index i."""
        return self.val.class_names


def read_folder(
    roots: Sequence[Path], classes: Sequence[str] | None = None, paths: CocoPaths | None = None
) -> CocoFolder:
    """Read the training and validation data of one or several folders.

    The class labels are those of the first training split. The other splits must have the same
    names after the filter; their ids may differ.

    Args:
        roots: the folders.
        classes: keep these classes only; None keeps all.
        paths: places of the first root's files, where its layout is an unusual one, or instead of
            it.

    Raises:
        DataError: a file cannot be used; one line names the file and the id.
    """
    paths = paths or CocoPaths()
    if not roots and (paths.train_json is None or paths.val_json is None):
        needed = "train_json, train_images, val_json and val_images"
        raise DataError(f"no data: give a folder (cohdc fit DATA) or data.paths: {needed}")
    found = [
        paths.split("train") or find_split(roots[0], "train"),
        *(find_split(r, "train") for r in roots[1:]),
    ]
    train = [read_split("train", files, classes) for files in found]
    names = train[0].class_names
    val = read_split("val", paths.split("val") or find_split(roots[0], "val"), classes)
    return CocoFolder(
        tuple(split.with_class_order(names) for split in train), val.with_class_order(names)
    )


def read_split(name: str, files: SplitPaths, classes: Sequence[str] | None = None) -> CocoSplit:
    """Read and check one annotation file.

    Segmentations may be polygons, compressed or uncompressed RLE. Objects whose box or contour has
    no extent inside the image are dropped and counted, and so are boxes without a contour.

    Args:
        name: "train" or "val".
        files: the annotation file and the folder of its images.
        classes: keep these classes only; None keeps all.

    Raises:
        DataError: an image, an annotation or a class cannot be used; one line names it and the
            file.
    """
    content = read_json(files.annotations)
    names, labels = _class_map(files.annotations, content["categories"], classes)
    listed = [_read_image(files, row) for row in content["images"]]
    images = {image.id: image for image in listed}
    if len(images) != len(content["images"]):
        raise DataError(
            f"{files.annotations}: {len(content['images']) - len(images)} image ids are used twice"
        )
    objects: dict[int, list[CocoObject]] = {image_id: [] for image_id in images}
    dropped: Counter[str] = Counter()
    clipped = lost = 0
    for row in content["annotations"]:
        image, label = _references(files.annotations, row, images, labels)
        if label == 0:
            continue
        segmentation = read_segmentation(files.annotations, row, image)
        reason = find_defect(row, segmentation, image)
        if reason:
            dropped[reason] += 1
            continue
        lost += broken_polygons(row, segmentation)
        clipped += exceeds_image(row.get("bbox"), image)
        objects[image.id].append(build_object(row, label, segmentation, image))
    kept = tuple(replace(images[i], objects=tuple(objects[i])) for i in sorted(images))
    split = CocoSplit(name, files.annotations, names, kept, dict(dropped), clipped, lost)
    split.check_objects()
    return split


def _class_map(
    path: Path, categories: list[dict[str, Any]], classes: Sequence[str] | None
) -> tuple[tuple[str, ...], dict[int, int]]:
    """Return class names in label order, and category id -> label (0: not in `classes`)."""
    try:
        known = dict(sorted((int(row["id"]), str(row["name"])) for row in categories))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: a category without a numeric id and a name") from error
    if len(known) != len(categories) or len(set(known.values())) != len(known):
        raise DataError(f"{path}: categories with the same id or name")
    unknown = [name for name in classes or () if name not in known.values()]
    if unknown:
        raise DataError(f"{path}: no class {unknown[0]!r}; it has {', '.join(known.values())}")
    names = tuple(name for name in known.values() if classes is None or name in classes)
    if not names:
        raise DataError(f"{path}: no class at all")
    return names, {i: names.index(name) + 1 if name in names else 0 for i, name in known.items()}


def _read_image(files: SplitPaths, row: dict[str, Any]) -> CocoImage:
    try:
        image_id, height, width = int(row["id"]), int(row["height"]), int(row["width"])
        path = files.images / str(row["file_name"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{files.annotations}: image {row}: needs id, file_name, height and width"
        ) from error
    if not path.is_file():
        raise DataError(f"{files.annotations}: image {image_id}: {path} does not exist")
    return CocoImage(image_id, path, height, width, ())


def _references(
    path: Path, row: Any, images: dict[int, CocoImage], labels: dict[int, int]
) -> tuple[CocoImage, int]:
    """Return the image and the label that an annotation refers to."""
    if not isinstance(row, dict):
        raise DataError(
            f"{path}: annotation {row!r:.40}: needs id, image_id, category_id and segmentation"
        )
    for key, known in (("image_id", images), ("category_id", labels)):
        if not isinstance(row.get(key), int | float) or row[key] not in known:
            raise DataError(
                f"{path}: annotation {row.get('id')}: {key} {row.get(key)} is not in the file"
            )
    return images[row["image_id"]], labels[row["category_id"]]


def _box_polygon(box: Sequence[float]) -> list[list[float]]:
    x, y, width, height = box
    return [[x, y, x + width, y, x + width, y + height, x, y + height]]
