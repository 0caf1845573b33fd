"""Matplotlib figures as inline SVG that takes its colors from the page, light or dark."""

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colors that no plot uses for anything else; the page's style sheet says what they become.
INK, FAINT, LOST, PANEL, TRUTH = "#00f0a0", "#00f0a1", "#00f0a2", "#00f0a3", "#00f0a4"
SERIES = tuple(f"#00f0b{k}" for k in range(8))
_VARIABLES = {
    INK: "var(--ink)",
    FAINT: "var(--grid)",
    LOST: "var(--lost)",
    PANEL: "var(--panel)",
    TRUTH: "var(--truth)",
    **{color: f"var(--series-{k})" for k, color in enumerate(SERIES)},
}
_PX_PER_INCH = 96  # as CSS has it
_STYLE = {
    "svg.fonttype": "none",
    "svg.image_inline": True,
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": FAINT,
    "axes.facecolor": "none",
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "figure.facecolor": "none",
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "patch.linewidth": 0.0,
    "savefig.facecolor": "none",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.color": FAINT,
    "ytick.labelcolor": INK,
}


class Size(NamedTuple):
    """A figure's size in px of the page, at which its letters have the size of the page's."""

    width: float
    height: float


Draw = Callable[["Figure"], None]


def color(index: int) -> str:
    """Return the color of the run at a place in the list."""
    return SERIES[index % len(SERIES)]


def dash(index: int) -> str:
    """Return the line style of the run at a place: after eight runs colors repeat, dashed."""
    return ("-", "--", ":", "-.")[index // len(SERIES) % 4]


def svg(draw: Draw, size: Size, name: str) -> str:
    """Draw a figure and return it as an SVG element.

    name: of the figure, unlike that of any other of the page, for its inner references. The same
    figure and name give the same text.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    buffer = io.StringIO()
    style: Any = {**_STYLE, "svg.hashsalt": name}
    with rc_context(style):
        figure = Figure(
            figsize=(size.width / _PX_PER_INCH, size.height / _PX_PER_INCH), layout="constrained"
        )
        draw(figure)
        _settle(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, dpi=192)
    return _for_page(buffer.getvalue())


def legend(figure: "Figure", axes: "Axes") -> None:
    """Put a legend above the axes, in as many columns as the figure has room for."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) < 2:
        return
    longest = max(len(label) for label in labels)
    columns = max(1, int(figure.get_figwidth() * 72 / (28 + 5.2 * longest)))
    figure.legend(handles, labels, loc="outside upper left", ncols=min(columns, len(labels)))


def log_scale(axes: "Axes") -> None:
    """Make the y axis logarithmic, with plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")


def _settle(figure: "Figure") -> None:
    """Lay a figure out once, and round the places of its axes.

    The layout's solver differs in its last digits from call to call, and with it the page.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine("none")
    for axes in figure.axes:
        left, bottom, width, height = axes.get_position(original=True).bounds
        axes.set_position((round(left, 4), round(bottom, 4), round(width, 4), round(height, 4)))


def _for_page(text: str) -> str:
    """Return the element alone, with the page's colors and font, and without its own size."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg [^>]*?)\bwidth="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg [^>]*?)\bheight="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'<g id="[a-zA-Z_.0-9]*">', "<g>", text)
    text = re.sub(r" font-family: [^;\"]*;", "", text).replace("&#8722;", "−")
    text = re.sub(r'\b(?:d|x|y)="[^"]*"', _rounded, text)
    for placeholder, variable in _VARIABLES.items():
        text = text.replace(placeholder, variable)
    return re.sub(r"\n\s*", "\n", text).strip()


def _rounded(attribute: re.Match[str]) -> str:
    """Return an attribute's coordinates with one digit: a tenth of a point is not seen."""
    short = re.sub(r"\d+\.\d+", lambda number: f"{float(number[0]):.1f}", attribute[0])
    return re.sub(r"\s+", " ", short).replace(" L ", "L").replace(" M ", "M")
