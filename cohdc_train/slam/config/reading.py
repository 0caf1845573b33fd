"""Reading of options from YAML files and dotted names, with type checks."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import yaml

from cohdc_train.errors import DataError

_Config = TypeVar("_Config")


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the options of a YAML file; from a run's config.yaml, those under `settings`."""
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise DataError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if isinstance(content, dict) and "settings" in content:
        content = content["settings"]
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds {type(content).__name__}, not a mapping of options")
    return content


def as_plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Convert options to YAML types: tuples become lists, and paths become text."""
    result: dict[str, Any] = {}
    for name, value in options.items():
        if isinstance(value, Mapping):
            result[name] = as_plain(value)
        elif isinstance(value, tuple):
            result[name] = list(value)
        else:
            result[name] = str(value) if isinstance(value, Path) else value
    return result


def nested(options: Mapping[str, object]) -> dict[str, Any]:
    """Turn dotted names into nested mappings: {"a.b": 1} becomes {"a": {"b": 1}}."""
    result: dict[str, Any] = {}
    for name, value in options.items():
        *sections, last = name.split(".")
        inner = result
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[last] = value
    return result


def changed(config: _Config, options: Mapping[str, Any], where: str, prefix: str = "") -> _Config:
    """Return a copy of a config dataclass with some fields changed, sections recursively.

    Args:
        config: the dataclass.
        options: new values, nested by section.
        where: origin of the options for error messages, such as a file.
        prefix: section of the options, with a period at the end.

    Raises:
        DataError: an option is unknown, or a value has a wrong type or is out of range.
    """
    if not isinstance(options, Mapping):
        raise DataError(f"{where}: {prefix.rstrip('.')} is {options!r}, not a mapping of options")
    hints = get_type_hints(type(config))
    names = [entry.name for entry in fields(config)]  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for name, value in options.items():
        if name not in names:
            raise DataError(f"{where}: no option {prefix}{name}{_suggestion(str(name), names)}")
        current = getattr(config, name)
        if is_dataclass(current):
            values[name] = changed(current, value, where, f"{prefix}{name}.")
        else:
            values[name] = _converted(value, hints[name], f"{where}: {prefix}{name}")
    try:
        return replace(config, **values)  # type: ignore[type-var]
    except DataError as error:
        if str(error).startswith(where):
            raise
        raise DataError(f"{where}: {error}") from error


def _suggestion(name: str, names: list[str]) -> str:
    """Return the end of an error message: the closest name, or all names."""
    close = get_close_matches(name, names, 1, 0.5)
    return f"; did you mean {close[0]}?" if close else f"; there are {', '.join(names)}"


def _converted(value: Any, hint: Any, what: str) -> Any:
    """Convert a value to its field's type; raise DataError where that is impossible."""
    if isinstance(hint, UnionType):
        if value is None:
            return None
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) is tuple:
        if not isinstance(value, list | tuple):
            raise DataError(f"{what} is {value!r}, not a list")
        kinds = get_args(hint)
        if kinds[-1] is Ellipsis:
            kinds = (kinds[0],) * len(value)
        if len(kinds) != len(value):
            raise DataError(f"{what} has {len(value)} numbers, not {len(kinds)}")
        return tuple(_converted(v, kind, what) for v, kind in zip(value, kinds, strict=True))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise DataError(f"{what} is {value!r}, not {hint.__name__}")
    return value
