"""Graphs of other exporters, recognised by their inputs and outputs and read as if they kept the
contract.

| kind | input, RGB in 0..1 | outputs |
|---|---|---|
| `YoloSeg` | float [1, 3, S, S], letterboxed in the centre on grey | candidates, prototypes [1, P,
h, w] |
| `TorchvisionMaskRCNN` | float [3, H, W] | boxes [n, 4], labels [n] from 1, scores [n], masks [n,
1, H, W] |

Candidates are [1, 4 + C + P, n]: box cx, cy, w, h in canvas px, class scores, mask coefficients;
or, of networks that suppress by themselves, [1, n, 6 + P]: box x0, y0, x1, y1, score, class, mask
coefficients. Neither kind has a CQE head: quality is 1.
"""

import ast
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import ContractError
from cohdc_train.segmenter.detections import Detections
from cohdc_train.types import Float32Array, Image

SCORE_THRESHOLD = 0.05  # as in the files of `cohdc export`
MOST = 100  # detections of an image
_NMS_IOU = 0.7
_ROI = 56  # cells a side of the masks that are cut out of maps
_GREY = 114  # of the letterbox's border


class YoloSeg:
    """A one-stage segmenter with prototypes, as YOLO-seg networks are exported."""

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        self._session = session
        shape = session.get_inputs()[0].shape
        table, maps = _by_rank(session)
        self._outputs = [table.name, maps.name]
        self._suppressed = table.shape[2] == 6 + maps.shape[1]
        self.class_names = _names(
            path, metadata, None if self._suppressed else table.shape[1] - 4 - maps.shape[1]
        )
        sides = [
            side if isinstance(side, int) else 640 for side in shape[2:]
        ]  # a free size runs at the usual 640
        self.canvas: tuple[int, int] | None = (sides[0], sides[1])

    @staticmethod
    def matches(session: Any) -> bool:
        """One image in, a table of candidates and prototypes out."""
        inputs, outputs = session.get_inputs(), session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or len(outputs) != 2:
            return False
        table, maps = (out.shape for out in _by_rank(session))
        if len(table) != 3 or len(maps) != 4 or not isinstance(maps[1], int):
            return False
        return table[2] == 6 + maps[1] or (isinstance(table[1], int) and table[1] > 4 + maps[1])

    def run(self, rgb: Image) -> Detections:
        """rgb: uint8 [H, W, 3]."""
        assert self.canvas is not None
        fitted, scale, (left, top) = _letterbox(rgb, self.canvas)
        blob = np.ascontiguousarray(fitted.transpose(2, 0, 1)[None]).astype(np.float32) / 255
        name = self._session.get_inputs()[0].name
        table, prototypes = (out[0] for out in self._session.run(self._outputs, {name: blob}))
        boxes, labels, scores, coefficients = (
            _last(table) if self._suppressed else _best(table, len(prototypes))
        )
        height, width = rgb.shape[:2]
        corner = np.array([left, top, left, top], np.float32)
        limit = np.array([width, height, width, height], np.float32)
        in_image = np.clip((boxes - corner) / scale, 0, limit)
        cells = (in_image * scale + corner) / (self.canvas[0] / prototypes.shape[1])
        maps = np.tensordot(coefficients, prototypes, axes=1)
        masks = [_sigmoid(_cut(field, box)) for field, box in zip(maps, cells, strict=True)]
        return _detections(in_image, labels, scores, masks, (height, width), self.class_names)


class TorchvisionMaskRCNN:
    """torchvision's Mask R-CNN, as torch's exporter by tracing writes it; it holds no class names."""

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        self._session = session
        shape = session.get_inputs()[0].shape[1:]
        fixed = all(isinstance(side, int) for side in shape)
        self.canvas: tuple[int, int] | None = (shape[0], shape[1]) if fixed else None
        self.class_names = _names(path, metadata, None)

    @staticmethod
    def matches(session: Any) -> bool:
        """One image without a batch in; boxes, labels, scores and masks out."""
        inputs, outputs = session.get_inputs(), session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 3 or inputs[0].shape[0] != 3:
            return False
        return sorted((out.type, len(out.shape)) for out in outputs) == [
            ("tensor(float)", 1),
            ("tensor(float)", 2),
            ("tensor(float)", 4),
            ("tensor(int64)", 1),
        ]

    def run(self, rgb: Image) -> Detections:
        """rgb: uint8 [H, W, 3]."""
        height, width = rgb.shape[:2]
        rows, columns = self.canvas or (height, width)
        fitted = rgb if (rows, columns) == (height, width) else cv2.resize(rgb, (columns, rows))
        blob = np.ascontiguousarray(fitted.transpose(2, 0, 1)).astype(np.float32) / 255
        found = self._session.run(None, {self._session.get_inputs()[0].name: blob})
        (labels,) = (out for out in found if out.dtype == np.int64)
        by_rank = {out.ndim: out for out in found if out.dtype == np.float32}
        scores, boxes, maps = by_rank[1], by_rank[2], by_rank[4][:, 0]
        kept = np.flatnonzero(scores > SCORE_THRESHOLD)
        kept = kept[np.argsort(-scores[kept], kind="stable")][:MOST]
        masks = [_cut(maps[i], boxes[i]) for i in kept]
        in_image = boxes[kept] * np.array([width / columns, height / rows] * 2, np.float32)
        return _detections(
            in_image, labels[kept] - 1, scores[kept], masks, (height, width), self.class_names
        )


