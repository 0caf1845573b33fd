"""What was found, as files that people and tools open: COCO, labelme, YOLO-seg."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, Self

import yaml

from cohdc_train.contour import Polygon, join_polygons
from cohdc_train.drawing import encode_jpeg
from cohdc_train.errors import DataError
from cohdc_train.files import OwnFiles, write_bytes, write_text
from cohdc_train.prediction.image_sources import Picture
from cohdc_train.segmenter import Detections
from cohdc_train.types import FloatArray

Format = Literal["coco", "labelme", "yolo"]
# What a format writes into the output folder, apart from files named after pictures.
FILES: dict[Format, tuple[str, ...]] = {
    "coco": ("predictions.json",),
    "labelme": ("review.txt", "overlays"),
    "yolo": ("data.yaml", "labels", "overlays"),
}
_LABELME = "5.5.0"  # whose files these are like


class Found(NamedTuple):
    """The objects of one picture, without its pixels.

    name: the picture's file name; size: (height, width) px; found: the detections; outlines:
    polygons of each.
    """

    name: str
    size: tuple[int, int]
    found: Detections
    outlines: list[list[Polygon]]

    @classmethod
    def of(cls, picture: Picture, found: Detections, outlines: list[list[Polygon]]) -> Self:
        """The objects of a picture."""
        return cls(picture.name, (picture.rgb.shape[0], picture.rgb.shape[1]), found, outlines)


class Files(Protocol):
    """How one format is written: picture by picture, and at the end."""

    def picture(self, picture: Picture, one: Found, /) -> None:
        """What belongs to one picture."""

    def close(self, seen: Sequence[Found], content: dict[str, Any], /) -> None:
        """What belongs to all of them; content: their COCO dictionary."""


def open_format(
    format: Format,
    out: Path,
    own: OwnFiles,
    class_names: tuple[str, ...],
    check_below: float,
) -> Files:
    """Return the writer of a format into a folder.

    own: the files of this run in `out`; check_below: quality below which labelme shapes are marked.
    """
    if format == "labelme":
        return _Labelme(out, own, class_names, check_below)
    return _Yolo(out, own, class_names) if format == "yolo" else _Coco(out)


def coco(seen: Sequence[Found], class_names: Sequence[str]) -> dict[str, Any]:
    """A COCO dictionary; annotations have `score`, `quality`, `category` and `file_name` besides
    COCO's own fields.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image_id, one in enumerate(seen, start=1):
        height, width = one.size
        images.append({"id": image_id, "file_name": one.name, "width": width, "height": height})
        for row, outline in enumerate(one.outlines):
            entry = {"id": len(annotations) + 1, "image_id": image_id, "file_name": one.name}
            annotations.append(entry | _annotation(one.found, row, outline))
    categories = [{"id": label + 1, "name": name} for label, name in enumerate(class_names)]
    return {"images": images, "categories": categories, "annotations": annotations}


def _annotation(found: Detections, row: int, outline: list[Polygon]) -> dict[str, Any]:
    x0, y0, x1, y1 = (float(v) for v in found.boxes[row])
    label = int(found.labels[row])
    rings = [polygon.keyhole() for polygon in outline]
    return {
        "category_id": label + 1,
        "category": found.class_names[label],
        "bbox": [round(v, 2) for v in (x0, y0, x1 - x0, y1 - y0)],
        **_trust(found, row),
        "segmentation": [_numbers(ring) for ring in rings],
        "area": round(sum(_area(ring) for ring in rings), 2),
        "iscrowd": 0,
    }


def _trust(found: Detections, row: int) -> dict[str, float]:
    return {
        "score": round(float(found.scores[row]), 5),
        "quality": round(float(found.quality[row]), 5),
    }


def _area(ring: FloatArray) -> float:
    x, y = ring.T
    before, behind = [*range(-1, len(x) - 1)], [*range(1, len(x)), 0]
    return float(abs(x @ (y[behind] - y[before])) / 2)


def _numbers(ring: FloatArray) -> list[float]:
    """x, y, x, y, ... on the grid of a tenth of a pixel that outlines have; whole numbers without a
    point.
    """
    return [
        int(value) if value == int(value) else value for value in ring.ravel().round(1).tolist()
    ]


class _Coco:
    """predictions.json."""

    def __init__(self, out: Path) -> None:
        self._out = out

    def picture(self, picture: Picture, one: Found) -> None:
        return

    def close(self, seen: Sequence[Found], content: dict[str, Any]) -> None:
        write_text(self._out / "predictions.json", json.dumps(content, separators=(",", ":")))


