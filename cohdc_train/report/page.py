"""What a page is made of, and its HTML: the template and the style sheet lie in templates/."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from cohdc_train import __version__

_TEMPLATE = "report.html.j2"


@dataclass(frozen=True)
class Fact:
    """One thing to know first. detail: a few words below the value; bad: whether it is a fault."""

    name: str
    value: str
    detail: str = ""
    bad: bool = False


@dataclass(frozen=True)
class Table:
    """A table of the page: a title, the words of the head and of the rows.

    words: how many columns hold words, which stand at the left; best: (row, column) of cells that
    are the best of their column; note: a sentence below. Raises ValueError for an uneven row.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int = 1
    best: frozenset[tuple[int, int]] = frozenset()
    note: str = ""

    def __post_init__(self) -> None:
        """Check that every row has a cell for every word of the head."""
        if any(len(row) != len(self.head) for row in self.rows):
            raise ValueError(f"table {self.title!r}: not every row has {len(self.head)} cells")


@dataclass(frozen=True)
class EmbeddedImage:
    """An image as a data URL. width, height: px."""

    source: str
    width: int
    height: int


@dataclass(frozen=True)
class Figure:
    """A plot or an image with its caption.

    wide, narrow: SVG elements for a screen and for a telephone, empty for an image; span: whether
    it takes the whole width of the page; large: whether it takes twice the room of others;
    chart: whether the image is a plot on white, which a dark page turns over.
    """

    title: str
    caption: str = ""
    wide: str = ""
    narrow: str = ""
    image: EmbeddedImage | None = None
    span: bool = False
    large: bool = False
    chart: bool = False


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading; what is empty is skipped.

    text: sentences below the heading; facts: tiles; folded: tables that are shown on demand;
    divider: whether it opens a part of the page that has sections of its own.
    """

    title: str
    text: Sequence[str] = ()
    facts: Sequence[Fact] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    folded: Sequence[Table] = ()
    divider: bool = False

    @property
    def has_content(self) -> bool:
        """Whether there is anything to show below the heading."""
        return any((self.text, self.facts, self.tables, self.figures, self.folded, self.divider))


@dataclass(frozen=True)
class Page:
    """A whole page. kind: what it is of, such as `SLAM run`; lead: sentences below the title."""

    title: str
    kind: str = ""
    lead: Sequence[str] = ()
    facts: Sequence[Fact] = ()
    sections: Sequence[Section] = field(default_factory=list)

    def html(self) -> str:
        """Return the page as one HTML document; every word in it is escaped."""
        from jinja2 import Environment, PackageLoader, StrictUndefined

        environment = Environment(
            loader=PackageLoader("cohdc_train.report"),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
            keep_trailing_newline=True,
        )
        sections = [section for section in self.sections if section.has_content]
        template = environment.get_template(_TEMPLATE)
        return template.render(page=self, sections=sections, version=__version__)
