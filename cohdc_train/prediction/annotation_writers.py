"""Writers of annotation files that people and tools open: COCO, labelme, YOLO-seg."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import yaml

from cohdc_train.contour import Polygon, join_polygons
from cohdc_train.drawing import write_jpeg
from cohdc_train.errors import DataError
from cohdc_train.files import OwnFiles, write_text
from cohdc_train.prediction.image_sources import SourceImage
from cohdc_train.prediction.options import AnnotationFormat, PredictOptions
from cohdc_train.segmenter import Detections
from cohdc_train.types import FloatArray, Row

# Files of each format in the output folder, apart from those named after images.
FORMAT_FILES: dict[AnnotationFormat, tuple[str, ...]] = {
    "coco": ("predictions.json",),
    "labelme": ("review.txt", "overlays"),
    "yolo": ("data.yaml", "labels", "overlays"),
}
_LABELME_VERSION = "5.5.0"  # of labelme, whose files these are like


class ImageDetections(NamedTuple):
    """Detections of one image, without its pixels.

    Attributes:
        name: file name of the image.
        size: (height, width), px.
        detections: of the image.
        outlines: polygons of each detection.
    """

    name: str
    size: tuple[int, int]
    detections: Detections
    outlines: list[list[Polygon]]


class AnnotationWriter(Protocol):
    """Writer of one format."""

    def write_image(self, image: SourceImage, result: ImageDetections, /) -> None:
        """Write the files of one image."""

    def finish(self, results: Sequence[ImageDetections], content: dict[str, Any], /) -> None:
        """Write the files of all images. content: their COCO dictionary."""


def open_writer(
    out: Path, own: OwnFiles, class_names: tuple[str, ...], options: PredictOptions
) -> AnnotationWriter:
    """Make the writer of the format that the options ask for.

    Args:
        out: folder for the files.
        own: files of this run in it.
        class_names: name of each label.
        options: of the prediction.
    """
    if options.format == "labelme":
        return LabelmeWriter(out, own, class_names, options.check_below)
    if options.format == "yolo":
        return YoloWriter(out, own, class_names)
    return CocoWriter(out)


def coco_content(results: Sequence[ImageDetections], class_names: Sequence[str]) -> dict[str, Any]:
    """Build a COCO dictionary.

    Annotations also have `score`, `quality`, `category` and `file_name`.

    Args:
        results: one per image.
        class_names: name of each label.
    """
    images: list[Row] = []
    annotations: list[Row] = []
    for image_id, result in enumerate(results, start=1):
        height, width = result.size
        name = result.name
        images.append({"id": image_id, "file_name": name, "width": width, "height": height})
        for index, outline in enumerate(result.outlines):
            ids = {"id": len(annotations) + 1, "image_id": image_id, "file_name": name}
            annotations.append(ids | _annotation(result.detections, index, outline))
    categories = [{"id": label + 1, "name": name} for label, name in enumerate(class_names)]
    return {"images": images, "categories": categories, "annotations": annotations}


def _annotation(detections: Detections, index: int, outline: list[Polygon]) -> Row:
    x0, y0, x1, y1 = (float(v) for v in detections.boxes[index])
    label = int(detections.labels[index])
    rings = [polygon.keyhole() for polygon in outline]
    return {
        "category_id": label + 1,
        "category": detections.class_names[label],
        "bbox": [round(v, 2) for v in (x0, y0, x1 - x0, y1 - y0)],
        **_score_and_quality(detections, index),
        "segmentation": [_coordinates(ring) for ring in rings],
        "area": round(sum(_area(ring) for ring in rings), 2),
        "iscrowd": 0,
    }


def _score_and_quality(detections: Detections, index: int) -> dict[str, float]:
    return {
        "score": round(float(detections.scores[index]), 5),
        "quality": round(float(detections.quality[index]), 5),
    }


def _area(ring: FloatArray) -> float:
    """Compute the area of a ring [n, 2] by the shoelace formula, px^2."""
    x, y = ring.T
    previous, following = [*range(-1, len(x) - 1)], [*range(1, len(x)), 0]
    return float(abs(x @ (y[following] - y[previous])) / 2)


def _coordinates(ring: FloatArray) -> list[float]:
    """List x, y, x, y, ... of a ring to a tenth of a pixel, whole numbers without a point."""
    values = ring.ravel().round(1).tolist()
    return [int(value) if value == int(value) else value for value in values]


class CocoWriter:
    """Writer of predictions.json."""

    def __init__(self, out: Path) -> None:
        """Write into a folder."""
        self._out = out

    def write_image(self, image: SourceImage, result: ImageDetections) -> None:
        """Write nothing: one file holds all images."""

    def finish(self, results: Sequence[ImageDetections], content: dict[str, Any]) -> None:
        """Write predictions.json."""
        write_text(self._out / "predictions.json", json.dumps(content, separators=(",", ":")))


class LabelmeWriter:
    """Writer of <name>.json per image, and review.txt.

    Parts of an object share a group; holes are joined to the outer ring. Images are named relative
    to the folder; frames of a video are written next to their file.
    """

    def __init__(
        self, out: Path, own: OwnFiles, class_names: tuple[str, ...], check_below: float
    ) -> None:
        """Write into a folder; mark contours whose quality is below `check_below`."""
        self._out = out
        self._own = own
        self._class_names = class_names
        self._check_below = check_below

    def write_image(self, image: SourceImage, result: ImageDetections) -> None:
        """Write <name>.json, and the image where it has no file.

        Raises:
            DataError: there is such a file, which may hold somebody's work.
        """
        file = self._out / f"{image.stem}.json"
        if file.exists():
            raise DataError(f"{file}: exists, perhaps corrected by hand; give a new folder")
        if image.path is None:
            image_path = f"{image.stem}.jpg"
            write_jpeg(self._own.path(image_path), image.rgb)
        else:
            relative = os.path.relpath(image.path.resolve(), self._out.resolve())
            image_path = Path(relative).as_posix()
        height, width = result.size
        content: dict[str, Any] = {
            "version": _LABELME_VERSION,
            "flags": {},
            "shapes": self._shapes(result),
            "imagePath": image_path,
            "imageData": None,
            "imageHeight": height,
            "imageWidth": width,
        }
        write_text(self._own.path(file.name), json.dumps(content, indent=1))

    def _shapes(self, result: ImageDetections) -> list[Row]:
        """Build the shapes of all objects, the lowest quality first."""
        shapes = []
        for index in result.detections.quality.argsort(kind="stable").tolist():
            outline = result.outlines[index]
            group = index if len(outline) > 1 else None
            shapes += [self._shape(result.detections, index, part, group) for part in outline]
        return shapes

    def _shape(
        self, detections: Detections, index: int, polygon: Polygon, group: int | None
    ) -> Row:
        coordinates = _coordinates(polygon.keyhole())
        pairs = zip(coordinates[::2], coordinates[1::2], strict=True)
        values = _score_and_quality(detections, index)
        return {
            "label": self._class_names[int(detections.labels[index])],
            "points": [list(pair) for pair in pairs],
            "group_id": group,
            "shape_type": "polygon",
            "mask": None,
            "description": f"score {values['score']:.2f} quality {values['quality']:.2f}",
            "flags": {"check": values["quality"] < self._check_below},
        }

    def finish(self, results: Sequence[ImageDetections], content: dict[str, Any]) -> None:
        """Write review.txt: the images by the number of contours to check."""
        reviews = []
        for result in results:
            quality = result.detections.quality
            count = int((quality < self._check_below).sum())
            if count:
                reviews.append((-count, quality.min(), result))
        reviews.sort(key=lambda review: review[:2])
        lines = [
            f"{result.name}: {-count} of {len(result.outlines)} contours to check, "
            f"the worst of quality {lowest:.2f}\n"
            for count, lowest, result in reviews
        ]
        write_text(self._out / "review.txt", "".join(lines) or "no contour to check\n")


class YoloWriter:
    """Writer of labels/<name>.txt per image, and data.yaml.

    A line is an object: `class x y x y ...`, in shares of the image's width and height. Holes and
    further parts are joined by bridges of no width. There is no place for score and quality.
    data.yaml has the names only: for a training, put labels/ next to the folder images/, where
    frames of a video are written. Labels belong to images by their stem, so no two may share it.
    """

    def __init__(self, out: Path, own: OwnFiles, class_names: tuple[str, ...]) -> None:
        """Write into a folder, and make labels/ in it."""
        self._out = out
        self._own = own
        self._class_names = class_names
        (out / "labels").mkdir(exist_ok=True)

    def write_image(self, image: SourceImage, result: ImageDetections) -> None:
        """Write labels/<name>.txt, and images/<name>.jpg where the image has no file.

        Raises:
            DataError: another image has the same stem.
        """
        if image.path is None:
            (self._out / "images").mkdir(exist_ok=True)
            write_jpeg(self._own.path(f"images/{image.name}"), image.rgb)
        elif image.stem != image.path.stem:
            raise DataError(
                f"{image.path}: another image has this stem, and YOLO labels are found by it"
            )
        height, width = result.size
        lines = []
        labels = result.detections.labels.tolist()
        for label, outline in zip(labels, result.outlines, strict=True):
            shares = (join_polygons(outline) / (width, height)).ravel()
            words = [f"{share:.6f}".rstrip("0").rstrip(".") for share in shares]
            lines.append(" ".join([str(label), *words]) + "\n")
        write_text(self._own.path(f"labels/{image.stem}.txt"), "".join(lines))

    def finish(self, results: Sequence[ImageDetections], content: dict[str, Any]) -> None:
        """Write data.yaml."""
        names = {"names": dict(enumerate(self._class_names))}
        write_text(self._out / "data.yaml", yaml.safe_dump(names, sort_keys=False))
