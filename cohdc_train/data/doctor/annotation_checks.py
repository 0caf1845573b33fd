"""Check one annotation of a COCO-format file, and fix its row (no torch)."""

from typing import Any, NamedTuple

import numpy as np
from pycocotools import mask as rle
from shapely import Polygon, box, clip_by_rect, get_parts

from cohdc_train.data.annotations import fills_image, is_crowd, is_number_list, rle_as_text

_TOLERANCE = 1.0  # px by which a box may be wrong, or a box or contour leave the image
# IoU of the annotated box with the contour's box. Below the first the box is wrong; above the
# second, read as corners, the corners were written in place of width and height.
_DISAGREE, _AGREE = 0.5, 0.9
_TINY = 4  # px^2
Box = tuple[float, float, float, float]


class AnnotationReport(NamedTuple):
    """Result of the checks of one annotation.

    Attributes:
        issues: kinds of issues.
        row: the fixed annotation; None when it has to be removed.
        shape: its compressed RLE; None when it has none.
    """

    issues: list[str]
    row: dict[str, Any] | None
    shape: dict[str, Any] | None


def check_annotation(row: dict[str, Any], height: int, width: int) -> AnnotationReport:
    """Check segmentation, box and area of one annotation of an image of height x width px."""
    issues: list[str] = []
    crowd = is_crowd(row)
    if crowd:
        issues.append("crowd")
    segmentation = row.get("segmentation")
    if not segmentation:
        if crowd and is_number_list(row.get("bbox"), 4):
            return AnnotationReport(issues, row, None)
        return AnnotationReport([*issues, "contour-missing"], None, None)
    kinds, fixed = _fix_segmentation(segmentation, height, width)
    issues += kinds
    if fixed is None:
        return AnnotationReport(issues, None, None)
    shape = fixed if isinstance(fixed, dict) else rle.merge(rle.frPyObjects(fixed, height, width))
    pixels = int(rle.area(shape))
    if pixels == 0:
        return AnnotationReport([*issues, "contour-empty"], None, None)
    if pixels < _TINY:
        issues.append("object-tiny")
    tight: Box = tuple(float(v) for v in rle.toBbox(shape))  # type: ignore[assignment]
    kinds, bounds = _fix_box(row.get("bbox"), tight, height, width)
    issues += kinds
    area = row.get("area")
    if not isinstance(area, int | float) or not pixels / 2 <= area <= pixels * 2:
        if area is not None and pixels >= _TINY:
            issues.append("area-wrong")
        area = float(pixels)
    return AnnotationReport(
        issues, row | {"segmentation": fixed, "bbox": list(bounds), "area": area}, shape
    )


def fits_image(row: dict[str, Any], height: int, width: int) -> bool:
    """Return whether an annotation could be of an image of this size.

    It could when its RLE has the same size, or when its points lie inside.
    """
    segmentation = row.get("segmentation") or []
    if isinstance(segmentation, dict):
        return list(segmentation.get("size", ())) == [height, width]
    try:
        points = np.concatenate(
            [np.asarray(part, dtype=float).reshape(-1, 2) for part in segmentation]
        )
    except ValueError:
        return False
    return bool(
        (points >= -_TOLERANCE).all()
        and (points <= (width + _TOLERANCE, height + _TOLERANCE)).all()
    )


def _fix_segmentation(given: Any, height: int, width: int) -> tuple[list[str], Any]:
    """Return kinds of issues, and polygons or a compressed RLE; None when nothing is left."""
    if isinstance(given, dict):
        return _fix_rle(given, height, width)
    if not isinstance(given, list):
        return ["contour-format"], None
    issues: list[str] = []
    if all(isinstance(value, int | float) for value in given):
        issues.append("contour-flat")
        given = [given]
    polygons: list[list[float]] = []
    crossing = False
    for part in given:
        fault = _polygon_fault(part)
        if fault:
            issues.append(fault)
            continue
        outline = Polygon(np.asarray(part, dtype=float).reshape(-1, 2))
        crossing |= not outline.is_valid and outline.area > 0
        inside = _clipped(part, outline, height, width)
        if inside is not None:
            issues.append("contour-outside")
        polygons += [list(map(float, part))] if inside is None else inside
    if crossing and polygons:
        issues.append("contour-crossing")
        return issues, rle_as_text(rle.merge(rle.frPyObjects(polygons, height, width)))
    if not polygons and "contour-outside" in issues:
        issues.append("contour-empty")
    return issues, polygons or None


