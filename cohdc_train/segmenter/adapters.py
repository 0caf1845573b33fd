"""Adapters of other exporters' ONNX files, recognized by their inputs and outputs.

| adapter | input, RGB in 0..1 | outputs |
|---|---|---|
| `YoloSeg` | [1, 3, S, S], centered on gray | candidates, prototypes [1, P, h, w] |
| `TorchvisionMaskRCNN` | [3, H, W] | boxes [n, 4], labels [n], scores [n], masks [n, 1, H, W] |

Candidates are [1, 4 + C + P, n]: box cx, cy, w, h in canvas px, class scores, mask coefficients.
Networks with NMS inside give [1, n, 6 + P]: box x0, y0, x1, y1, score, class, mask coefficients.
torchvision's labels start at 1. None of them has a CQE head: quality is 1.
"""

import ast
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import ContractError
from cohdc_train.segmenter.detections import Detections
from cohdc_train.types import Float32Array, Image

SCORE_THRESHOLD = 0.05  # as in the files of `cohdc export`
MAX_DETECTIONS = 100  # per image
_NMS_IOU = 0.7
_ROI_CELLS = 56  # side of the masks that are cut out of maps
_GRAY = 114  # of the letterbox's border
_DEFAULT_SIDE = 640  # px, of YOLO networks whose input size is free
_DEFAULT_CLASSES = 90  # COCO's, where neither names nor a number of classes are known


class _Candidates(NamedTuple):
    """Detections of a one-stage network after NMS.

    boxes: [n, 4] xyxy, canvas px; labels: [n]; scores: [n]; coefficients: [n, P] of the masks.
    """

    boxes: NDArray[Any]
    labels: NDArray[Any]
    scores: NDArray[Any]
    coefficients: NDArray[Any]


class YoloSeg:
    """Adapter of one-stage segmenters with mask prototypes, as YOLO-seg networks are exported."""

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        """Read the sizes and class names of a file."""
        self._session = session
        candidates, prototypes = _outputs_by_rank(session)
        self._outputs = [candidates.name, prototypes.name]
        num_prototypes = prototypes.shape[1]
        self._has_nms = candidates.shape[2] == 6 + num_prototypes
        num_classes = None if self._has_nms else candidates.shape[1] - 4 - num_prototypes
        self.class_names = _read_class_names(path, metadata, num_classes)

        sides = session.get_inputs()[0].shape[2:]
        rows, columns = (side if isinstance(side, int) else _DEFAULT_SIDE for side in sides)
        self._input_size = (rows, columns)
        self.canvas: tuple[int, int] | None = self._input_size

    @staticmethod
    def matches(session: Any) -> bool:
        """Check for one image as input, and candidates and prototypes as outputs."""
        inputs, outputs = session.get_inputs(), session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4 or len(outputs) != 2:
            return False
        candidates, prototypes = (value.shape for value in _outputs_by_rank(session))
        if len(candidates) != 3 or len(prototypes) != 4 or not isinstance(prototypes[1], int):
            return False
        if candidates[2] == 6 + prototypes[1]:
            return True
        return isinstance(candidates[1], int) and candidates[1] > 4 + prototypes[1]

    def run(self, rgb: Image) -> Detections:
        """Segment an image. rgb: uint8 [H, W, 3]."""
        fitted, scale, (left, top) = _letterbox(rgb, self._input_size)
        blob = np.ascontiguousarray(fitted.transpose(2, 0, 1)[None]).astype(np.float32) / 255
        inputs = {self._session.get_inputs()[0].name: blob}
        table, prototypes = (out[0] for out in self._session.run(self._outputs, inputs))
        found = _sort_rows(table) if self._has_nms else _apply_nms(table, len(prototypes))

        height, width = rgb.shape[:2]
        origin = np.array([left, top, left, top], np.float32)
        limit = np.array([width, height, width, height], np.float32)
        boxes = np.clip((found.boxes - origin) / scale, 0, limit)
        stride = self._input_size[0] / prototypes.shape[1]
        map_boxes = (boxes * scale + origin) / stride
        maps = np.tensordot(found.coefficients, prototypes, axes=1)
        masks = [_sigmoid(_crop(m, box)) for m, box in zip(maps, map_boxes, strict=True)]
        size = (height, width)
        return _detections(boxes, found.labels, found.scores, masks, size, self.class_names)


