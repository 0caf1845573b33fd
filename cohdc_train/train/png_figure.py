"""Figures as PNG bytes (matplotlib, without pyplot's global state)."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_NAME = 20  # letters of a class name


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure; width, height: inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def to_png(figure: "Figure") -> bytes:
    """Render a figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def short_name(name: str) -> str:
    """Shorten a class name to what a plot has room for; a dollar starts no formula."""
    shown = name if len(name) <= _MAX_NAME else name[: _MAX_NAME - 1] + "…"
    return shown.replace("$", r"\$")
