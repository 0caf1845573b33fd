"""Segmenter: an ONNX file of `cohdc export`, or one of another exporter, on the CPU."""

import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime

from cohdc_train import signature
from cohdc_train.errors import ContractError
from cohdc_train.presets import model_path, shipped_models
from cohdc_train.segmenter.adapters import ADAPTERS
from cohdc_train.segmenter.detections import Detections
from cohdc_train.types import Image


class ModelAdapter(Protocol):
    """Adapter for one kind of ONNX file.

    Attributes:
        class_names: name of each label.
        canvas: (height, width) px that images are fitted into; None where they are not resized.
    """

    class_names: tuple[str, ...]
    canvas: tuple[int, int] | None

    def run(self, rgb: Image, /) -> Detections:
        """Segment an image. rgb: uint8 [H, W, 3]."""


class Segmenter:
    """Instance segmenter that runs an ONNX file on the CPU.

    Args:
        model: ONNX file of `cohdc export` or of an exporter that `cohdc_train.segmenter.adapters`
            knows, or the name of a shipped network: "person", "person_s".
        num_threads: threads of onnxruntime inside an operator; 0 lets onnxruntime choose.

    Attributes:
        class_names: name of each label.
        canvas: (height, width) px that images are fitted into; None where they are not resized.
        cut_by_quality: whether the file cuts the uncertain rim off masks of low quality
            (`cohdc_train.models.inference.cut_by_quality`).

    Raises:
        ContractError: there is no such file, it is not ONNX, or its inputs and outputs are unknown.
    """

    def __init__(self, model: str | Path, num_threads: int = 0) -> None:
        """Load the file and choose its adapter."""
        path = model_path(model)
        session = open_session(path, num_threads)
        metadata: dict[str, str] = session.get_modelmeta().custom_metadata_map
        self._adapter = _choose_adapter(path, session, metadata)
        self.class_names = self._adapter.class_names
        self.canvas = self._adapter.canvas
        thresholds = json.loads(metadata.get(signature.KEY_THRESHOLDS, "{}"))
        self.cut_by_quality = thresholds.get("mask_cut") == "quality"

    def __call__(self, rgb: Image) -> Detections:
        """Segment an image.

        Args:
            rgb: uint8 [H, W, 3].

        Returns:
            The detections above the file's own score threshold, the highest score first.
        """
        return self._adapter.run(rgb)


def open_session(path: Path, num_threads: int = 0) -> Any:
    """Open an onnxruntime session on the CPU.

    Raises:
        ContractError: there is no such file, or it is not ONNX.
    """
    if not Path(path).is_file():
        names = ", ".join(shipped_models())
        raise ContractError(f"{path}: no such file; shipped networks: {names}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = num_threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no narrower base
        reason = str(error).splitlines()[0]
        raise ContractError(f"{path}: onnxruntime cannot load it: {reason}") from error


def _choose_adapter(path: Path, session: Any, metadata: dict[str, str]) -> ModelAdapter:
    if signature.KEY_CONTRACT not in metadata:
        for adapter in ADAPTERS:
            if adapter.matches(session):
                return adapter(path, session, metadata)
    return CohdcModel(path, session, metadata)


class CohdcModel:
    """Adapter of files that keep the contract of `cohdc_train.signature`.

    Raises:
        ContractError: the file does not keep it.
    """

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        """Read the canvas and class names of a file."""
        _check_contract(path, session, metadata)
        self._session = session
        self.class_names: tuple[str, ...] = tuple(json.loads(metadata[signature.KEY_CLASSES]))
        rows, columns = json.loads(metadata[signature.KEY_INPUT])["canvas"]
        self.canvas: tuple[int, int] | None = (int(rows), int(columns))

    def run(self, rgb: Image) -> Detections:
        """Segment an image. rgb: uint8 [H, W, 3]."""
        inputs = {signature.INPUT: np.ascontiguousarray(rgb[None])}
        *padded, count = self._session.run(list(signature.OUTPUTS), inputs)
        num_detections = int(count[0])
        boxes, labels, scores, quality, masks = (array[0, :num_detections] for array in padded)
        height, width = rgb.shape[:2]
        return Detections(boxes, labels, scores, quality, masks, (height, width), self.class_names)


def _check_contract(path: Path, session: Any, metadata: dict[str, str]) -> None:
    missing = [key for key in signature.METADATA_KEYS if key not in metadata]
    if missing:
        raise ContractError(
            f"{path}: metadata {missing[0]} is missing; neither cohdc export nor another known "
            "exporter wrote it"
        )
    version, known = metadata[signature.KEY_CONTRACT], str(signature.CONTRACT_VERSION)
    if version != known:
        raise ContractError(f"{path}: contract {version}, this version reads {known}")
    inputs = [value.name for value in session.get_inputs()]
    outputs = [value.name for value in session.get_outputs()]
    if inputs != [signature.INPUT]:
        raise ContractError(f"{path}: inputs {inputs}, the contract has [{signature.INPUT!r}]")
    for name in signature.OUTPUTS:
        if name not in outputs:
            raise ContractError(f"{path}: output {name} is missing, the file has {outputs}")