class TorchvisionMaskRCNN:
    """Adapter of torchvision's Mask R-CNN, as torch's tracing exporter writes it."""

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        """Read the sizes and class names of a file."""
        self._session = session
        rows, columns = session.get_inputs()[0].shape[1:]
        is_fixed = isinstance(rows, int) and isinstance(columns, int)
        self.canvas: tuple[int, int] | None = (rows, columns) if is_fixed else None
        self.class_names = _read_class_names(path, metadata, None)

    @staticmethod
    def matches(session: Any) -> bool:
        """Check for one image without a batch as input, and boxes, labels, scores and masks."""
        inputs, outputs = session.get_inputs(), session.get_outputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 3 or inputs[0].shape[0] != 3:
            return False
        return sorted((value.type, len(value.shape)) for value in outputs) == [
            ("tensor(float)", 1),
            ("tensor(float)", 2),
            ("tensor(float)", 4),
            ("tensor(int64)", 1),
        ]

    def run(self, rgb: Image) -> Detections:
        """Segment an image. rgb: uint8 [H, W, 3]."""
        height, width = rgb.shape[:2]
        rows, columns = self.canvas or (height, width)
        fitted = rgb if (rows, columns) == (height, width) else cv2.resize(rgb, (columns, rows))
        blob = np.ascontiguousarray(fitted.transpose(2, 0, 1)).astype(np.float32) / 255
        outputs = self._session.run(None, {self._session.get_inputs()[0].name: blob})
        (labels,) = (out for out in outputs if out.dtype == np.int64)
        by_rank = {out.ndim: out for out in outputs if out.dtype == np.float32}
        scores, boxes, maps = by_rank[1], by_rank[2], by_rank[4][:, 0]

        keep = np.flatnonzero(scores > SCORE_THRESHOLD)
        keep = keep[np.argsort(-scores[keep], kind="stable")][:MAX_DETECTIONS]
        masks = [_crop(maps[i], boxes[i]) for i in keep]
        boxes = boxes[keep] * np.array([width / columns, height / rows] * 2, np.float32)
        size = (height, width)
        return _detections(boxes, labels[keep] - 1, scores[keep], masks, size, self.class_names)


ADAPTERS = (YoloSeg, TorchvisionMaskRCNN)


def _outputs_by_rank(session: Any) -> list[Any]:
    return sorted(session.get_outputs(), key=lambda value: len(value.shape))


def _apply_nms(table: Float32Array, num_prototypes: int) -> _Candidates:
    """Suppress overlapping candidates of the same class. table: [4 + C + P, n]."""
    center, size, classes, coefficients = np.split(table, [2, 4, len(table) - num_prototypes])
    scores, labels = classes.max(axis=0), classes.argmax(axis=0)
    likely = np.flatnonzero(scores > SCORE_THRESHOLD)
    top_left = center - size / 2
    chosen = cv2.dnn.NMSBoxesBatched(
        np.concatenate([top_left, size])[:, likely].T.astype(float).tolist(),
        scores[likely].astype(float).tolist(),
        labels[likely].tolist(),
        SCORE_THRESHOLD,
        _NMS_IOU,
    )
    rows = likely[np.asarray(chosen, dtype=np.int64).reshape(-1)]
    rows = rows[np.argsort(-scores[rows], kind="stable")][:MAX_DETECTIONS]
    boxes = np.concatenate([top_left, top_left + size])[:, rows].T
    return _Candidates(boxes, labels[rows], scores[rows], coefficients[:, rows].T)


def _sort_rows(table: Float32Array) -> _Candidates:
    """Sort candidates that went through NMS inside the network. table: [n, 6 + P]."""
    rows = table[table[:, 4] > SCORE_THRESHOLD]
    rows = rows[np.argsort(-rows[:, 4], kind="stable")][:MAX_DETECTIONS]
    return _Candidates(rows[:, :4], rows[:, 5].astype(np.int64), rows[:, 4], rows[:, 6:])


