"""An ONNX file that keeps the contract of `cohdc_train.signature` -> detections (onnxruntime, never torch)."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train import signature
from cohdc_train.errors import ContractError
from cohdc_train.masks import paste_roi_mask


@dataclass(frozen=True)
class Detections:
    """What was found in one image, rows falling by score.

    Attributes:
        boxes: float32 [N, 4] xyxy, px of the image.
        labels: int64 [N], index into class_names.
        scores: float32 [N], class score.
        quality: float32 [N], CQE's estimate of the mask's IoU with its object (1 where the network has no CQE head).
        roi_masks: float32 [N, M, M], probability inside the box.
        size: (height, width) of the image, px.
        class_names: name per label.
    """

    boxes: NDArray[np.float32]
    labels: NDArray[np.int64]
    scores: NDArray[np.float32]
    quality: NDArray[np.float32]
    roi_masks: NDArray[np.float32]
    size: tuple[int, int]
    class_names: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.boxes)
        expected = {"boxes": (n, 4), "labels": (n,), "scores": (n,), "quality": (n,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} is {getattr(self, name).shape}, expected {shape}")
        if self.roi_masks.ndim != 3 or len(self.roi_masks) != n or self.roi_masks.shape[1] != self.roi_masks.shape[2]:
            raise ValueError(f"roi_masks is {self.roi_masks.shape}, expected ({n}, M, M)")

    def __len__(self) -> int:
        return len(self.boxes)

    def select(self, keep: NDArray[np.bool_]) -> "Detections":
        """The rows where keep [N] is True."""
        rows = (self.boxes[keep], self.labels[keep], self.scores[keep], self.quality[keep], self.roi_masks[keep])
        return Detections(*rows, self.size, self.class_names)

    def masks(self, threshold: float = 0.5) -> NDArray[np.bool_]:
        """[N, H, W] bool: each object's pixels in the image."""
        if not len(self):
            return np.zeros((0, *self.size), dtype=np.bool_)
        pairs = zip(self.roi_masks, self.boxes, strict=True)
        return np.stack([paste_roi_mask(mask, box, self.size, threshold) for mask, box in pairs])


class Segmenter:
    """Runs one ONNX file.

    Args:
        path: a file written by `cohdc export`.
        threads: onnxruntime's threads inside an operator; 0 leaves it to onnxruntime.

    Raises:
        ContractError: there is no such file, it is not ONNX, or it does not keep the contract.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        import onnxruntime

        if not Path(path).is_file():
            raise ContractError(f"{path}: no such file")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors share no narrower base
            raise ContractError(f"{path}: onnxruntime cannot load it: {str(error).splitlines()[0]}") from error
        metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        _check_contract(path, self._session, metadata)
        self.class_names: tuple[str, ...] = tuple(json.loads(metadata[signature.KEY_CLASSES]))
        rows, columns = json.loads(metadata[signature.KEY_INPUT])["canvas"]
        self.canvas: tuple[int, int] = (int(rows), int(columns))
        self.mask_threshold = float(json.loads(metadata[signature.KEY_THRESHOLDS])["mask"])

    def __call__(self, rgb: NDArray[np.uint8]) -> Detections:
        """rgb: uint8 [H, W, 3]. Returns what the file finds at its own score threshold."""
        outputs = self._session.run(list(signature.OUTPUTS), {signature.INPUT: np.ascontiguousarray(rgb[None])})
        *rows, count = outputs
        boxes, labels, scores, quality, masks = (row[0, : int(count[0])] for row in rows)
        height, width = rgb.shape[:2]
        return Detections(boxes, labels, scores, quality, masks, (height, width), self.class_names)


def _check_contract(path: Path, session: Any, metadata: dict[str, str]) -> None:
    missing = [key for key in signature.METADATA_KEYS if key not in metadata]
    if missing:
        raise ContractError(f"{path}: metadata {missing[0]} is missing; this file was not written by cohdc export")
    version = metadata[signature.KEY_CONTRACT]
    if version != str(signature.CONTRACT_VERSION):
        raise ContractError(f"{path}: contract {version}, this version reads {signature.CONTRACT_VERSION}")
    inputs, outputs = [i.name for i in session.get_inputs()], [o.name for o in session.get_outputs()]
    if inputs != [signature.INPUT]:
        raise ContractError(f"{path}: inputs {inputs}, the contract has [{signature.INPUT!r}]")
    for name in signature.OUTPUTS:
        if name not in outputs:
            raise ContractError(f"{path}: output {name} is missing, the file has {outputs}")
