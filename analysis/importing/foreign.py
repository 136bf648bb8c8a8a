"""A measurement as a foreign file holds it, and the user's settings of its import.

Named columns of numbers with their units; which column is which quantity, how the file is written, what the run was.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from math import pi
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError, field_validator, model_validator

from dragrig.config import Fixture, ImportDataError, Moment, Settings, describe_validation_error, suggestion
from dragrig.rig import FloatArray

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

ROTARY_UNITS: Mapping[str, Mapping[str, float]] = {
    "mm": {"rad": 1.0, "deg": pi / 180, "rev": 2 * pi},
    "mN": {"Nm": 1e6, "Ncm": 1e4, "mNm": 1e3},
}
"""Units of a turning rig: an angle is multiplied by the radius [mm], a torque divided by it."""

OTHER_UNITS = ("mV", "V", "mA", "A", "rad", "deg", "rev", "counts", "1", "%", "MPa", "kPa", "Pa", "bar", "rad/s",
               "mm/s", "m/s", "µm/s", "rpm", "Hz", "Nm", "Ncm", "mNm", "W", "g", "kg")  # fmt: skip
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


def unit_scale(
    quantity: str, unit: str, factor: float | None, offset: float, radius_mm: float | None = None
) -> UnitScale:
    """Return how a column in `unit` becomes a quantity of the run file.

    Parameters
    ----------
    factor
        Multiplies besides the unit's own factor; required for a unit of another quantity, where it is the number of
        stored units per unit of the column.
    radius_mm
        Of a turning rig: converts angles to travels, and torques to forces.

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
    rotary = ROTARY_UNITS.get(target, {}).get(standard or "")
    if factor is None and rotary is not None and radius_mm is not None:
        return UnitScale(rotary * radius_mm if target == "mm" else rotary / radius_mm, offset)
    if factor is not None:
        return UnitScale(factor, offset)
    allowed = ", ".join(convertible)
    if standard is None:
        raise ImportDataError(
            f"{quantity} in {unit!r} is not understood; allowed are {allowed}, or any other unit with a factor, as in "
            f"{quantity}=COLUMN:{unit or 'UNIT'}*12.5 for 12.5 {target} per {unit or 'UNIT'}"
        )
    turning = ", or the radius of a turning rig (--radius-mm)" if rotary is not None else ""
    raise ImportDataError(
        f"{quantity} in {standard} needs a factor, as in {quantity}=COLUMN:{standard}*12.5 for 12.5 {target} per "
        f"{standard}{turning}; without one allowed are {allowed}"
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
    """One column."""

    name: str
    """As in the file."""
    units: str
    """As in the file: a row of units, brackets after the name, or a property; empty when not stated."""
    values: FloatArray
    """Shape `(N,)`, NaN where a cell is empty or says NaN."""
    bad: InvalidCell | None = None
    """First cell that is not a number; the values are then all NaN."""
    begins_at: datetime | None = None
    """Of a column of dates and times, which hold seconds since the first one: when that was."""

    @property
    def label(self) -> str:
        """Name without its unit."""
        return split_unit(self.name)[0]


@dataclass(frozen=True, slots=True, eq=False)
class ForeignTable:
    """All columns of a file, of the same length."""

    path: Path
    columns: tuple[ForeignColumn, ...]
    lines: tuple[int, ...] | range | None = None
    """Line of the file for each row, counted from 1; None for binary files."""
    sample_rate_hz: float | None = None
    """Where the file states it."""
    preamble: tuple[str, ...] = ()
    """Lines before the table."""
    export: Mapping[str, object] = field(default_factory=dict)
    """Metadata of a run that this software exported."""

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


_UNIT_PATTERN = re.compile(
    r"(?P<unit>[^*+]*?)\s*(\*\s*(?P<factor>[-+]?[\d.]+(e[-+]?\d+)?))?\s*(?P<offset>[-+]\s*[\d.]+(e[-+]?\d+)?)?", re.I
)


class ColumnSource(Settings):
    """A column of the foreign file, and its conversion: `value * factor + offset`."""

    column: str | int
    """Name, name without its unit, or number from 1."""
    unit: str = ""
    """Unit of the column; default: as the file states."""
    factor: float | None = None
    """Multiplies besides the unit's own factor; required for a unit of another quantity (mV, rad, A, 1)."""
    offset: float = 0.0
    """Added at the end, in mN, mm, s or degC."""

    @field_validator("factor")
    @classmethod
    def _not_zero(cls, factor: float | None) -> float | None:
        if factor == 0:
            raise ValueError("a factor of 0 would erase the data")
        return factor


class ColumnMap(Settings):
    """Which column is which quantity. Columns that are not mapped become further channels."""

    time: ColumnSource | None = None
    force: ColumnSource | None = None
    position: ColumnSource | None = None
    command: ColumnSource | None = None
    motor_force: ColumnSource | None = None
    temperature: ColumnSource | None = None

    def mapped(self) -> dict[str, ColumnSource]:
        """Return what is mapped, by quantity."""
        sources = {name: getattr(self, name) for name in TARGET_UNITS}
        return {name: source for name, source in sources.items() if source is not None}


class ImportSettings(Settings):
    """All settings of an import; empty means: as the file states, or as detected."""

    columns: ColumnMap = ColumnMap()
    encoding: str = ""
    delimiter: str = Field(default="", max_length=1)
    """Comma, semicolon, tab, bar; a space for any white space."""
    decimal: Literal["", ".", ","] = ""
    header_lines: int | None = Field(default=None, ge=0)
    """Lines before the first row of numbers; the last of them hold names and perhaps units."""
    table: str = ""
    """Variable or struct of a MAT file, group of a TDMS file, sheet of a workbook; the largest table when empty."""
    radius_mm: float | None = Field(default=None, gt=0)
    """Of a turning rig: angles become travels at this radius, and torques forces."""
    split_at: Literal["", "rests"] = ""
    """Make a run of each motion of a long record, cut in the middle of the rests between them."""
    sample_rate_hz: float | None = Field(default=None, gt=0)
    """Rows are evenly spaced at this rate; time stamps then only have to agree with it in their span."""
    resample_hz: float | None = Field(default=None, gt=0)
    """Rate to which rows at uneven times are interpolated; default: no interpolation."""
    tolerance: float = Field(default=0.1, gt=0, lt=0.5)
    """Allowed distance of a time stamp from the even grid, in sample periods."""
    steady: bool = False
    """The stage was commanded at a constant speed that the file does not hold: a straight line through the position is
    taken as the command."""
    from_s: float | None = None
    """Ignore rows before this time, as the file counts it."""
    to_s: float | None = None
    """Ignore rows after this time."""
    kind: str = Field(default="motion", pattern=r"^[a-z][a-z0-9_-]*$")
    protocol: dict[str, str | float | int | bool] = Field(default_factory=dict)
    """The motion as far as known, by the run file's names: speed_mm_s, travel_mm, …."""
    specimen: str = ""
    """Its name (default: that of the file), or a TOML file of a specimen."""
    wall_thickness_mm: float | None = Field(default=None, gt=0, le=20)
    capsule: str = ""
    """Name or file of the capsule dummy."""
    fixture: Fixture | None = None
    """What held the gut; where a capsule is stated, by default what holds it in runs of this kind."""
    insertion_dwell_s: float | None = Field(default=None, ge=0)
    """How long the capsule had been in the gut at the first sample."""
    operator: str = ""
    note: str = ""
    order: int = Field(default=0, ge=0)
    start_time: Moment | None = None
    """When the first row was measured. Default: not known; the time of the file's last change stands in its place."""

    @model_validator(mode="after")
    def _consistent(self) -> "ImportSettings":
        if self.sample_rate_hz is not None and self.resample_hz is not None:
            raise ValueError("sample_rate_hz says that rows are evenly spaced, resample_hz that they are not; give one")
        if self.from_s is not None and self.to_s is not None and self.from_s >= self.to_s:
            raise ValueError("from_s must come before to_s")
        if self.steady and self.columns.mapped() and (self.columns.command or not self.columns.position):
            raise ValueError("steady makes a command of the position; map a position and no command")
        if self.delimiter and self.delimiter == self.decimal:
            raise ValueError("decimal mark and delimiter are the same, so that columns cannot be told apart")
        return self


def parse_map(assignments: Iterable[str]) -> ColumnMap:
    """Parse column maps of the form `QUANTITY=COLUMN[:UNIT[*FACTOR][+OFFSET]]`, each quantity once.

    `force="Load (N)":N`, `force=3:mV*12.5`, `force=Friction:1*1000`, `position="Pos":rad*5`. A column name
    with a colon is put into quotes.

    Raises `ImportDataError` when a map is not of this form, or its quantity is unknown.
    """
    sources: dict[str, object] = {}
    for text in assignments:
        quantity, equals, source = (part.strip() for part in text.partition("="))
        if not equals or not source:
            raise ImportDataError(f"--map {text}: is not of the form QUANTITY=COLUMN:UNIT, as in force=Load:N.")
        if quantity not in TARGET_UNITS:
            raise ImportDataError(
                f"--map {text}: {quantity!r} is not a quantity; {suggestion(quantity, list(TARGET_UNITS))}"
            )
        if quantity in sources:
            raise ImportDataError(f"--map {text}: {quantity} is mapped twice; map it once.")
        sources[quantity] = _parse_source(text, source)
    try:
        return ColumnMap.model_validate(sources)
    except ValidationError as error:
        raise ImportDataError(describe_validation_error(error, ColumnMap, "--map")) from error


def _parse_source(text: str, source: str) -> dict[str, object]:
    quoted = re.fullmatch(r"(?P<quote>[\"'])(?P<column>.+)(?P=quote)\s*(:(?P<unit>.*))?", source)
    if quoted:
        column, unit = quoted["column"], quoted["unit"] or ""
    else:
        column, colon, unit = source.rpartition(":")
        column, unit = (column, unit) if colon else (source, "")
    parts = _UNIT_PATTERN.fullmatch(unit.strip())
    if parts is None or not column.strip():
        raise ImportDataError(f"--map {text}: {unit!r} is not of the form UNIT, UNIT*FACTOR or UNIT*FACTOR+OFFSET.")
    try:
        factor = float(parts["factor"]) if parts["factor"] else None
        offset = float(parts["offset"].replace(" ", "")) if parts["offset"] else 0.0
    except ValueError:
        raise ImportDataError(f"--map {text}: {unit!r} holds a number that cannot be read.") from None
    return {"column": column.strip(), "unit": parts["unit"].strip(), "factor": factor, "offset": offset}


def guess_columns(table: ForeignTable) -> ColumnMap:
    """Map the columns that are named like a quantity and state a unit that converts to it: `force_N`, `Time (ms)`."""
    sources: dict[str, ColumnSource] = {}
    for quantity, target in TARGET_UNITS.items():
        columns = [column for column in table.columns if column.label.casefold() == quantity and column.bad is None]
        if len(columns) == 1 and canonical_unit(columns[0].units) in CONVERTIBLE_UNITS[target]:
            sources[quantity] = ColumnSource(column=columns[0].name, unit=columns[0].units)
    return ColumnMap.model_validate(sources)
