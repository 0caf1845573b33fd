"""Kinds of issues of a COCO-format folder: how bad each is, and its fix (plain Python)."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

Severity = Literal["error", "warning", "note"]


class IssueKind(NamedTuple):
    """Kind of an issue.

    Attributes:
        severity: "error": training stops, or what it learns or scores would be wrong. "warning":
            training drops, clips or ignores the row and goes on. "note": worth knowing.
        description: what is wrong.
        fix: how to fix it.
    """

    severity: Severity
    description: str
    fix: str


_DRAW = "correct it in the annotation tool; --fix removes it"
_EXPORT = "export it again from the annotation tool; --fix removes it"
_RECOMPUTED = "--fix takes it from the contour"

ISSUE_KINDS: dict[str, IssueKind] = {
    "category-broken": IssueKind(
        "error", "category without a whole-number id and a name", "name it"
    ),
    "category-id-twice": IssueKind(
        "error", "category id given to two names", "give each name an id of its own"
    ),
    "category-name-twice": IssueKind(
        "error", "category name under two ids", "--fix joins them under the first id"
    ),
    "category-unused": IssueKind(
        "warning", "category without an object", "skip it with --data.classes"
    ),
    "category-gap": IssueKind(
        "note", "category ids are not 1..C", "none needed: they are remapped by name"
    ),
    "classes-differ": IssueKind(
        "error", "class of one split is unknown in the other", "the splits need the same categories"
    ),
    "class-only-val": IssueKind(
        "warning",
        "class with objects in val and none in train",
        "move images, or skip it with --data.classes",
    ),
    "image-broken": IssueKind("error", "image without id, file_name, width or height", _EXPORT),
    "image-id-twice": IssueKind(
        "error", "image id used twice", "whose the annotations are is unknown; --fix removes both"
    ),
    "image-listed-twice": IssueKind(
        "warning", "image file listed under two ids", "--fix joins them under the first id"
    ),
    "image-missing": IssueKind(
        "error", "image file does not exist", "put it back; --fix removes it"
    ),
    "image-corrupt": IssueKind(
        "error", "image file cannot be read as an image", "fetch it again; --fix removes it"
    ),
    "image-truncated": IssueKind(
        "error", "image file ends early", "fetch it again; --fix removes it"
    ),
    "image-turned": IssueKind(
        "note",
        "image turned upright by its EXIF orientation when it is read",
        "none needed, unless it was annotated unturned: look at it with --out",
    ),
    "image-size": IssueKind(
        "error",
        "width or height is not the file's",
        "--fix takes the file's where the contours fit into it",
    ),
    "image-exif": IssueKind(
        "note",
        "EXIF says turned; the annotation is of the stored pixels, so the image is not turned",
        "none needed, unless it was annotated upright: look at it with --out",
    ),
    "image-color": IssueKind(
        "warning", "neither 8-bit gray, palette nor RGB (CMYK, 16 bit)", "convert it to 8-bit RGB"
    ),
    "image-huge": IssueKind(
        "note", "image above 24 megapixels", "none needed; a smaller copy is read faster"
    ),
    "image-empty": IssueKind(
        "note", "image without objects", "none needed: it teaches what is background"
    ),
    "image-crowded": IssueKind(
        "note", "more than 100 objects in an image", "raise model.network.detections"
    ),
    "annotation-broken": IssueKind(
        "error", "annotation is no mapping, or an id of it is a list", _EXPORT
    ),
    "annotation-orphan": IssueKind("error", "annotation of an image that is not listed", _EXPORT),
    "annotation-category": IssueKind(
        "error", "annotation of a category that is not listed", _EXPORT
    ),
    "annotation-id": IssueKind(
        "warning", "annotation id used twice or missing", "--fix gives a new one"
    ),
    "annotation-twice": IssueKind(
        "warning", "the same object annotated twice (mask IoU above .95)", "--fix keeps the first"
    ),
    "contour-missing": IssueKind("warning", "box without a contour", "draw it; --fix removes it"),
    "contour-format": IssueKind("error", "neither polygons nor RLE", _EXPORT),
    "contour-flat": IssueKind(
        "error", "polygon not in a list of polygons", "--fix puts it into one"
    ),
    "contour-number": IssueKind("warning", "coordinate is no finite number", _DRAW),
    "contour-odd": IssueKind("warning", "polygon with an odd number of coordinates", _DRAW),
    "contour-short": IssueKind("warning", "polygon of fewer than 3 points", _DRAW),
    "contour-empty": IssueKind("warning", "contour without a pixel inside the image", _DRAW),
    "contour-outside": IssueKind(
        "warning", "contour reaches out of the image by more than 1 px", "--fix clips it"
    ),
    "contour-crossing": IssueKind(
        "warning",
        "polygon crosses itself: inside and outside swap",
        "redraw it; --fix keeps the pixels as RLE",
    ),
    "rle-size": IssueKind("error", "RLE of another size than the image", _EXPORT),
    "rle-counts": IssueKind("error", "RLE whose runs do not fill the image", _EXPORT),
    "box-degenerate": IssueKind("warning", "box without width or height", _RECOMPUTED),
    "box-inverted": IssueKind("warning", "box of negative width or height", _RECOMPUTED),
    "box-corners": IssueKind(
        "error", "box is x1 y1 x2 y2, COCO's is x y width height", _RECOMPUTED
    ),
    "box-outside": IssueKind(
        "warning", "box reaches out of the image by more than 1 px", "--fix clips it"
    ),
    "box-disagrees": IssueKind("warning", "box is not its contour's (IoU below .5)", _RECOMPUTED),
    "box-missing": IssueKind(
        "note", "contour without a box", "none needed: the contour's is taken"
    ),
    "area-wrong": IssueKind("warning", "area is off by more than a factor of two", _RECOMPUTED),
    "object-tiny": IssueKind(
        "note", "object of fewer than 4 px", "none needed; nothing that small is found"
    ),
    "crowd": IssueKind("note", "crowd region", "none needed: losses and scores ignore it"),
    "leak": IssueKind(
        "error", "training image (nearly) the same as a validation image", "move one of the two"
    ),
}


@dataclass
class Issues:
    """Issues of one split, by kind.

    Attributes:
        places: kind -> the images (or other places) that have it, in the order found.
    """

    places: dict[str, list[str]] = field(default_factory=dict)

    def add(self, kind: str, where: str) -> None:
        """Add one issue. A kind that `ISSUE_KINDS` does not hold is a bug: KeyError."""
        if kind not in ISSUE_KINDS:
            raise KeyError(kind)
        self.places.setdefault(kind, []).append(where)

    def of_severity(self, severity: Severity) -> dict[str, list[str]]:
        """Return the issues of one severity."""
        return {
            kind: where
            for kind, where in self.places.items()
            if ISSUE_KINDS[kind].severity == severity
        }

    def summary_lines(self) -> Iterator[str]:
        """Yield two lines per kind, errors first: severity, count, description, places; fix."""
        for severity in ("error", "warning", "note"):
            for kind, where in self.of_severity(severity).items():
                named = list(dict.fromkeys(where))
                more = f" and {len(named) - 3} more" if len(named) > 3 else ""
                places = ", ".join(named[:3])
                what = f"{ISSUE_KINDS[kind].description} [{kind}]"
                yield f"  {severity:<8}{len(where):>6}  {what}: {places}{more}"
                yield f"  {'':<16}fix: {ISSUE_KINDS[kind].fix}"
