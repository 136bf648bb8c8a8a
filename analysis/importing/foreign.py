"""A measurement as a foreign file holds it: tables of named columns of numbers with their units."""

import re
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from dragrig.analysis.importing.units import split_unit
from dragrig.config import ImportDataError, suggestion
from dragrig.rig import FloatArray

SCPI_OVERLOAD = (9.9e37, 9.92e37)
"""Range of what instruments send for infinity and for no number (SCPI-99, 7.2)."""


@dataclass(frozen=True, slots=True)
class InvalidCell:
    """A cell that is not a number; `row` counts from 0."""

    row: int
    text: str

    def within(self, rows: slice) -> "InvalidCell | None":
        """Return the cell as counted from the first of some rows; None where it is not among them."""
        first, end, _ = rows.indices(self.row + 1)
        return InvalidCell(self.row - first, self.text) if first <= self.row < end else None


@dataclass(frozen=True, slots=True, eq=False)
class ForeignColumn:
    """One column."""

    name: str
    """As in the file."""
    units: str
    """As in the file: a row of units, brackets after the name, or a property; empty when not stated."""
    values: FloatArray
    """Shape `(N,)`, NaN where a cell is empty or says NaN."""
    bad: InvalidCell | None = None
    """First cell that is neither empty nor a number; the values are NaN there."""
    begins_at: datetime | None = None
    """Of a column of dates and times, which hold seconds since the first one: when that was."""
    remarks: tuple[str, ...] = ()
    """How ambiguous cells were read."""

    @property
    def label(self) -> str:
        """Name without its unit."""
        return split_unit(self.name)[0]


@dataclass(frozen=True, slots=True, eq=False)
class ForeignTable:
    """A table of a file: columns of the same length."""

    path: Path
    columns: tuple[ForeignColumn, ...]
    lines: tuple[int, ...] | range | None = None
    """Line of the file for each row, counted from 1; None for binary files."""
    sample_rate_hz: float | None = None
    """Where the file states it."""
    preamble: tuple[str, ...] = ()
    """Lines before the table."""
    name: str = ""
    """Sheet, group, variable or block that the table is."""
    begins_at: datetime | None = None
    """When the first row was measured, where the file states it beside the table; with a time zone."""
    remarks: tuple[str, ...] = ()
    """Content of the file that is in no table, and how ambiguous content was read."""

    @property
    def shape(self) -> tuple[tuple[str, str], ...]:
        """Labels and units, by which tables of equal structure are told."""
        return tuple((column.label, column.units) for column in self.columns)

    def sliced(self, rows: slice) -> "ForeignTable":
        """Return some rows of the table."""
        columns = tuple(
            replace(column, values=column.values[rows], bad=column.bad and column.bad.within(rows))
            for column in self.columns
        )
        return replace(self, columns=columns, lines=None if self.lines is None else self.lines[rows])

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.columns[0].values) if self.columns else 0

    def place(self, row: int) -> str:
        """Name a row (from 0) for a message: its line in the file, or its number from 1."""
        return f"line {self.lines[row]}" if self.lines is not None else f"row {row + 1}"

    def column(self, wanted: str | int) -> ForeignColumn:
        """Find a column by its name, its label without the unit, or its number from 1.

        Raises `ImportDataError` when there is none, naming the nearest, or the name is ambiguous.
        """
        name = str(wanted).strip()
        exact = [column for column in self.columns if column.name == name]
        folded = [
            column for column in self.columns if name.casefold() in {column.name.casefold(), column.label.casefold()}
        ]
        found = exact or folded
        if len(found) == 1:
            return found[0]
        if found:
            numbers = [[known is column for known in self.columns].index(True) + 1 for column in found]
            places = " or ".join(f"{column.name!r} (number {at})" for column, at in zip(found, numbers, strict=True))
            raise ImportDataError(f"{self.path}: {name!r} could be {places}; give the full name, or the number.")
        if name.isdecimal() and 1 <= int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        unread = re.compile(rf"^(table )?'(.+\.)?{re.escape(name)}' ")
        if told := next(filter(unread.match, self.remarks), None):
            raise ImportDataError(f"{self.path}: {told}.")
        names = [column.name for column in self.columns]
        raise ImportDataError(f"{self.path}: there is no column {name!r}; {suggestion(name, names)}")

    def require_numbers(self, column: ForeignColumn, *, throughout: bool) -> None:
        """Raise `ImportDataError` for a column of text, or one with any text if it must be of numbers `throughout`."""
        if column.bad is not None and (throughout or 2 * np.isfinite(column.values).sum() < self.rows):
            raise ImportDataError(
                f"{self.path}: {self.place(column.bad.row)}, column {column.name!r} holds {column.bad.text!r:.40} "
                "instead of a number; correct it, map another column, or leave such rows out (--missing gap)."
            )

    def numbers(self, column: ForeignColumn, *, whole: bool) -> FloatArray:
        """Return a column's values, making sure that they are numbers.

        Parameters
        ----------
        whole
            Whether a missing value is an error too.

        Raises
        ------
        ImportDataError
            When a cell holds text, or `whole` and a value is missing.
        """
        self.require_numbers(column, throughout=whole)
        low, high = SCPI_OVERLOAD
        size = np.abs(column.values)
        finite = np.isfinite(size) & ~((low <= size) & (size < high))
        if whole and not finite.all():
            raise ImportDataError(
                f"{self.path}: {self.place(int(finite.argmin()))}, column {column.name!r} has no number (empty, NaN, "
                "infinite or overload); leave such rows out, so that they become a gap (--missing gap)."
            )
        return column.values if finite.all() else np.where(finite, column.values, np.nan)
