"""Camera calibration files (YAML), and the choice of one for a sequence."""

import math
import re
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import yaml

from cohdc_train.errors import DataError
from cohdc_train.presets import config_path
from cohdc_train.slam.geometry.camera import Camera

_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
_POSITIVE = ("fx", "fy", "width", "height", "depth_scale")
_NOT_NEGATIVE = ("baseline", "readout_s")
_ALIASES = {"readout": "readout_s"}  # files written for earlier versions
_FREIBURG = re.compile(r"(?:freiburg|fr)([123])(?![0-9])", re.IGNORECASE)


class _Entry(NamedTuple):
    """One number of a YAML file, and the line that it stands on."""

    key: str
    value: float
    line: int


def load_camera(path: Path) -> Camera:
    """Read a camera from a YAML file.

    The file holds fx, fy, cx, cy, width, height and depth_scale; k1, k2, p1, p2, k3, baseline and
    readout_s are 0 where absent. A camera with a baseline needs no depth_scale.

    Raises:
        DataError: the file cannot be parsed, a key is missing or unknown, or a value is no usable
            number; the message names the file and, where there is one, the line.
    """
    values: dict[str, float] = {}
    known = {field.name for field in fields(Camera)}
    for entry in _read_numbers(path):
        key = _ALIASES.get(entry.key, entry.key)
        _check_entry(path, entry, key, known)
        values[key] = entry.value
    if values.get("baseline"):
        values.setdefault("depth_scale", 1.0)

    missing = [key for key in _REQUIRED if key not in values]
    if missing:
        raise DataError(f"{path}: missing {' '.join(missing)}")
    width, height = int(values.pop("width")), int(values.pop("height"))
    return Camera(width=width, height=height, **values)


def choose_camera(sequence: Path, given: Path | None) -> tuple[Camera, str]:
    """Load the camera of a sequence, and tell where it came from.

    The order is `given`, then camera.yaml in the sequence's folder, then the freiburg1, 2 or 3
    preset that the folder's name suggests.

    Returns:
        The camera, and a phrase for the user that names its origin.

    Raises:
        DataError: none of the three applies.
    """
    if given is not None:
        path = config_path(given)
        return load_camera(path), f"{given}, from --camera"
    own_file = sequence / "camera.yaml"
    if own_file.is_file():
        return load_camera(own_file), f"{own_file}, in the sequence's folder"

    name = sequence.resolve().name
    match = _FREIBURG.search(name)
    if match is None:
        problem = "the folder's name does not tell the camera"
        raise DataError(f"{sequence}: {problem}; put camera.yaml there or give --camera")
    preset = f"slam/freiburg{match.group(1)}.yaml"
    camera = load_camera(config_path(preset))
    return camera, f"preset {preset}, guessed from the folder's name {name}"


def _check_entry(path: Path, entry: _Entry, key: str, known: set[str]) -> None:
    """Raise DataError for an unknown key and for a value out of range."""
    place = f"{path}:{entry.line}"
    if key not in known:
        names = " ".join(sorted(known))
        raise DataError(f"{place}: unknown key {entry.key!r}; a camera has {names}")
    if key in _POSITIVE and entry.value <= 0:
        raise DataError(f"{place}: {entry.key} must be above 0, not {entry.value:g}")
    if key in _NOT_NEGATIVE and entry.value < 0:
        raise DataError(f"{place}: {entry.key} cannot be below 0, and is {entry.value:g}")


def _read_numbers(path: Path) -> list[_Entry]:
    """Read a flat YAML mapping of numbers; DataError names what cannot be read."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f":{mark.line + 1}"
        problem = getattr(error, "problem", None) or "not YAML"
        raise DataError(f"{path}{line}: broken YAML: {problem}") from error
    if not isinstance(root, yaml.MappingNode):
        raise DataError(f"{path}:1: a camera file holds lines such as 'fx: 525.0'")
    return [_read_number(path, key, value) for key, value in root.value]


def _read_number(path: Path, key: yaml.Node, value: yaml.Node) -> _Entry:
    """Convert a key and a value of the YAML tree; DataError where the value is no finite number."""
    line = key.start_mark.line + 1
    try:
        number = float(value.value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}:{line}: {key.value} is not a number") from error
    if not math.isfinite(number):
        raise DataError(f"{path}:{line}: {key.value} is not a finite number")
    return _Entry(str(key.value), number, line)