FOREIGN = (YoloSeg, TorchvisionMaskRCNN)


def _by_rank(session: Any) -> list[Any]:
    return sorted(session.get_outputs(), key=lambda out: len(out.shape))


def _best(table: Float32Array, prototypes: int) -> tuple[NDArray[Any], ...]:
    """Boxes xyxy in canvas px, labels, scores and coefficients of candidates [4 + C + P, n] behind
    suppression.
    """
    centre, size, classes, coefficients = np.split(table, [2, 4, len(table) - prototypes])
    scores, labels = classes.max(axis=0), classes.argmax(axis=0)
    likely = np.flatnonzero(scores > SCORE_THRESHOLD)
    corner = centre - size / 2
    chosen = cv2.dnn.NMSBoxesBatched(
        np.concatenate([corner, size])[:, likely].T.astype(float).tolist(),
        scores[likely].astype(float).tolist(),
        labels[likely].tolist(),
        SCORE_THRESHOLD,
        _NMS_IOU,
    )
    rows = likely[np.asarray(chosen, dtype=np.int64).reshape(-1)]
    rows = rows[np.argsort(-scores[rows], kind="stable")][:MOST]
    return (
        np.concatenate([corner, corner + size])[:, rows].T,
        labels[rows],
        scores[rows],
        coefficients[:, rows].T,
    )


def _last(table: Float32Array) -> tuple[NDArray[Any], ...]:
    """The same of rows [n, 6 + P] that were suppressed in the graph."""
    rows = table[table[:, 4] > SCORE_THRESHOLD]
    rows = rows[np.argsort(-rows[:, 4], kind="stable")][:MOST]
    return rows[:, :4], rows[:, 5].astype(np.int64), rows[:, 4], rows[:, 6:]


def _detections(
    boxes: NDArray[Any],
    labels: NDArray[Any],
    scores: NDArray[Any],
    masks: list[Float32Array],
    size: tuple[int, int],
    names: tuple[str, ...],
) -> Detections:
    if len(labels) and labels.max() >= len(names):
        raise ContractError(
            f"class {labels.max() + 1} of a foreign graph has no name; {len(names)} are given"
        )
    cells = np.stack(masks) if masks else np.zeros((0, _ROI, _ROI), np.float32)
    return Detections(
        boxes.astype(np.float32).reshape(-1, 4),
        labels.astype(np.int64),
        scores.astype(np.float32),
        np.ones(len(labels), np.float32),
        cells,
        size,
        names,
    )


def _names(path: Path, metadata: dict[str, str], classes: int | None) -> tuple[str, ...]:
    """Class names: of the metadata ("names", a list or {label: name}), of `<file>.txt`, or numbers
    from 1.

    Raises ContractError when there are fewer than `classes`.
    """
    listed = path.with_name(path.name + ".txt")
    if "names" in metadata:
        try:
            given = ast.literal_eval(metadata["names"])
            names = (
                [given[i] for i in range(len(given))] if isinstance(given, dict) else list(given)
            )
        except (KeyError, SyntaxError, TypeError, ValueError) as error:
            raise ContractError(
                f"{path}: its class names cannot be read: {metadata['names']:.40}"
            ) from error
    elif listed.is_file():
        names = listed.read_text(encoding="utf-8").split("\n")
        names = names[:-1] if names[-1] == "" else names
    else:
        names = [str(i + 1) for i in range(classes or 90)]
    if classes is not None and len(names) != classes:
        raise ContractError(f"{path}: {len(names)} class names for {classes} classes")
    return tuple(str(name) for name in names)


def _letterbox(rgb: Image, canvas: tuple[int, int]) -> tuple[Image, float, tuple[int, int]]:
    """An image in the centre of a grey canvas; canvas px per image px, and where its left and top
    edges lie.
    """
    rows, columns = canvas
    height, width = rgb.shape[:2]
    scale = min(rows / height, columns / width)
    inner = (max(1, round(width * scale)), max(1, round(height * scale)))
    left, top = round((columns - inner[0]) / 2 - 0.1), round((rows - inner[1]) / 2 - 0.1)
    fitted = np.full((rows, columns, 3), _GREY, np.uint8)
    fitted[top : top + inner[1], left : left + inner[0]] = cv2.resize(
        rgb, inner, interpolation=cv2.INTER_LINEAR
    )
    return fitted, scale, (left, top)


def _cut(field: Float32Array, box: NDArray[Any]) -> Float32Array:
    """[_ROI, _ROI] of a map [h, w] inside a box, in the map's cells: sampled at the centres of a
    grid over it.
    """
    x0, y0, x1, y1 = (float(v) for v in box)
    centres = (np.arange(_ROI) + 0.5) / _ROI
    u = (x0 + centres * (x1 - x0) - 0.5).astype(np.float32)
    v = (y0 + centres * (y1 - y0) - 0.5).astype(np.float32)
    grid_u, grid_v = np.meshgrid(u, v)
    field = np.ascontiguousarray(field, dtype=np.float32)
    return np.asarray(
        cv2.remap(field, grid_u, grid_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def _sigmoid(x: NDArray[Any]) -> Float32Array:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -50, 50))), dtype=np.float32)