def _detections(
    boxes: NDArray[Any],
    labels: NDArray[Any],
    scores: NDArray[Any],
    masks: list[Float32Array],
    size: tuple[int, int],
    class_names: tuple[str, ...],
) -> Detections:
    """Build the detections. masks: [_ROI_CELLS, _ROI_CELLS] each; size: (height, width) px."""
    if len(labels) and labels.max() >= len(class_names):
        raise ContractError(
            f"class {labels.max() + 1} of the network has no name; {len(class_names)} are given"
        )
    empty = np.zeros((0, _ROI_CELLS, _ROI_CELLS), np.float32)
    return Detections(
        boxes.astype(np.float32).reshape(-1, 4),
        labels.astype(np.int64),
        scores.astype(np.float32),
        np.ones(len(labels), np.float32),
        np.stack(masks) if masks else empty,
        size,
        class_names,
    )


def _read_class_names(
    path: Path, metadata: dict[str, str], num_classes: int | None
) -> tuple[str, ...]:
    """Read the class names from the metadata's "names", else from `<file>.txt`, else count from 1.

    Raises:
        ContractError: they cannot be read, or there are not `num_classes` of them.
    """
    text_file = path.with_name(path.name + ".txt")
    if "names" in metadata:
        names = _parse_names(path, metadata["names"])
    elif text_file.is_file():
        names = text_file.read_text(encoding="utf-8").split("\n")
        names = names[:-1] if names[-1] == "" else names
    else:
        names = [str(i + 1) for i in range(num_classes or _DEFAULT_CLASSES)]
    if num_classes is not None and len(names) != num_classes:
        raise ContractError(f"{path}: {len(names)} class names for {num_classes} classes")
    return tuple(names)


def _parse_names(path: Path, text: str) -> list[str]:
    """Parse a Python list of names, or a dict label -> name."""
    try:
        value = ast.literal_eval(text)
        names = [value[i] for i in range(len(value))] if isinstance(value, dict) else list(value)
    except (KeyError, SyntaxError, TypeError, ValueError) as error:
        raise ContractError(f"{path}: its class names cannot be read: {text:.40}") from error
    return [str(name) for name in names]


def _letterbox(rgb: Image, canvas: tuple[int, int]) -> tuple[Image, float, tuple[int, int]]:
    """Fit an image into the center of a gray canvas.

    Args:
        rgb: uint8 [H, W, 3].
        canvas: (height, width), px.

    Returns:
        The canvas, canvas px per image px, and the left and top of the image on it.
    """
    rows, columns = canvas
    height, width = rgb.shape[:2]
    scale = min(rows / height, columns / width)
    inner_width, inner_height = max(1, round(width * scale)), max(1, round(height * scale))
    left = round((columns - inner_width) / 2 - 0.1)
    top = round((rows - inner_height) / 2 - 0.1)
    resized = cv2.resize(rgb, (inner_width, inner_height), interpolation=cv2.INTER_LINEAR)
    fitted = np.full((rows, columns, 3), _GRAY, np.uint8)
    fitted[top : top + inner_height, left : left + inner_width] = resized
    return fitted, scale, (left, top)


def _crop(field: Float32Array, box: NDArray[Any]) -> Float32Array:
    """Sample a map inside a box at the cell centers of a square grid.

    Args:
        field: [h, w].
        box: [4] xyxy, in cells of the map.

    Returns:
        [_ROI_CELLS, _ROI_CELLS].
    """
    x0, y0, x1, y1 = (float(v) for v in box)
    centers = (np.arange(_ROI_CELLS) + 0.5) / _ROI_CELLS
    u = (x0 + centers * (x1 - x0) - 0.5).astype(np.float32)
    v = (y0 + centers * (y1 - y0) - 0.5).astype(np.float32)
    grid_u, grid_v = np.meshgrid(u, v)
    field = np.ascontiguousarray(field, dtype=np.float32)
    border = cv2.BORDER_REPLICATE
    cells = cv2.remap(field, grid_u, grid_v, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(cells, dtype=np.float32)


def _sigmoid(x: NDArray[Any]) -> Float32Array:
    return np.asarray(1 / (1 + np.exp(-np.clip(x, -50, 50))), dtype=np.float32)
