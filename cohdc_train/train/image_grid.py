"""Grid of validation images: truth, prediction, and a list of the detections (OpenCV)."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from faster_coco_eval.core import mask as rle

from cohdc_train.data.annotations import CocoImage
from cohdc_train.data.doctor.sample_grid import read_fitted
from cohdc_train.drawing import Color, draw_outline, encode_jpeg, fill_mask, write_text
from cohdc_train.metrics.matching import ImageMatch
from cohdc_train.types import Image, Mask, Row

_PANEL = (300, 400)  # px, height and width of truth and of prediction
_LIST = 250  # px, width
_LINE = 18  # px, height of a line of text
_GAP = 6  # px
_NUMBER = (20, 14)  # px, width and height
_OPACITY = 0.35
# RGB, of objects found as the right class; red and orange are kept for mistakes
_COLORS: tuple[Color, ...] = (
    (60, 180, 75),
    (30, 160, 230),
    (70, 240, 240),
    (160, 60, 200),
    (220, 220, 90),
)
_MISTAKE: Color = (255, 60, 60)
_WRONG_CLASS: Color = (255, 150, 0)
_CROWD: Color = (255, 255, 255)
_INK: Color = (230, 230, 230)
_PAPER = 28  # gray level of the background


def draw_tiles(
    title: str,
    matches: Sequence[ImageMatch],
    images: Mapping[int, CocoImage],
    names: Sequence[str],
    columns: int = 2,
) -> bytes:
    """Draw a grid of images: truth on the left, prediction in the middle, a list on the right.

    An object and the detection that matches it share number and color; red: missed or false,
    orange: detected as another class, white: crowd.

    Args:
        title: first line of the grid.
        matches: objects and detections of the images.
        images: by id.
        names: of the classes.
        columns: images in a row.

    Returns:
        JPEG.

    Raises:
        DataError: an image cannot be read; the message names it.
    """
    tiles = [_tile(match, images[match.image_id], names) for match in matches]
    blank = _paper(_LINE + _PANEL[0] + _GAP, 2 * _PANEL[1] + _LIST + 3 * _GAP)
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    legend = (
        "left: truth, middle: predicted at class score >= 0.5; same number: found; "
        "red: missed or false; orange: other class; white: crowd; q: predicted quality"
    )
    head = _paper(3 * _LINE, columns * blank.shape[1])
    for line, text in enumerate((title, legend)):
        _write(head, text, (_GAP, (line + 1) * _LINE + 2), _INK, 0.5)
    return encode_jpeg(np.vstack([head, *rows]))


class _Entry(NamedTuple):
    """Line of the list, and the object and detection that carry its number.

    Misses have no number: they share a line per class.
    """

    text: str
    color: Color
    object: Row | None
    detection: Row | None


def _tile(match: ImageMatch, image: CocoImage, names: Sequence[str]) -> Image:
    truth = read_fitted(image, _PANEL)
    predicted = truth.copy()
    entries = _entries(match, names)
    for row in match.crowds:
        _tint(truth, _mask(row, truth), _CROWD)
    for missed in match.missed():
        _tint(truth, _mask(missed, truth), _MISTAKE)
    _draw(truth, [(entry.object, entry.color) for entry in entries])
    _draw(predicted, [(entry.detection, entry.color) for entry in entries])
    right = int(match.is_correct.sum())
    counts = f"objects {len(match.objects)}, found {right}, false {len(match.detections) - right}"
    head = _paper(_LINE, 2 * _PANEL[1] + _LIST + 3 * _GAP)
    _write(
        head,
        f"score {match.score:.2f}   {counts}   {image.path.name}",
        (_GAP, _LINE - 5),
        _INK,
        0.45,
    )
    gap = _paper(_PANEL[0], _GAP)
    body = np.hstack(
        [gap, _centered(truth), gap, _centered(predicted), gap, _list(match, entries, names)]
    )
    return np.vstack([head, body, _paper(_GAP, body.shape[1])])


def _draw(shown: Image, rows: Sequence[tuple[Row | None, Color]]) -> None:
    """Draw masks, then on top of them their numbers where there is room; numbers count from 1."""
    masks = [None if row is None else _mask(row, shown) for row, _ in rows]
    for mask, (_, color) in zip(masks, rows, strict=True):
        if mask is not None:
            _tint(shown, mask, color)
    taken: list[tuple[int, int]] = []
    for number, mask in enumerate(masks, start=1):
        place = None if mask is None or not mask.any() else _free_place(mask, taken)
        if place is not None:
            taken.append(place)
            write_text(shown, str(number), place, 0.5)


def _tint(shown: Image, mask: Mask, color: Color) -> None:
    """Fill and outline a mask, in place."""
    fill_mask(shown, mask, color, _OPACITY)
    draw_outline(shown, mask, color)


def _entries(match: ImageMatch, names: Sequence[str]) -> list[_Entry]:
    """List matched detections, then false ones."""
    found: list[_Entry] = []
    for j, (i, o) in enumerate(match.pairs()):
        if i < 0:
            continue
        name = names[o["category_id"] - 1]
        detection = match.detections[i]
        color = _COLORS[len(found) % len(_COLORS)] if match.is_correct[j] else _WRONG_CLASS
        seen = names[detection["category_id"] - 1]
        what = seen if match.is_correct[j] else f"{seen}, is {name}"
        found.append(
            _Entry(
                f"{what} {_values(detection)} IoU {match.overlaps[i, j]:.2f}", color, o, detection
            )
        )
    false: list[_Entry] = []
    for i, row in enumerate(match.detections):
        if i not in match.detection_of:
            overlap = match.overlaps[i].max(initial=0.0)
            text = f"{names[row['category_id'] - 1]} {_values(row)} IoU {overlap:.2f} false"
            false.append(_Entry(text, _MISTAKE, None, row))
    return found + false


def _values(row: Row) -> str:
    return f"{row['score']:.2f} q {row['quality']:.2f}"


def _list(match: ImageMatch, entries: Sequence[_Entry], names: Sequence[str]) -> Image:
    shown = _paper(_PANEL[0], _LIST)
    room = _PANEL[0] // _LINE
    missed = Counter(names[row["category_id"] - 1] for row in match.missed())
    lines = [(f"missed: {count} {name}", _MISTAKE) for name, count in missed.items()]
    lines += [
        (f"{number} {entry.text}", entry.color) for number, entry in enumerate(entries, start=1)
    ]
    if len(lines) > room:
        lines[room - 1 :] = [(f"and {len(lines) - room + 1} more", _INK)]
    for k, (text, color) in enumerate(lines):
        _write(shown, text, (0, (k + 1) * _LINE - 5), color, 0.42)
    return shown


def _mask(row: Row, shown: Image) -> Mask:
    """Return a row's mask, [H, W] bool, at the size at which its image is shown."""
    decoded = rle.decode(row["segmentation"])
    resized = cv2.resize(decoded, shown.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized, np.bool_)


def _free_place(mask: Mask, taken: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Return (x, y) of a number's lower left corner; None where there is no room.

    The place is where the mask is widest, or just below or above when a number stands there.
    """
    depth = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    width, height = _NUMBER
    x = min(max(int(column) - width // 2, 0), max(mask.shape[1] - width, 0))
    for shift in (0, 1, -1):
        y = min(max(int(row) + height // 2 + shift * height, height), mask.shape[0] - 1)
        if not any(abs(x - left) < width and abs(y - bottom) < height for left, bottom in taken):
            return x, y
    return None


def _centered(shown: Image) -> Image:
    panel = _paper(*_PANEL)
    top, left = ((panel.shape[k] - shown.shape[k]) // 2 for k in (0, 1))
    panel[top : top + shown.shape[0], left : left + shown.shape[1]] = shown
    return panel


def _paper(height: int, width: int) -> Image:
    return np.full((height, width, 3), _PAPER, np.uint8)


def _write(shown: Image, text: Any, place: tuple[int, int], ink: Color, scale: float) -> None:
    """Write text; OpenCV has letters for ASCII only, others become question marks."""
    plain = str(text).encode("ascii", "replace").decode()
    cv2.putText(shown, plain, place, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, 1, cv2.LINE_AA)
