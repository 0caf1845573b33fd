"""Compare two result folders byte by byte, without times, versions, and drawn images."""

import csv
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# JSON keys and CSV columns whose values change from run to run, or from release to release.
_VOLATILE = re.compile(r"(.*_)?(ms|fps|seconds)|behind_s|speed/.*|version")
_EXCEPTED_FILES = re.compile(r"config\.yaml|hparams\.yaml|.*\.log|events\.out\.tfevents\..*")
_IMAGE_FOLDERS = {"pictures", "overlays"}


@dataclass(frozen=True)
class Comparison:
    """Result of comparing two folders.

    Attributes:
        different: a line per file that is missing on one side or differs.
        digest: SHA-256 of what was compared in the first folder.
        num_files: number of files in the first folder that were compared.
    """

    different: list[str]
    digest: str
    num_files: int


def compare_folders(base: Path, head: Path, with_images: bool = False) -> Comparison:
    """Compare all result files of two folders.

    Args:
        base: first folder.
        head: second folder.
        with_images: compare the files in folders of drawn images, too.
    """
    base_files = result_files(base, with_images)
    head_files = result_files(head, with_images)
    digest = hashlib.sha256()
    different = []
    for name in sorted(base_files | head_files):
        if name not in head_files:
            different.append(f"{name} (missing in HEAD)")
        elif name not in base_files:
            different.append(f"{name} (only in HEAD)")
        elif comparable_bytes(base / name) != comparable_bytes(head / name):
            different.append(name)
        if name in base_files:
            content = hashlib.sha256(comparable_bytes(base / name)).hexdigest()
            digest.update(f"{name} {content}\n".encode())
    return Comparison(different, digest.hexdigest(), len(base_files))


def result_files(folder: Path, with_images: bool = False) -> set[str]:
    """Return the paths, relative to a folder, of the files that are compared."""
    names = set()
    for path in folder.rglob("*"):
        relative = path.relative_to(folder)
        is_image = bool(_IMAGE_FOLDERS.intersection(relative.parts[:-1]))
        is_excepted = bool(_EXCEPTED_FILES.fullmatch(path.name))
        is_result = path.is_file() and not is_excepted
        if is_result and (with_images or not is_image):
            names.add(relative.as_posix())
    return names


def comparable_bytes(path: Path) -> bytes:
    """Return the bytes of a file that must not change; all of them for most files."""
    for pattern, read in _READERS.items():
        if re.fullmatch(pattern, path.name):
            return read(path)
    return path.read_bytes()


def is_volatile(name: str) -> bool:
    """Return whether a JSON key or CSV column holds a time, a speed or a version."""
    return _VOLATILE.fullmatch(name) is not None


def _csv_without_times(path: Path) -> bytes:
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = list(csv.reader(file))
    kept = [index for index, name in enumerate(header) if not is_volatile(name)]
    table = [[row[index] for index in kept] for row in [header, *rows]]
    return json.dumps(table).encode()


def _json_without_times(path: Path) -> bytes:
    return json.dumps(_without_volatile(json.loads(path.read_text(encoding="utf-8")))).encode()


def _without_volatile(value: Any) -> Any:
    if isinstance(value, dict):
        items = value.items()
        return {key: _without_volatile(item) for key, item in items if not is_volatile(key)}
    if isinstance(value, list):
        return [_without_volatile(item) for item in value]
    return value


def _checkpoint(path: Path) -> bytes:
    """Return names, types and bytes of all weights, and the hyperparameters."""
    import torch

    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    parts = [json.dumps(checkpoint["hyper_parameters"], default=str).encode()]
    for name, tensor in checkpoint["state_dict"].items():
        parts.append(f"\n{name} {tensor.dtype} {tuple(tensor.shape)} ".encode())
        parts.append(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return b"".join(parts)


def _onnx(path: Path) -> bytes:
    """Return inputs, outputs, metadata, the operators in order, and all initializers."""
    import onnx

    model = onnx.load(path)
    return b"\n".join(_onnx_parts(model, onnx.numpy_helper.to_array))


def _onnx_parts(model: Any, to_array: Callable[[Any], Any]) -> Iterator[bytes]:
    graph = model.graph
    for value in [*graph.input, *graph.output]:
        yield value.SerializeToString()
    for entry in model.metadata_props:
        if not entry.key.endswith("version"):
            yield f"{entry.key} {entry.value}".encode()
    for node in graph.node:
        yield node.op_type.encode()
    for tensor in graph.initializer:
        array = to_array(tensor)
        yield f"{tensor.name} {array.dtype} {array.shape} ".encode() + array.tobytes()


_READERS: dict[str, Callable[[Path], bytes]] = {
    r"frames\.csv|metrics\.csv": _csv_without_times,
    r"metrics\.json|.*\.onnx\.json": _json_without_times,
    r".*\.ckpt": _checkpoint,
    r".*\.onnx": _onnx,
}
