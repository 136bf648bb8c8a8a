"""A measurement as it stood in a foreign file: named columns of numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dragrig.analysis.importing.units import unit_of_name
from dragrig.config.errors import ImportDataError
from dragrig.config.loading import nearest
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class BadCell:
    """A cell that is not the number it should be."""

    row: int
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class ForeignColumn:
    """One column.

    Attributes
    ----------
    name
        As in the file.
    units
        As in the file: a row of units, brackets behind the name, or a property; empty when not said.
    values
        Shape `(N,)`, NaN where a cell is empty or says NaN.
    bad
        First cell that holds something else than a number; the values are then of no use.
    """

    name: str
    units: str
    values: FloatArray
    bad: BadCell | None = None

    @property
    def label(self) -> str:
        """Name without its unit."""
        return unit_of_name(self.name)[0]


@dataclass(frozen=True, slots=True, eq=False)
class ForeignTable:
    """All columns of a file, of the same length.

    Attributes
    ----------
    first_line
        Line of the file that holds the first row, where that is known; rows are counted otherwise.
    lines
        Line of each row, where empty lines stand between rows.
    sample_rate_hz
        Where the file itself says how often it sampled.
    preamble
        Lines before the table.
    export
        Metadata of a run that this software exported.
    """

    path: Path
    columns: tuple[ForeignColumn, ...]
    lines: tuple[int, ...] | range | None = None
    sample_rate_hz: float | None = None
    preamble: tuple[str, ...] = ()
    export: Mapping[str, object] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(self.columns[0].values) if self.columns else 0

    def place(self, row: int) -> str:
        """Say where a row (from 0) stands: its line, or its number where there are no lines."""
        return f"line {self.lines[row]}" if self.lines is not None else f"row {row + 1}"

    def column(self, wanted: str | int) -> ForeignColumn:
        """Find a column by its name, its label without the unit, or its number from 1.

        Raises
        ------
        ImportDataError
            When there is none; the nearest names are said.
        """
        name = str(wanted).strip()
        exact = [one for one in self.columns if one.name == name]
        folded = [one for one in self.columns if name.casefold() in {one.name.casefold(), one.label.casefold()}]
        if exact or len(folded) == 1:
            return (exact or folded)[0]
        if len(folded) > 1:
            raise ImportDataError(
                f"{self.path}: {name!r} could be {' or '.join(repr(one.name) for one in folded)}; give the full name."
            )
        if name.isdecimal() and 1 <= int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        names = [one.name for one in self.columns]
        raise ImportDataError(f"{self.path}: there is no column {name!r}; {nearest(name, names)}")

    def numbers(self, column: ForeignColumn, *, whole: bool) -> FloatArray:
        """Return a column's values after making sure that they are numbers.

        Parameters
        ----------
        whole
            Whether a missing value is an error too.

        Raises
        ------
        ImportDataError
            When a cell holds text, or `whole` and a value is missing.
        """
        if column.bad is not None:
            raise ImportDataError(
                f"{self.path}: {self.place(column.bad.row)}, column {column.name!r} holds {column.bad.text!r:.40} "
                "instead of a number; correct it, or map another column."
            )
        if whole and not _all_finite(column.values):
            row = _first_not_finite(column.values)
            raise ImportDataError(
                f"{self.path}: {self.place(row)}, column {column.name!r} has no number (empty, NaN or infinite); "
                "leave such rows out, so that they become a gap."
            )
        return column.values


def _all_finite(values: FloatArray) -> bool:
    import numpy as np

    return bool(np.isfinite(values).all())


def _first_not_finite(values: FloatArray) -> int:
    import numpy as np

    return int(np.isfinite(values).argmin())
