"""One ONNX file, run: those of `cohdc export`, and foreign ones that are recognised by their
signature.
"""

import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime

from cohdc_train import signature
from cohdc_train.errors import ContractError
from cohdc_train.presets import model_path, shipped_models
from cohdc_train.segmenter.adapters import FOREIGN
from cohdc_train.segmenter.detections import Detections
from cohdc_train.types import Image


class Graph(Protocol):
    """How one kind of graph is fed and read.

    Attributes:
        class_names: name per label.
        canvas: (height, width) px that images are fitted into; None where they go in as they are.
    """

    class_names: tuple[str, ...]
    canvas: tuple[int, int] | None

    def run(self, rgb: Image, /) -> Detections:
        """rgb: uint8 [H, W, 3] -> what was found."""


class Segmenter:
    """Runs one ONNX file.

    Args:
        path: a file written by `cohdc export`, one of the foreign ones of
            `cohdc_train.segmenter.adapters`, or the name of a network that comes with the package:
            "person".
        threads: onnxruntime's threads inside an operator; 0 leaves it to onnxruntime.

    Attributes:
        class_names: name per label.
        canvas: (height, width) px that images are fitted into; None where they go in as they are.
        cut_by_quality: the masks of a doubtful contour have its doubtful rim
            (`models.inference.cut_by_quality`).

    Raises:
        ContractError: there is no such file, it is not ONNX, or it keeps neither the contract nor a
            foreign layout.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        path = model_path(path)
        session = open_session(path, threads)
        metadata: dict[str, str] = session.get_modelmeta().custom_metadata_map
        kind = (
            None
            if signature.KEY_CONTRACT in metadata
            else next((k for k in FOREIGN if k.matches(session)), None)
        )
        graph: Graph = (
            _Ours(path, session, metadata) if kind is None else kind(path, session, metadata)
        )
        self._graph = graph
        self.class_names = graph.class_names
        self.canvas = graph.canvas
        self.cut_by_quality = (
            json.loads(metadata.get(signature.KEY_THRESHOLDS, "{}")).get("mask_cut") == "quality"
        )

    def __call__(self, rgb: Image) -> Detections:
        """rgb: uint8 [H, W, 3]. Returns what the file finds at its own score threshold, rows
        falling by score.
        """
        return self._graph.run(rgb)


def open_session(path: Path, threads: int = 0) -> Any:
    """An onnxruntime session on the CPU. Raises ContractError when there is no such file or it is
    not ONNX.
    """
    if not Path(path).is_file():
        raise ContractError(
            f"{path}: no such file; shipped networks: {', '.join(shipped_models())}"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no narrower base
        raise ContractError(
            f"{path}: onnxruntime cannot load it: {str(error).splitlines()[0]}"
        ) from error


class _Ours:
    """A file that keeps the contract of `cohdc_train.signature`."""

    def __init__(self, path: Path, session: Any, metadata: dict[str, str]) -> None:
        _check_contract(path, session, metadata)
        self._session = session
        self.class_names: tuple[str, ...] = tuple(json.loads(metadata[signature.KEY_CLASSES]))
        rows, columns = json.loads(metadata[signature.KEY_INPUT])["canvas"]
        self.canvas: tuple[int, int] | None = (int(rows), int(columns))

    def run(self, rgb: Image) -> Detections:
        outputs = self._session.run(
            list(signature.OUTPUTS), {signature.INPUT: np.ascontiguousarray(rgb[None])}
        )
        *rows, count = outputs
        boxes, labels, scores, quality, masks = (row[0, : int(count[0])] for row in rows)
        height, width = rgb.shape[:2]
        return Detections(boxes, labels, scores, quality, masks, (height, width), self.class_names)


def _check_contract(path: Path, session: Any, metadata: dict[str, str]) -> None:
    missing = [key for key in signature.METADATA_KEYS if key not in metadata]
    if missing:
        raise ContractError(
            f"{path}: metadata {missing[0]} is missing; neither cohdc export nor a known foreign exporter wrote it"
        )
    version = metadata[signature.KEY_CONTRACT]
    if version != str(signature.CONTRACT_VERSION):
        raise ContractError(
            f"{path}: contract {version}, this version reads {signature.CONTRACT_VERSION}"
        )
    inputs, outputs = (
        [i.name for i in session.get_inputs()],
        [o.name for o in session.get_outputs()],
    )
    if inputs != [signature.INPUT]:
        raise ContractError(f"{path}: inputs {inputs}, the contract has [{signature.INPUT!r}]")
    for name in signature.OUTPUTS:
        if name not in outputs:
            raise ContractError(f"{path}: output {name} is missing, the file has {outputs}")
