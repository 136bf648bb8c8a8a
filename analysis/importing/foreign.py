"""A measurement as a foreign file holds it: named columns of numbers, and their units."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import ImportDataError
from dragrig.config.settings import suggestion
from dragrig.rig.arrays import FloatArray

STANDARD_GRAVITY = 9.80665
"""[m/s²]; turns gram-force into millinewtons."""

TARGET_UNITS: Mapping[str, str] = {
    "time": "s",
    "force": "mN",
    "position": "mm",
    "command": "mm",
    "motor_force": "mN",
    "temperature": "degC",
}
"""Quantities of a run file that a column can be mapped to, with the unit it is stored in."""

CONVERTIBLE_UNITS: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "min": 60.0, "h": 3600.0},
    "mN": {"mN": 1.0, "N": 1e3, "kN": 1e6, "µN": 1e-3, "gf": STANDARD_GRAVITY, "kgf": 1e3 * STANDARD_GRAVITY,
           "lbf": 4448.2216152605},
    "mm": {"mm": 1.0, "µm": 1e-3, "nm": 1e-6, "cm": 10.0, "m": 1e3, "in": 25.4},
    "degC": {"degC": 1.0, "K": 1.0, "degF": 5 / 9},
}  # fmt: skip
"""For each stored unit, the factor of every unit that converts to it."""
_OFFSETS = {"K": -273.15, "degF": -32 * 5 / 9}

OTHER_UNITS = ("mV", "V", "mA", "A", "rad", "deg", "rev", "counts", "1", "%", "MPa", "kPa", "Pa", "bar", "rad/s",
               "mm/s", "m/s", "µm/s", "rpm", "Hz", "Nm", "W", "g", "kg")  # fmt: skip
"""Units of other quantities, which only a factor stated by the user converts."""

_SPELLINGS = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "us": "µs", "usec": "µs", "minutes": "min",
    "hours": "h", "um": "µm", "micron": "µm", "microns": "µm", "micrometer": "µm", "inch": "in", "newton": "N",
    "newtons": "N", "un": "µN", "kg-f": "kgf", "kp": "kgf", "g-f": "gf", "pond": "gf", "°c": "degC", "c": "degC",
    "celsius": "degC", "deg c": "degC", "°f": "degF", "kelvin": "K", "volt": "V", "volts": "V", "ampere": "A",
    "amps": "A", "radian": "rad", "radians": "rad", "°": "deg", "degree": "deg", "degrees": "deg", "turns": "rev",
    "count": "counts", "cts": "counts", "-": "1", "percent": "%", "u/min": "rpm",
}  # fmt: skip
_EXACT = {unit for units in CONVERTIBLE_UNITS.values() for unit in units} | set(OTHER_UNITS)
# Case decides between milli and mega: MN or mpa is ambiguous, and not understood.
_FOLDED = {unit.lower(): unit for unit in _EXACT - {"mN", "MPa"}} | _SPELLINGS

_NAME_WITH_UNIT = (
    r"(?P<label>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*",
    r"(?P<label>.+?)\s*[/,]\s*(?P<unit>\S+)",
    r"(?P<label>.+)_(?P<unit>[^_]+)",
)


@dataclass(frozen=True, slots=True)
class UnitScale:
    """Converts a column to the stored unit: `values * factor + offset`."""

    factor: float = 1.0
    offset: float = 0.0

    def apply(self, values: npt.ArrayLike) -> FloatArray:
        """Return the values in the stored unit; the identity leaves every bit as it is."""
        array = np.asarray(values, dtype=np.float64)
        return array if self == UnitScale() else array * self.factor + self.offset


def canonical_unit(text: str) -> str | None:
    """Return the standard spelling of a unit; None for an unknown one."""
    plain = text.strip().replace("μ", "µ").strip("[](){}").strip()  # the Greek letter and the micro sign look alike
    return plain if plain in _EXACT else _FOLDED.get(plain.lower())


def unit_scale(quantity: str, unit: str, factor: float | None, offset: float) -> UnitScale:
    """Return how a column in `unit` becomes a quantity of the run file.

    Parameters
    ----------
    factor
        Multiplies besides the unit's own factor; required for a unit of another quantity, where it is the number of
        stored units per unit of the column.

    Raises
    ------
    ImportDataError
        When the unit is unknown, or of another quantity and no factor is given.
    """
    target = TARGET_UNITS[quantity]
    convertible = CONVERTIBLE_UNITS[target]
    standard = canonical_unit(unit)
    if standard is not None and standard in convertible:
        stated = 1.0 if factor is None else factor
        return UnitScale(convertible[standard] * stated, _OFFSETS.get(standard, 0.0) * stated + offset)
    if factor is not None:
        return UnitScale(factor, offset)
    allowed = ", ".join(convertible)
    if standard is None:
        raise ImportDataError(
            f"{quantity} in {unit!r} is not understood; allowed are {allowed}, or any other unit with a factor, as in "
            f"{quantity}=COLUMN:{unit or 'UNIT'}*12.5 for 12.5 {target} per {unit or 'UNIT'}"
        )
    raise ImportDataError(
        f"{quantity} in {standard} needs a factor, as in {quantity}=COLUMN:{standard}*12.5 for 12.5 {target} per "
        f"{standard}; without one allowed are {allowed}"
    )


def split_unit(name: str) -> tuple[str, str | None]:
    """Split a column's name such as `Load [N]`, `Time(s)`, `Weg / mm`, `force_mN` or `v_mm_s` into label and unit."""
    quotient = re.fullmatch(r"(?P<label>.+)_(?P<above>[^_]+)_(?P<below>s|s2)", name)
    if quotient and (unit := canonical_unit(f"{quotient['above']}/{quotient['below']}")):
        return quotient["label"], unit
    for pattern in _NAME_WITH_UNIT:
        match = re.fullmatch(pattern, name)
        if match and (unit := canonical_unit(match["unit"])) is not None:
            return match["label"].strip(), unit
    return name, None


