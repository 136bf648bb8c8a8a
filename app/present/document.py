"""A result as a document of sentences, tables and figures, which says nothing of where it is shown.

One function per result builds its `Document`; a renderer each for terminal (`present.terminal`), HTML page
(`present.html_page`) and window (`window.widgets`) shows any document, and `--json` prints its `data`.

A block that holds nothing (a table without rows, a section without blocks) is shown nowhere, so that whoever builds a
document need not ask. Between backticks stands what is typed or is the name of a file.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import isfinite
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

from dragrig.analysis import UNKNOWN, rounded_to_error, value_with_error
from dragrig.present.numbers import NumberFormat, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

# The colours of all figures and of the window (Okabe and Ito), distinguishable with any kind of colour vision.
BLACK: Final = "#1A1A1A"
BLUE: Final = "#0072B2"
SKY: Final = "#56B4E9"
GREEN: Final = "#009E73"
ORANGE: Final = "#E69F00"
VERMILLION: Final = "#D55E00"
PURPLE: Final = "#B0578D"
GREY: Final = "#5F6670"
PALE: Final = "#A9B4C0"
PAPER: Final = "#FFFFFF"
GRID: Final = "#D3D9DF"

CYCLE: Final = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)
"""Colours of curves that stand side by side, in order."""


def tint(colour: str, share: float = 0.35, paper: str = PAPER) -> str:
    """Return a colour on paper as pale as if it covered a share of it; opaque, which is drawn much faster."""
    parts = ((int(colour[at : at + 2], 16), int(paper[at : at + 2], 16)) for at in (1, 3, 5))
    return "#" + "".join(f"{round(under + share * (part - under)):02X}" for part, under in parts)


@dataclass(frozen=True, slots=True)
class FormattedNumber:
    """A number whose digits depend on its error: how it is written, beside the value to sort by and to export."""

    value: float | None
    text: str

    @classmethod
    def rounded(cls, value: float | None, error: float | None) -> "FormattedNumber":
        """Return a number to the second digit of its error, for a column beside the error's."""
        return cls(value, rounded_to_error(value, error))

    @classmethod
    def with_error(cls, value: float | None, error: float | None) -> "FormattedNumber":
        """Return a number and its error, both to the error's second digit."""
        return cls(value, value_with_error(value, error))


Cell: TypeAlias = str | float | int | FormattedNumber | None
"""A word, a number in the column's unit, or None for what is not known."""

ItemT = TypeVar("ItemT")
FOUR_DIGITS = significant(4)


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name in a CSV file (unit included), its heading, and the format of its numbers."""

    name: str
    heading: str
    number_format: NumberFormat = FOUR_DIGITS


@dataclass(frozen=True, slots=True)
class Field(Generic[ItemT]):
    """A column of a table of items: what a `Column` has, and the cell that it takes from an item."""

    name: str
    heading: str
    cell: Callable[[ItemT], Cell]
    number_format: NumberFormat = FOUR_DIGITS


@dataclass(frozen=True, slots=True)
class RenderedCell:
    """A cell as it is shown: its text, its number to sort by ("" where there is none), the id that it links to."""

    text: str
    number: str = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table."""

    name: str
    """Id in the document, and stem of its CSV file."""
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    links: tuple[str, ...] = ()
    """Ids of the document that the rows' first cells lead to, "" for none; or nothing at all."""
    brief_rows: int | None = None
    """How many rows a terminal or a window shows; the page and the CSV file have all."""
    file: str = ""
    """The CSV file beside the page, where there is one."""

    @classmethod
    def of(
        cls,
        name: str,
        caption: str,
        items: Iterable[ItemT],
        *fields: Field[ItemT],
        brief_rows: int | None = None,
        links: tuple[str, ...] = (),
    ) -> "Table":
        """Return a table with a row for each item."""
        columns = tuple(Column(field.name, field.heading, field.number_format) for field in fields)
        rows = tuple(tuple(field.cell(item) for field in fields) for item in items)
        return cls(name, caption, columns, rows, links, brief_rows)

    @property
    def cells(self) -> tuple[tuple[RenderedCell, ...], ...]:
        """The rows as they are shown."""
        links = self.links or ("",) * len(self.rows)
        return tuple(
            tuple(
                _rendered(cell, column, link if place == 0 else "")
                for place, (cell, column) in enumerate(zip(row, self.columns, strict=True))
            )
            for row, link in zip(self.rows, links, strict=True)
        )

    @property
    def brief_cells(self) -> tuple[tuple[RenderedCell, ...], ...]:
        """The first `brief_rows` rows as they are shown."""
        return replace(self, rows=self.rows[: self.brief_rows], links=self.links[: self.brief_rows]).cells

    @property
    def omitted_text(self) -> str:
        """How many rows a brief table leaves out; "" for none."""
        omitted = 0 if self.brief_rows is None else len(self.rows) - self.brief_rows
        return f"and {omitted} more" if omitted > 0 else ""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Which columns hold numbers."""
        return tuple(
            any(isinstance(row[index], float | int | FormattedNumber) for row in self.rows)
            for index in range(len(self.columns))
        )

    def select(self, *names: str, caption: str = "") -> "Table":
        """Return the table with these columns only, in this order."""
        order = [[column.name for column in self.columns].index(name) for name in names]
        return replace(
            self,
            caption=caption or self.caption,
            columns=tuple(self.columns[index] for index in order),
            rows=tuple(tuple(row[index] for index in order) for row in self.rows),
        )

    def csv(self) -> str:
        """Return the table as CSV, numbers with all their digits and missing ones empty."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\r\n")
        writer.writerow([column.name for column in self.columns])
        writer.writerows([_exact_text(cell) for cell in row] for row in self.rows)
        return text.getvalue()

    def __bool__(self) -> bool:
        return bool(self.rows)


