"""Tables that stand in a page, rounded for a reader, and in a CSV file with every digit."""

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

from dragrig.analysis.paper.finding import percent, spelled

Cell = str | float | int | None
"""What stands in a cell: a word, a number in the column's unit, or nothing."""


def digits(count: int) -> Callable[[float], str]:
    """Return what spells a number to so many significant digits."""
    return lambda value: spelled(value, count)


def four_digits(value: float) -> str:
    """Spell a number to four significant digits."""
    return spelled(value, 4)


def plainly(value: float) -> str:
    """Spell a number with the digits that it has: 0.5, 11."""
    return f"{value:g}".replace("-", "−")


def briefly(value: float) -> str:
    """Spell a number with three digits at most: 0.5, 20, 33.3."""
    return f"{value:.3g}".replace("-", "−")


def places(count: int) -> Callable[[float], str]:
    """Return what spells a number to so many decimal places."""
    return lambda value: f"{value:.{count}f}".replace("-", "−")


def share(value: float) -> str:
    """Spell a relative difference in per cent, with its sign."""
    return percent(value, 1 if abs(value) < 0.0095 else 2)


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its name in the CSV file (unit included), its heading, and how its numbers are spelled."""

    name: str
    heading: str
    spell: Callable[[float], str] = four_digits


@dataclass(frozen=True, slots=True)
class ShownCell:
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
            tuple(_spelled(cell, column) for cell, column in zip(row, self.columns, strict=True)) for row in self.rows
        )

    @property
    def cells(self) -> tuple[tuple[ShownCell, ...], ...]:
        """The rows as a page has them."""
        links = self.links or ("",) * len(self.rows)
        return tuple(
            tuple(
                ShownCell(text, "" if isinstance(cell, str) else _plain(cell), link if place == 0 else "")
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
        writer.writerows([_plain(cell) for cell in row] for row in self.rows)
        return text.getvalue()


def _spelled(cell: Cell, column: Column) -> str:
    if isinstance(cell, str):
        return cell
    if cell is None or not isfinite(cell):
        return "–"
    return column.spell(cell)


def _plain(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and not isfinite(cell)):
        return ""
    return repr(float(cell)) if isinstance(cell, float) else str(cell)
