"""A foreign table turned into the arrays of a run."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dragrig.analysis.gaps import gap_starts
from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable
from dragrig.analysis.importing.guessing import guess_columns
from dragrig.analysis.importing.mapping import ColumnSource, ImportSettings
from dragrig.analysis.importing.motion import detect_phases
from dragrig.analysis.importing.resample import resample
from dragrig.analysis.importing.timebase import IMPORT_EVENT, Grid, check_order, counted, fit_grid
from dragrig.analysis.importing.units import KNOWN, TARGETS, Scale, canonical, scale_to
from dragrig.config.errors import ImportDataError
from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Channel, Event

RESERVED = frozenset({*TARGETS, "phase"})
SIGNALS = ("force", "motor_force")


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """What a run file needs: `columns` by dataset, `channels` those that are recorded quantities."""

    sample_rate_hz: float
    channels: tuple[Channel, ...]
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[Event, ...]
    origin_mm: float = 0.0
    time_origin_s: float = 0.0
    sources: Mapping[str, str] = field(default_factory=dict)
    """In words, which column each quantity came from and how."""


@dataclass(frozen=True, slots=True, eq=False)
class _Mapped:
    """A column that was found for a quantity."""

    column: ForeignColumn
    unit: str
    scale: Scale

    @property
    def of_other_kind(self) -> bool:
        """Whether a stated factor, not the unit, makes it ours; the column is then kept as it is, too."""
        return all(canonical(self.unit) not in units for units in KNOWN.values())

    def __str__(self) -> str:
        offset = f" + {self.scale.offset:g}" if self.scale.offset else ""
        return f"{self.column.name!r} in {self.unit or '?'} × {self.scale.factor:g}{offset}"


def measurement_of(table: ForeignTable, settings: ImportSettings) -> Measurement:
    """Map, convert and put onto an even grid.

    Raises
    ------
    ImportDataError
        When a column is missing, holds text or gaps where numbers are needed, its unit is not understood,
        or rows are unevenly spaced and nobody asked for resampling.
    """
    sources = settings.columns.mapped() or guess_columns(table).mapped()
    mapped = {name: _found(table, name, source) for name, source in sources.items()}
    if not any(name in mapped for name in SIGNALS):
        names = ", ".join(repr(column.name) for column in table.columns)
        raise ImportDataError(
            f"{table.path}: no column is mapped to force or motor_force; map one of {names}, as in "
            f"force={table.columns[-1].name!r}:N."
        )
    values = {name: _values(table, one) for name, one in mapped.items()}
    further, events = _further(table, mapped)
    values |= {name: column.values for name, column in further.items()}
    stamps, rows = _stamps_and_rows(table, settings, values.pop("time", None))
    values = {name: array[rows] for name, array in values.items()}
    grid, values = _on_grid(table, settings, stamps, values)
    events += [*grid.events, *(Event(0.0, IMPORT_EVENT, str(said)) for said in _scaled(mapped))]
    position, command, origin_mm, said = _places(values, grid, steady=settings.steady)
    events += said
    phase = detect_phases(position, grid.sample_rate_hz, gap_starts(grid.time, grid.sample_rate_hz))
    if phase is None:
        phase = np.full(len(position), int(Phase.STEADY), dtype=np.uint8)
        events.append(Event(0.0, IMPORT_EVENT, "no single move between standstills seen: all of it counts as steady"))
    else:
        events.append(Event(0.0, IMPORT_EVENT, "phases found from the position"))
    units = {name: column.units for name, column in further.items()}
    channels = [Channel(name, TARGETS.get(name) or units[name], "float64") for name in values]
    if "position" not in values:
        channels.append(Channel("position", "mm", "float64"))
    columns: dict[str, AnyFloatArray | PhaseArray]
    columns = {**values, "time": grid.time, "position": position, "command": command, "phase": phase}
    return Measurement(
        sample_rate_hz=grid.sample_rate_hz,
        channels=tuple(channel for channel in channels if channel.name != "command"),
        columns=columns,
        events=tuple(sorted(events, key=lambda event: event.time_s)),
        origin_mm=origin_mm,
        time_origin_s=float(stamps[0]) if stamps is not None and len(stamps) else 0.0,
        sources={name: str(one) for name, one in mapped.items()},
    )


def _found(table: ForeignTable, quantity: str, source: ColumnSource) -> _Mapped:
    column = table.column(source.column)
    unit = source.unit or column.units
    if not unit and source.factor is None:
        raise ImportDataError(
            f"{table.path}: column {column.name!r} does not say its unit; state it, as in "
            f"{quantity}={column.name!r}:{TARGETS[quantity]}."
        )
    try:
        return _Mapped(column, unit, scale_to(quantity, unit, source.factor, source.offset))
    except ImportDataError as error:
        raise ImportDataError(f"{table.path}: column {column.name!r}: {error}.") from error


def _values(table: ForeignTable, mapped: _Mapped) -> FloatArray:
    return mapped.scale.apply(table.numbers(mapped.column, whole=True))


def _further(table: ForeignTable, mapped: Mapping[str, _Mapped]) -> tuple[dict[str, ForeignColumn], list[Event]]:
    """Columns of numbers that are kept as they are, by the name of their channel."""
    used = {id(one.column) for one in mapped.values() if not one.of_other_kind}
    stated = {id(one.column): one.unit for one in mapped.values()}
    kept: dict[str, ForeignColumn] = {}
    events: list[Event] = []
    for column in table.columns:
        if id(column) in used:
            continue
        if column.bad is not None:
            message = f"column {column.name!r:.60} holds text and was left out"
            events.append(Event(0.0, IMPORT_EVENT, message))
            continue
        name = re.sub(r"[^\w.-]+", "_", column.label).strip("_.") or "column"
        while name in RESERVED or name in kept:
            name += "_as_read"
        kept[name] = replace(column, units=stated.get(id(column), column.units))
    return kept, events


def _stamps_and_rows(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None
) -> tuple[FloatArray | None, slice]:
    """Time stamps and rows that are wanted."""
    if stamps is None:
        if settings.from_s is not None or settings.to_s is not None:
            raise ImportDataError(f"{table.path}: from_s and to_s need a time column; map one, as in time=1:s.")
        return None, slice(0, table.rows)
    low = -np.inf if settings.from_s is None else settings.from_s
    high = np.inf if settings.to_s is None else settings.to_s
    inside = np.flatnonzero((stamps >= low) & (stamps <= high))
    if not inside.size:
        raise ImportDataError(
            f"{table.path}: has no rows from {low:g} to {high:g} s; its time runs from {stamps.min():.9g} to "
            f"{stamps.max():.9g} s."
        )
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    check_order(table, stamps[: rows.stop])
    return stamps[rows], rows


def _on_grid(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None, values: dict[str, FloatArray]
) -> tuple[Grid, dict[str, FloatArray]]:
    rows = len(next(iter(values.values())))
    stated = settings.sample_rate_hz or (table.sample_rate_hz if stamps is None else None)
    if settings.resample_hz is not None and stamps is not None:
        resampled = resample(stamps, values, settings.resample_hz)
        return resampled.grid, dict(resampled.columns)
    if stated is not None:
        return counted(table.path, stamps, rows, stated), values
    if stamps is None:
        raise ImportDataError(
            f"{table.path}: no column is mapped to time and no sample_rate_hz is given; map one, as in "
            f"time={table.columns[0].name!r}:s."
        )
    return fit_grid(table.path, stamps, settings.tolerance), values


def _places(
    values: Mapping[str, FloatArray], grid: Grid, *, steady: bool
) -> tuple[FloatArray, FloatArray, float, list[Event]]:
    """Position and command from where the run starts, that place, and what is to be said of them."""
    rows = len(next(iter(values.values())))
    position, command = values.get("position"), values.get("command")
    said: list[Event] = []
    if position is None:
        position = np.full(rows, np.nan)
        said.append(Event(0.0, IMPORT_EVENT, "no position in the file: position is missing (NaN)"))
    if command is None and steady:
        command, speed_mm_s = _straight(grid.time, position)
        message = f"no command in the file: the straight line at {speed_mm_s:.6g} mm/s through the position, as stated"
        said.append(Event(0.0, IMPORT_EVENT, message))
    elif command is None:
        command = position
        said.append(Event(0.0, IMPORT_EVENT, "no command in the file: the position stands for it"))
    first = position[0] if np.isfinite(position[0]) else command[0]
    origin_mm = float(first) if np.isfinite(first) else 0.0
    return position - origin_mm, command - origin_mm, origin_mm, said


def _straight(time_s: FloatArray, position: FloatArray) -> tuple[FloatArray, float]:
    """Return the straight line that is nearest to a position, and its slope; missing positions are left out."""
    seen = np.isfinite(position)
    if np.count_nonzero(seen) < 2:
        return np.full_like(position, np.nan), float("nan")
    line = np.polynomial.Polynomial.fit(time_s[seen], position[seen], 1)
    return np.asarray(line(time_s), dtype=np.float64), float(line.deriv()(0.0))


def _scaled(mapped: Mapping[str, _Mapped]) -> list[str]:
    """Say which quantities exist only by a factor that somebody stated."""
    return [f"{name} is {one} {TARGETS[name]}: a stated factor" for name, one in mapped.items() if one.of_other_kind]