@dataclass(frozen=True, slots=True)
class BarPart:
    """A part of a bar; a hatched one is what is left over."""

    name: str
    share: float
    """Of the whole: its width."""
    size: str
    """Its share as it is written."""
    colour: str
    hatched: bool = False


@dataclass(frozen=True, slots=True)
class Bar:
    """A whole, cut into parts."""

    whole: str
    parts: tuple[BarPart, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """A figure."""

    name: str
    """Id in the document, and stem of its file."""
    shows: str
    """What is to be seen, for those who cannot see it."""
    caption: str
    """Stands below."""
    drawing: "Callable[[], MatplotlibFigure] | str"
    """Draws it when a renderer asks, so that matplotlib loads only there; or the SVG that was drawn already."""
    bars: tuple[Bar, ...] = ()
    """What a terminal shows in its place."""


SINGLE_COLUMN_MM: Final = 85.0
DOUBLE_COLUMN_MM: Final = 180.0
"""Widths of a column of a journal, and of two, that fit most (Elsevier 90 and 190, Springer 84 and 174, Nature 88 and
180 mm)."""


@dataclass(frozen=True, slots=True)
class FigureForm:
    """The form in which figures are drawn and written: for a screen, or for the column of a journal."""

    width_mm: float | None = None
    """Width in print. Such a figure has no title and no badge, which a journal wants in the caption, letters of 6 to
    7 pt, and 600 dpi. None: as wide as it was designed, for a screen.
    """
    suffix: str = ".png"
    """Ending of pictures whose names nobody chose."""
    badge: str = ""
    """Where the data come from, for figures that do not say so themselves."""


_ON_SCREEN: Final = FigureForm()
_FORM: ContextVar[FigureForm] = ContextVar("figure_form")


def current_figure_form() -> FigureForm:
    """Return the form in which figures are drawn now."""
    return _FORM.get(_ON_SCREEN)


@contextmanager
def figure_form(form: FigureForm) -> Iterator[None]:
    """Draw and write all figures of a block of code in a form."""
    token = _FORM.set(form)
    try:
        yield
    finally:
        _FORM.reset(token)


class TextKind(StrEnum):
    """What a paragraph is for."""

    STATEMENT = "statement"
    EXPLANATION = "explanation"
    """How to read what follows; for a page, which stands alone. Terminal and window leave it out."""
    CAUTION = "caution"
    """How far to trust the result."""
    QUOTATION = "quotation"
    """What somebody else says."""


@dataclass(frozen=True, slots=True)
class Text:
    """A paragraph."""

    text: str
    kind: TextKind = TextKind.STATEMENT

    def __bool__(self) -> bool:
        return bool(self.text)


@dataclass(frozen=True, slots=True)
class Items:
    """A list; `remarks` are what a reader must know beside the result. `brief` is how many a terminal shows."""

    items: tuple[str, ...]
    remarks: bool = False
    brief: int | None = None

    def __bool__(self) -> bool:
        return bool(self.items)


@dataclass(frozen=True, slots=True)
class Facts:
    """Names with their values, such as settings."""

    values: Mapping[str, str]

    def __bool__(self) -> bool:
        return any(self.values.values())


@dataclass(frozen=True, slots=True)
class Code:
    """What is typed, or a text that stands as it is."""

    text: str

    def __bool__(self) -> bool:
        return bool(self.text)


@dataclass(frozen=True, slots=True)
class Section:
    """Blocks under a heading."""

    name: str
    """Id in the document."""
    heading: str
    blocks: "tuple[Block, ...]"
    collapsed: bool = False
    """Whether a page folds it away; a terminal leaves it out."""
    note: str = ""
    """Stands in grey beside the heading of a collapsed section."""

    @property
    def content(self) -> "tuple[Block, ...]":
        """The blocks that hold something."""
        return tuple(block for block in self.blocks if block)

    @property
    def folds(self) -> bool:
        """Whether several sections in it are folded away, so that a page can open all of them at once."""
        return sum(isinstance(block, Section) and block.collapsed for block in self.content) > 1

    def __bool__(self) -> bool:
        return bool(self.content)


Block: TypeAlias = Text | Items | Facts | Code | Table | Figure | Section


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """A result, laid out once."""

    title: str
    """What this is: the page's title."""
    sections: tuple[Section, ...] = ()
    answer: str = ""
    """The sentence that matters most; the title where there is none."""
    lead: tuple[str, ...] = ()
    """Sentences that belong to the answer."""
    problem: str = ""
    """What makes the result doubtful, such as a run marked bad."""
    source: str = ""
    """The file or campaign, or what kind of document this is; stands above the answer."""
    badges: tuple[str, ...] = ()
    """Backends that the data come from."""
    data: Mapping[str, object] | Sequence[object] = field(default_factory=dict)
    """What `--json` prints, an object or a list, with exact numbers and keys that stay as they are."""

    @property
    def content(self) -> tuple[Section, ...]:
        """The sections that hold something."""
        return tuple(section for section in self.sections if section)

    @property
    def figure_form(self) -> FigureForm:
        """The form of its figures: the current one, with its badges."""
        return replace(current_figure_form(), badge=", ".join(self.badges))

    def figures(self) -> Iterator[Figure]:
        """Yield every figure, in order."""
        for block in _blocks_of(self.content):
            if isinstance(block, Figure):
                yield block

    def tables(self) -> Iterator[Table]:
        """Yield every table, in order."""
        for block in _blocks_of(self.content):
            if isinstance(block, Table):
                yield block

    def without(self, *names: str) -> "Document":
        """Return the document without the figures of these names."""
        return self._with_figures(figure for figure in self.figures() if figure.name not in names)

    def with_drawings(self, svg: Mapping[str, str]) -> "Document":
        """Return the document with its figures drawn: their SVG by name."""
        return self._with_figures(replace(figure, drawing=svg[figure.name]) for figure in self.figures())

    def _with_figures(self, figures: Iterable[Figure]) -> "Document":
        by_name = {figure.name: figure for figure in figures}
        return replace(self, sections=tuple(_with_figures(section, by_name) for section in self.content))


def _blocks_of(blocks: "tuple[Block, ...]") -> "Iterator[Block]":
    for block in blocks:
        yield block
        if isinstance(block, Section):
            yield from _blocks_of(block.content)


def _with_figures(section: Section, figures: Mapping[str, Figure]) -> Section:
    """Return a section with these figures in place of its own, by name, and without any other."""

    def blocks() -> Iterator[Block]:
        for block in section.content:
            if isinstance(block, Section):
                yield _with_figures(block, figures)
            elif not isinstance(block, Figure):
                yield block
            elif block.name in figures:
                yield figures[block.name]

    return replace(section, blocks=tuple(blocks()))


def _rendered(cell: Cell, column: Column, link: str) -> RenderedCell:
    match cell:
        case str():
            return RenderedCell(cell, "", link)
        case FormattedNumber():
            return RenderedCell(cell.text, _exact_text(cell), link)
        case None:
            return RenderedCell(UNKNOWN, "", link)
        case _:
            text = column.number_format(cell) if isfinite(cell) else UNKNOWN
            return RenderedCell(text, _exact_text(cell), link)


def _exact_text(cell: Cell) -> str:
    if isinstance(cell, FormattedNumber):
        cell = cell.value
    if cell is None or (isinstance(cell, float) and not isfinite(cell)):
        return ""
    return repr(float(cell)) if isinstance(cell, float) else str(cell)
