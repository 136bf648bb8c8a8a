"""The user's settings of an import: which column is which quantity, how the file is written, facts of the run."""

import re
from collections.abc import Iterable
from typing import Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from dragrig.analysis import DELIMITERS
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.units import CONVERTIBLE_UNITS, TARGET_UNITS, canonical_unit
from dragrig.config import Fixture, ImportDataError, Moment, Settings, describe_validation_error, suggestion

_UNIT_PATTERN = re.compile(
    r"(?P<unit>[^*+]*?)\s*(\*\s*(?P<factor>[-+]?[\d.]+(e[-+]?\d+)?))?\s*(?P<offset>[-+]\s*[\d.]+(e[-+]?\d+)?)?", re.I
)
_STROKES_PER_RUN = {"": 0, "rests": 0, "reversals": 1, "cycles": 2}


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
        """Return the mapped columns, by quantity."""
        sources = {name: getattr(self, name) for name in TARGET_UNITS}
        return {name: source for name, source in sources.items() if source is not None}


class ImportSettings(Settings):
    """All settings of an import; empty means: as the file states, or as detected."""

    columns: ColumnMap = ColumnMap()
    encoding: str = ""
    delimiter: str = ""
    """Between the columns of text: `,` `;` `|` or `tab`, or `space` for any white space."""
    decimal: Literal["", ".", ","] = ""
    header_lines: int | None = Field(default=None, ge=0)
    """Lines before the first row of numbers; the last of them hold names and perhaps units."""
    missing: Literal["refuse", "gap"] = "refuse"
    """Rows in which a mapped column has no number (empty, NaN, `---`, OVLD): refused, or left out as a gap."""
    table: str = ""
    """Variable or struct of a MAT file, group of a TDMS file, sheet of a workbook, block of a text; default: the
    largest table, and all tables with the same columns."""
    radius_mm: float | None = Field(default=None, gt=0)
    """Of a turning rig: angles become travels at this radius, and torques forces."""
    split_at: str = ""
    """Make a run of each motion of a long record (`rests`), of each stroke (`reversals`), of each two (`cycles`), or of
    each N strokes (their number)."""
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

    @field_validator("delimiter", mode="before")
    @classmethod
    def _mark(cls, delimiter: object) -> object:
        """Return the mark of a delimiter that may be named; before blanks are stripped, which a mark may be."""
        if not isinstance(delimiter, str):
            return delimiter
        by_name = {name: mark for mark, name in DELIMITERS.items()} | {"\\t": "\t", "blank": " "}
        mark = by_name.get(delimiter.strip().lower(), delimiter)
        if mark and mark not in DELIMITERS:
            raise ValueError(f"must be {', '.join(DELIMITERS.values())} or the mark itself, not {delimiter!r}")
        return next(name for known, name in DELIMITERS.items() if known == mark) if mark else ""

    @field_validator("split_at")
    @classmethod
    def _place_to_split(cls, split_at: str) -> str:
        if split_at not in _STROKES_PER_RUN and not (split_at.isdecimal() and int(split_at)):
            raise ValueError(f"must be rests, reversals, cycles or a number of strokes, not {split_at!r}")
        return split_at

    @property
    def strokes_per_run(self) -> int:
        """How many strokes of a long record make a run; 0 where it is not split at its reversals."""
        return _STROKES_PER_RUN[self.split_at] if self.split_at in _STROKES_PER_RUN else int(self.split_at)

    @property
    def delimiter_mark(self) -> str:
        """The character itself."""
        return next((mark for mark, name in DELIMITERS.items() if name == self.delimiter), "")

    @model_validator(mode="after")
    def _consistent(self) -> "ImportSettings":
        if self.sample_rate_hz is not None and self.resample_hz is not None:
            raise ValueError("sample_rate_hz says that rows are evenly spaced, resample_hz that they are not; give one")
        if self.from_s is not None and self.to_s is not None and self.from_s >= self.to_s:
            raise ValueError("from_s must come before to_s")
        if self.steady and self.columns.mapped() and (self.columns.command or not self.columns.position):
            raise ValueError("steady makes a command of the position; map a position and no command")
        if self.decimal and DELIMITERS.get(self.decimal) == self.delimiter:
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
