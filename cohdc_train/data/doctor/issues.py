"""What can be wrong with a COCO-format folder: the kinds, how bad each is, and its mend (plain
Python).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

Severity = Literal["error", "warning", "note"]


class Kind(NamedTuple):
    """How bad a finding is, what it is, and what mends it.

    "error": training stops, or what it learns or scores would be wrong. "warning": training drops,
    clips or ignores the row and goes on. "note": worth knowing.
    """

    severity: Severity
    what: str
    mend: str


_DRAW = "correct it in the annotation tool; --fix removes it"
_EXPORT = "export it again from the annotation tool; --fix removes it"
_RECOMPUTED = "--fix takes it from the contour"

KINDS: dict[str, Kind] = {
    "category-broken": Kind("error", "category without a whole-number id and a name", "name it"),
    "category-id-twice": Kind(
        "error", "category id given to two names", "give each name an id of its own"
    ),
    "category-name-twice": Kind(
        "error", "category name under two ids", "--fix joins them under the first id"
    ),
    "category-unused": Kind(
        "warning", "category without an object", "leave it out with --data.classes"
    ),
    "category-gap": Kind(
        "note", "category ids are not 1..C", "none needed: they are remapped by name"
    ),
    "classes-differ": Kind(
        "error", "class of one split is unknown in the other", "the splits need the same categories"
    ),
    "class-only-val": Kind(
        "warning", "class with objects in val and none in train", "move images, or leave it out"
    ),
    "image-broken": Kind("error", "image without id, file_name, width or height", _EXPORT),
    "image-id-twice": Kind(
        "error", "image id used twice", "whose the annotations are is unknown; --fix removes both"
    ),
    "image-listed-twice": Kind(
        "warning", "image file listed under two ids", "--fix joins them under the first id"
    ),
    "image-missing": Kind("error", "image file does not exist", "put it back; --fix leaves it out"),
    "image-corrupt": Kind(
        "error", "image file cannot be read as an image", "fetch it again; --fix leaves it out"
    ),
    "image-truncated": Kind(
        "error", "image file ends early", "fetch it again; --fix leaves it out"
    ),
    "image-turned": Kind(
        "note",
        "image turned upright by its EXIF orientation when it is read",
        "none needed, unless it was annotated unturned: look at it with --out",
    ),
    "image-size": Kind(
        "error",
        "width or height is not the file's",
        "--fix takes the file's where the contours fit into it",
    ),
    "image-exif": Kind(
        "note",
        "EXIF says turned; the annotation is of the stored pixels, so the image is not turned",
        "none needed, unless it was annotated upright: look at it with --out",
    ),
    "image-colour": Kind(
        "warning", "neither 8-bit grey, palette nor RGB (CMYK, 16 bit)", "convert it to 8-bit RGB"
    ),
    "image-huge": Kind(
        "note", "image above 24 megapixels", "none needed; a smaller copy is read faster"
    ),
    "image-empty": Kind(
        "note", "image without objects", "none needed: it teaches what is background"
    ),
    "image-crowded": Kind(
        "note", "more than 100 objects in an image", "raise model.network.detections"
    ),
    "annotation-broken": Kind(
        "error", "annotation is no mapping, or an id of it is a list", _EXPORT
    ),
    "annotation-orphan": Kind("error", "annotation of an image that is not listed", _EXPORT),
    "annotation-category": Kind("error", "annotation of a category that is not listed", _EXPORT),
    "annotation-id": Kind(
        "warning", "annotation id used twice or missing", "--fix gives a new one"
    ),
    "annotation-twice": Kind(
        "warning", "the same object annotated twice (mask IoU above .95)", "--fix keeps the first"
    ),
    "contour-missing": Kind("warning", "box without a contour", "draw it; --fix removes it"),
    "contour-format": Kind("error", "neither polygons nor RLE", _EXPORT),
    "contour-flat": Kind("error", "polygon not in a list of polygons", "--fix puts it into one"),
    "contour-number": Kind("warning", "coordinate is no finite number", _DRAW),
    "contour-odd": Kind("warning", "polygon with an odd number of coordinates", _DRAW),
    "contour-short": Kind("warning", "polygon of fewer than 3 points", _DRAW),
    "contour-empty": Kind("warning", "contour without a pixel inside the image", _DRAW),
    "contour-outside": Kind(
        "warning", "contour reaches out of the image by more than 1 px", "--fix clips it"
    ),
    "contour-crossing": Kind(
        "warning",
        "polygon crosses itself: inside and outside swap",
        "redraw it; --fix keeps the pixels as RLE",
    ),
    "rle-size": Kind("error", "RLE of another size than the image", _EXPORT),
    "rle-counts": Kind("error", "RLE whose runs do not fill the image", _EXPORT),
    "box-degenerate": Kind("warning", "box without width or height", _RECOMPUTED),
    "box-inverted": Kind("warning", "box of negative width or height", _RECOMPUTED),
    "box-corners": Kind("error", "box is x1 y1 x2 y2, COCO's is x y width height", _RECOMPUTED),
    "box-outside": Kind(
        "warning", "box reaches out of the image by more than 1 px", "--fix clips it"
    ),
    "box-disagrees": Kind("warning", "box is not its contour's (IoU below .5)", _RECOMPUTED),
    "box-missing": Kind("note", "contour without a box", "none needed: the contour's is taken"),
    "area-wrong": Kind("warning", "area is off by more than a factor of two", _RECOMPUTED),
    "object-tiny": Kind(
        "note", "object of fewer than 4 px", "none needed; nothing that small is found"
    ),
    "crowd": Kind("note", "crowd region", "none needed: losses and scores ignore it"),
    "leak": Kind(
        "error", "training image (nearly) the same as a validation image", "move one of the two"
    ),
}


@dataclass
class Findings:
    """Findings of one split, counted by kind.

    Attributes:
        places: kind -> the images (or what else is meant) it was found in, in the order found.
    """

    places: dict[str, list[str]] = field(default_factory=dict)

    def add(self, kind: str, where: str) -> None:
        """One more finding. A kind that `KINDS` does not hold is a bug: KeyError."""
        if kind not in KINDS:
            raise KeyError(kind)
        self.places.setdefault(kind, []).append(where)

    def of(self, severity: Severity) -> dict[str, list[str]]:
        """The findings of one severity."""
        return {
            kind: where for kind, where in self.places.items() if KINDS[kind].severity == severity
        }

    def lines(self) -> Iterator[str]:
        """One line per kind, errors first: severity, count, what, three places, the mend."""
        for severity in ("error", "warning", "note"):
            for kind, where in self.of(severity).items():
                named = list(dict.fromkeys(where))
                more = f" and {len(named) - 3} more" if len(named) > 3 else ""
                places = ", ".join(named[:3])
                yield f"  {severity:<8}{len(where):>6}  {KINDS[kind].what} [{kind}]: {places}{more}"
                yield f"  {'':<16}mend: {KINDS[kind].mend}"
