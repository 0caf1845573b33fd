"""Tables that pages about any kind of run have: what is best, and which options differ."""

from collections.abc import Mapping, Sequence
from typing import Any

from cohdc_train.report.page import Table


def mark_best(rows: Sequence[Sequence[str]], better: Sequence[int]) -> frozenset[tuple[int, int]]:
    """Return (row, column) of the best numbers, as they are shown; none where all are alike.

    better: of each column, +1 when larger is better, -1 when smaller is, 0 when neither.
    """
    marked: set[tuple[int, int]] = set()
    for column, sign in enumerate(better):
        cells = [row[column] for row in rows]
        known = {cell: float(cell) for cell in cells if _is_number(cell)} if sign else {}
        if len(known) > 1:
            top = max(known, key=lambda cell: sign * known[cell])
            marked |= {(row, column) for row, cell in enumerate(cells) if cell == top}
    return frozenset(marked)


def _is_number(text: str) -> bool:
    return text.replace(".", "", 1).replace("-", "", 1).isdecimal()


def options(configs: Mapping[str, Mapping[str, Any]]) -> tuple[list[Table], list[Table]]:
    """Return the options in which runs differ, and all of them. configs: label -> configuration."""
    flat = {label: _flat(config) for label, config in configs.items()}
    keys = list(dict.fromkeys(key for options in flat.values() for key in options))
    if not keys:
        return [], []
    rows = [[key, *(options.get(key, "–") for options in flat.values())] for key in keys]
    head = ["Option", *(flat if len(flat) > 1 else ["Value"])]
    different = [row for row in rows if len(set(row[1:])) > 1]
    differing = [Table("Options that differ", head, different)] if different else []
    return differing, [Table("All options", head, rows)]


def _flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested options as `group.name` -> text."""
    result: dict[str, str] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            result |= _flat(value, f"{name}.")
        else:
            words = {"None": "none", "True": "yes", "False": "no"}
            result[name] = words.get(str(value), str(value))
    return result