def _polygon_fault(part: Any) -> str:
    """Return why a polygon cannot be drawn; empty when it can."""
    if not isinstance(part, list):
        return "contour-format"
    if not is_number_list(part, len(part)):
        return "contour-number"
    if len(part) % 2:
        return "contour-odd"
    return "contour-short" if len(part) < 6 else ""


def _clipped(
    part: list[float], outline: Polygon, height: int, width: int
) -> list[list[float]] | None:
    """Return the part of a polygon that lies in the image; None when all of it does.

    A polygon that crosses itself, which shapely cannot clip, has its points moved to the border.
    """
    x0, y0, x1, y1 = outline.bounds
    if (
        x0 >= -_TOLERANCE
        and y0 >= -_TOLERANCE
        and x1 <= width + _TOLERANCE
        and y1 <= height + _TOLERANCE
    ):
        return None
    if not outline.is_valid:
        points = np.clip(np.asarray(part, dtype=float).reshape(-1, 2), 0, (width, height))
        return [points.ravel().tolist()]
    inside = clip_by_rect(outline, 0, 0, width, height)
    pieces = [
        piece for piece in get_parts(inside) if piece.geom_type == "Polygon" and piece.area > 0
    ]
    return [np.asarray(piece.exterior.coords)[:-1].ravel().tolist() for piece in pieces]


def _fix_rle(
    given: dict[str, Any], height: int, width: int
) -> tuple[list[str], dict[str, Any] | None]:
    size, counts = given.get("size"), given.get("counts")
    if not is_number_list(size, 2) or not isinstance(counts, str | bytes | list):
        return ["contour-format"], None
    if list(size) != [height, width]:  # type: ignore[arg-type]
        return ["rle-size"], None
    if not fills_image(counts, height * width):
        return ["rle-counts"], None
    return [], rle_as_text(
        rle.frPyObjects(given, height, width) if isinstance(counts, list) else given
    )


def _fix_box(given: Any, tight: Box, height: int, width: int) -> tuple[list[str], Box]:
    """Return kinds of issues, and the box to keep.

    It is the annotated box, clipped, unless the contour's box is the better one.
    """
    if given is None:
        return ["box-missing"], tight
    if not is_number_list(given, 4):
        return ["box-degenerate"], tight
    x, y, w, h = (float(v) for v in given)
    if w < 0 or h < 0:
        return ["box-inverted"], tight
    if w == 0 or h == 0:
        return ["box-degenerate"], tight
    inside = (
        max(x, 0.0),
        max(y, 0.0),
        min(x + w, width) - max(x, 0.0),
        min(y + h, height) - max(y, 0.0),
    )
    outside = max(-x, -y, x + w - width, y + h - height) > _TOLERANCE
    if min(inside[2:]) > 0 and (_iou(inside, tight) >= _DISAGREE or _is_near(inside, tight)):
        return ["box-outside"] if outside else [], inside
    corners = (x, y, w - x, h - y)
    if min(corners[2:]) > 0 and _iou(corners, tight) >= _AGREE:
        return ["box-corners"], tight
    return ["box-outside", "box-disagrees"] if outside else ["box-disagrees"], tight


def _iou(a: Box, b: Box) -> float:
    one, other = (box(x, y, x + w, y + h) for x, y, w, h in (a, b))
    return float(one.intersection(other).area / max(one.union(other).area, 1e-9))


def _is_near(a: Box, b: Box) -> bool:
    """Return whether no edge of two boxes differs by more than the tolerance.

    The IoU says little about objects of a few pixels: one pixel is half of it.
    """
    edges = [(v[0], v[1], v[0] + v[2], v[1] + v[3]) for v in (a, b)]
    return all(abs(one - other) <= _TOLERANCE for one, other in zip(*edges, strict=True))
