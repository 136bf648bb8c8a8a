"""Tables and figures of a result, with the digits of their numbers, independent of where they are shown.

A `Table` is shown rounded to a reader and exported to CSV with every digit. A number with a known error is rounded to
the second digit of that error.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import floor, isfinite, log10

from markupsafe import Markup

from dragrig.analysis.estimates import Estimate, EstimatedQuantity
from dragrig.analysis.paper.published import percent, rounded

Cell = str | float | int | None
"""What stands in a cell: a word, a number in the column's unit, or nothing."""


def significant(count: int) -> Callable[[float], str]:
    """Return what spells a number to so many significant digits."""
    return lambda value: rounded(value, count)


def four_significant(value: float) -> str:
    """Spell a number to four significant digits."""
    return rounded(value, 4)


def general_format(value: float) -> str:
    """Spell a number with the digits that it has: 0.5, 11."""
    return f"{value:g}".replace("-", "−")


def three_significant(value: float) -> str:
    """Spell a number with three digits at most: 0.5, 20, 33.3."""
    return f"{value:.3g}".replace("-", "−")


def decimals(count: int) -> Callable[[float], str]:
    """Return what spells a number to so many decimal places."""
    return lambda value: f"{value:.{count}f}".replace("-", "−")


def percent_difference(value: float) -> str:
    """Spell a relative difference in per cent, with its sign."""
    return percent(value, 1 if abs(value) < 0.0095 else 2)


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name in the CSV file (unit included), its heading, and how its numbers are spelled."""

    name: str
    heading: str
    spell: Callable[[float], str] = four_significant


@dataclass(frozen=True, slots=True)
class RenderedCell:
    """A cell as a page has it: its words, its number for sorting ("" where there is none), what it links to."""

    text: str
    number: str = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    Attributes
    ----------
    name
        Stem of its CSV file.
    links
        Ids of the page that the rows' first cells lead to, "" for none; or nothing at all.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    links: tuple[str, ...] = ()

    @property
    def spelled(self) -> tuple[tuple[str, ...], ...]:
        """The rows as a reader sees them."""
        return tuple(
            tuple(_rounded_text(cell, column) for cell, column in zip(row, self.columns, strict=True))
            for row in self.rows
        )

    @property
    def cells(self) -> tuple[tuple[RenderedCell, ...], ...]:
        """The rows as a page has them."""
        links = self.links or ("",) * len(self.rows)
        return tuple(
            tuple(
                RenderedCell(text, "" if isinstance(cell, str) else _exact_text(cell), link if place == 0 else "")
                for place, (text, cell) in enumerate(zip(spelled, row, strict=True))
            )
            for spelled, row, link in zip(self.spelled, self.rows, links, strict=True)
        )

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Which columns hold numbers."""
        return tuple(
            any(isinstance(row[index], float | int) for row in self.rows) for index in range(len(self.columns))
        )

    def csv(self) -> str:
        """Return the table as CSV, numbers with all their digits and missing ones empty."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\r\n")
        writer.writerow([column.name for column in self.columns])
        writer.writerows([_exact_text(cell) for cell in row] for row in self.rows)
        return text.getvalue()


def _rounded_text(cell: Cell, column: Column) -> str:
    if isinstance(cell, str):
        return cell
    if cell is None or not isfinite(cell):
        return "–"
    return column.spell(cell)


def _exact_text(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and not isfinite(cell)):
        return ""
    return repr(float(cell)) if isinstance(cell, float) else str(cell)


DIGITS_WITHOUT_ERROR = 4
"""Digits of a number whose error is not known."""
MAX_DECIMALS = 9


def rounded_to_error(value: float | None, error: float | None) -> str:
    """Spell a number to the second digit of its error; `-` where there is no number."""
    if value is None or not isfinite(value):
        return "-"
    return f"{value:.{_decimals(error)}f}" if _is_positive(error) else f"{value:.{DIGITS_WITHOUT_ERROR}g}"


def error_text(error: float | None) -> str:
    """Spell an error with two digits; nothing where it is not known."""
    if error is None or not isfinite(error):
        return ""
    return f"{error:.{_decimals(error)}f}" if _is_positive(error) else f"{error:.2g}"


def interval_text(quantity: EstimatedQuantity) -> str:
    """Spell the 95 % interval to the second digit of the error: 3.242 to 3.290."""
    return range_text(quantity.interval, quantity.standard_error)


def range_text(interval: tuple[float, float] | None, error: float | None) -> str:
    """Spell an interval; nothing where it is not known."""
    if interval is None or not all(isfinite(one) for one in interval):
        return ""
    return " to ".join(rounded_to_error(one, error) for one in interval)


def estimate_cells(estimate: Estimate) -> tuple[str, str]:
    """Spell an estimate and its standard error for two columns; a missing one by the reason."""
    if estimate.value is None:
        return f"- ({estimate.reason})" if estimate.reason else "-", ""
    return rounded_to_error(estimate.value, estimate.standard_error), error_text(estimate.standard_error)


def unit_text(unit: str) -> str:
    """Spell a unit for a table: nothing for a pure number."""
    return "" if unit == "1" else unit


def p_value_text(p_value: float) -> str:
    """Spell a probability: p = 0.39, p < 0.0001."""
    return "p < 0.0001" if p_value < 1e-4 else f"p = {p_value:.2g}"


def _is_positive(error: float | None) -> bool:
    return error is not None and isfinite(error) and error > 0


def _decimals(error: float | None) -> int:
    if error is None or not _is_positive(error):
        return 0
    return min(max(0, 1 - floor(log10(error))), MAX_DECIMALS)


@dataclass(frozen=True, slots=True)
class InlineFigure:
    """A figure of a page.

    Attributes
    ----------
    svg
        The drawing, an element of the page; it says what it shows to those who cannot see it.
    caption
        What stands below.
    glyphs
        Letters that the drawing refers to, by id; a page has each of them once.
    """

    svg: Markup
    caption: str
    glyphs: Mapping[str, str]


def shared_glyphs(pictures: Iterable[InlineFigure]) -> Markup:
    """Return the letters of several drawings, each once."""
    together = {name: path for picture in pictures for name, path in picture.glyphs.items()}
    return Markup("".join(together.values()))  # noqa: S704  # serialised by ElementTree