class _Labelme:
    """<name>.json per picture, and review.txt.

    Parts of an object share a group; holes are joined to the outer ring. The picture is named
    relative to the folder; frames are written beside their file.
    """

    def __init__(
        self,
        out: Path,
        own: OwnFiles,
        class_names: tuple[str, ...],
        check_below: float,
    ) -> None:
        self._out, self._own, self._names, self._check = out, own, class_names, check_below

    def picture(self, picture: Picture, one: Found) -> None:
        file = self._out / f"{picture.stem}.json"
        if file.exists():
            raise DataError(
                f"{file}: is there already, perhaps corrected by hand; give a new folder"
            )
        path = f"{picture.stem}.jpg"
        if picture.path is not None:
            path = Path(os.path.relpath(picture.path.resolve(), self._out.resolve())).as_posix()
        else:
            write_bytes(self._own.path(path), encode_jpeg(picture.rgb))
        height, width = one.size
        content: dict[str, Any] = {"version": _LABELME, "flags": {}, "shapes": self._shapes(one)}
        content |= {
            "imagePath": path,
            "imageData": None,
            "imageHeight": height,
            "imageWidth": width,
        }
        write_text(self._own.path(file.name), json.dumps(content, indent=1))

    def _shapes(self, one: Found) -> list[dict[str, Any]]:
        shapes = []
        for row in one.found.quality.argsort(kind="stable").tolist():
            trust = _trust(one.found, row)
            outline = one.outlines[row]
            for polygon in outline:
                numbers = _numbers(polygon.keyhole())
                shape: dict[str, Any] = {"label": self._names[int(one.found.labels[row])]}
                shape["points"] = [
                    list(pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)
                ]
                shape |= {
                    "group_id": row if len(outline) > 1 else None,
                    "shape_type": "polygon",
                    "mask": None,
                }
                shape["description"] = f"score {trust['score']:.2f} quality {trust['quality']:.2f}"
                shape["flags"] = {"check": trust["quality"] < self._check}
                shapes.append(shape)
        return shapes

    def close(self, seen: Sequence[Found], content: dict[str, Any]) -> None:
        todo = [(int((one.found.quality < self._check).sum()), one) for one in seen]
        lines = [
            f"{one.name}: {count} of {len(one.outlines)} contours to check, the worst of quality "
            f"{one.found.quality.min():.2f}"
            for count, one in sorted(
                todo, key=lambda entry: (-entry[0], entry[1].found.quality.min(initial=1))
            )
            if count
        ]
        write_text(
            self._out / "review.txt", "\n".join([*lines, ""]) if lines else "no contour to check\n"
        )


class _Yolo:
    """labels/<name>.txt per picture and data.yaml: `class x y x y ...`, shares of the picture's
    width and height.

    An object is one line: holes and further parts are joined by bridges of no width. There is no
    place for score and quality. data.yaml has the names only: for a training, labels/ goes beside
    the folder images/, and frames of a video are written to images/ here. Labels belong to pictures
    by their stem, so that no two may have the same.
    """

    def __init__(self, out: Path, own: OwnFiles, class_names: tuple[str, ...]) -> None:
        self._out, self._own, self._names = out, own, class_names
        (out / "labels").mkdir(exist_ok=True)

    def picture(self, picture: Picture, one: Found) -> None:
        if picture.path is None:
            (self._out / "images").mkdir(exist_ok=True)
            write_bytes(self._own.path(f"images/{picture.name}"), encode_jpeg(picture.rgb))
        elif picture.stem != picture.path.stem:
            raise DataError(
                f"{picture.path}: another image has this stem, and YOLO labels are found by it"
            )
        height, width = one.size
        lines = []
        for label, outline in zip(one.found.labels.tolist(), one.outlines, strict=True):
            shares = (join_polygons(outline) / (width, height)).ravel()
            lines.append(
                " ".join(
                    [str(label), *(f"{share:.6f}".rstrip("0").rstrip(".") for share in shares)]
                )
            )
        labels = self._own.path(f"labels/{picture.stem}.txt")
        write_text(labels, "".join(f"{line}\n" for line in lines))

    def close(self, seen: Sequence[Found], content: dict[str, Any]) -> None:
        write_text(
            self._out / "data.yaml",
            yaml.safe_dump({"names": dict(enumerate(self._names))}, sort_keys=False),
        )
