"""Camera files: YAML to a Camera."""

import math
import re
from dataclasses import fields
from pathlib import Path

import yaml

from cohdc_train.errors import DataError
from cohdc_train.presets import config_path
from cohdc_train.slam.geometry.camera import Camera

_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
_FREIBURG = re.compile(r"(?:freiburg|fr)([123])(?![0-9])", re.IGNORECASE)


def load_camera(path: Path) -> Camera:
    """Read `fx fy cx cy width height depth_scale` and, 0 where absent, `k1 k2 p1 p2 k3`,
    `baseline`, `readout`.

    A camera with a baseline needs no depth_scale.

    Raises DataError naming the file, and the line where there is one, for yaml that cannot be
    parsed, a missing or unknown key, or a value that is not a usable number.
    """
    values: dict[str, float] = {}
    known = {field.name for field in fields(Camera)}
    for key, value, line in _numbers(path):
        if key not in known:
            raise DataError(
                f"{path}:{line}: unknown key {key!r}; a camera has {' '.join(sorted(known))}"
            )
        if key in _REQUIRED and key not in ("cx", "cy") and value <= 0:
            raise DataError(f"{path}:{line}: {key} must be above 0, not {value:g}")
        if key in ("baseline", "readout") and value < 0:
            raise DataError(f"{path}:{line}: {key} cannot be below 0, and is {value:g}")
        values[key] = value
    if values.get("baseline"):
        values.setdefault("depth_scale", 1.0)
    missing = [key for key in _REQUIRED if key not in values]
    if missing:
        raise DataError(f"{path}: missing {' '.join(missing)}")
    width, height = int(values.pop("width")), int(values.pop("height"))
    return Camera(width=width, height=height, **values)


def choose_camera(sequence: Path, given: Path | None) -> tuple[Camera, str]:
    """The camera of a sequence, and a phrase that says where it came from.

    Order: `given`, `camera.yaml` in the sequence's folder, the freiburg1/2/3 preset that the
    folder's name calls for. Raises DataError when none of the three applies.
    """
    if given is not None:
        path = config_path(given)
        return load_camera(path), f"{given}, as asked"
    beside = sequence / "camera.yaml"
    if beside.is_file():
        return load_camera(beside), f"{beside}, beside the sequence"
    name = sequence.resolve().name
    match = _FREIBURG.search(name)
    if match is None:
        message = f"{sequence}: cannot tell the camera from the folder's name; put camera.yaml there or give --camera"
        raise DataError(message)
    preset = f"slam/freiburg{match.group(1)}.yaml"
    return load_camera(
        config_path(preset)
    ), f"preset {preset}, guessed from the folder's name {name}"


def _numbers(path: Path) -> list[tuple[str, float, int]]:
    """(key, value, line) of a flat yaml mapping of numbers."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f":{mark.line + 1}"
        problem = getattr(error, "problem", None) or "not yaml"
        raise DataError(f"{path}{line}: broken yaml: {problem}") from error
    if not isinstance(root, yaml.MappingNode):
        raise DataError(f"{path}:1: a camera file holds lines such as 'fx: 525.0'")
    rows: list[tuple[str, float, int]] = []
    for key, value in root.value:
        line = key.start_mark.line + 1
        try:
            number = float(value.value)
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}:{line}: {key.value} is not a number") from error
        if not math.isfinite(number):
            raise DataError(f"{path}:{line}: {key.value} is not a finite number")
        rows.append((str(key.value), number, line))
    return rows