@dataclass(frozen=True, slots=True)
class InvalidCell:
    """A cell that is not a number; `row` counts from 0."""

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
        As in the file: a row of units, brackets after the name, or a property; empty when not stated.
    values
        Shape `(N,)`, NaN where a cell is empty or says NaN.
    bad
        First cell that is not a number; the values are then all NaN.
    """

    name: str
    units: str
    values: FloatArray
    bad: InvalidCell | None = None

    @property
    def label(self) -> str:
        """Name without its unit."""
        return split_unit(self.name)[0]


@dataclass(frozen=True, slots=True, eq=False)
class ForeignTable:
    """All columns of a file, of the same length.

    Attributes
    ----------
    lines
        Line of the file for each row, counted from 1; None for binary files.
    sample_rate_hz
        Where the file states it.
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
        """Number of rows."""
        return len(self.columns[0].values) if self.columns else 0

    def place(self, row: int) -> str:
        """Name a row (from 0) for a message: its line in the file, or its number from 1."""
        return f"line {self.lines[row]}" if self.lines is not None else f"row {row + 1}"

    def column(self, wanted: str | int) -> ForeignColumn:
        """Find a column by its name, its label without the unit, or its number from 1.

        Raises
        ------
        ImportDataError
            When there is none, naming the nearest, or the name is ambiguous.
        """
        name = str(wanted).strip()
        exact = [column for column in self.columns if column.name == name]
        folded = [
            column for column in self.columns if name.casefold() in {column.name.casefold(), column.label.casefold()}
        ]
        if exact or len(folded) == 1:
            return (exact or folded)[0]
        if len(folded) > 1:
            raise ImportDataError(
                f"{self.path}: {name!r} could be {' or '.join(repr(column.name) for column in folded)}; "
                "give the full name."
            )
        if name.isdecimal() and 1 <= int(name) <= len(self.columns):
            return self.columns[int(name) - 1]
        names = [column.name for column in self.columns]
        raise ImportDataError(f"{self.path}: there is no column {name!r}; {suggestion(name, names)}")

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
        if column.bad is not None:
            raise ImportDataError(
                f"{self.path}: {self.place(column.bad.row)}, column {column.name!r} holds {column.bad.text!r:.40} "
                "instead of a number; correct it, or map another column."
            )
        finite = np.isfinite(column.values)
        if whole and not finite.all():
            raise ImportDataError(
                f"{self.path}: {self.place(int(finite.argmin()))}, column {column.name!r} has no number (empty, NaN or "
                "infinite); remove such rows, so that they become a gap."
            )
        return column.values
