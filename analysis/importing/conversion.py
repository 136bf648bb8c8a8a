"""A foreign table converted to the arrays of a run: units, even time grid, position and command, phases."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.analysis import SavgolSettings, count_text, gap_starts, mask_spans, smooth
from dragrig.analysis.importing.clocks import RowTimes, epoch_clock, restarts, unwrapped
from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable
from dragrig.analysis.importing.import_settings import ColumnSource, ImportSettings, guess_columns
from dragrig.analysis.importing.time_grid import SampleGrid, counted_grid, fit_sample_grid, import_event, resample
from dragrig.analysis.importing.units import (
    CONVERTIBLE_UNITS,
    ROTARY_UNITS,
    TARGET_UNITS,
    UnitScale,
    canonical_unit,
    unit_scale,
)
from dragrig.config import AnalysisError, ImportDataError
from dragrig.rig import MAX_TRACE_MAGNITUDES, AnyFloatArray, FloatArray, Phase, PhaseArray, RecordedChannel, RunEvent

RESERVED_NAMES = frozenset({*TARGET_UNITS, "phase"})
SIGNAL_CHANNELS = ("force", "motor_force")
COUNTED_QUANTITIES = ("position", "command")
"""Quantities of counters, which may wrap."""
MAX_SAMPLES_PER_ROW = 1000.0
"""More are not resampled: a stamp is wrong, or the unit of the time."""
MAX_EXACT_INTEGER = 2.0**53

SPEED_WINDOW_S = 0.05
MIN_WINDOW_SAMPLES = 7
MOVING_SHARE = 0.05
"""Share of the top speed above which the stage moves."""
STEADY_TOLERANCE = 0.1
"""Relative deviation from the plateau's speed that is still steady."""
SPLIT_WINDOW_S = 0.1
"""Window over which a motion is told from a rest."""
MIN_REST_BETWEEN_S = 0.3
"""A shorter standstill, as at a reversal, belongs to its motion."""
MIN_STROKE_SHARE, STANDSTILL_SHARE = 0.2, 0.02
"""Shares of all travel: a shorter way back is no stroke, and so far from its end a stroke still stands."""
MIN_PLATEAU_SHARE = 0.5
"""Share of the motion that must be steady, for it to be one move at one speed."""


@dataclass(frozen=True, slots=True, eq=False)
class ConvertedMeasurement:
    """Contents of a run file: `columns` by dataset, of which `channels` are the recorded quantities."""

    sample_rate_hz: float
    channels: tuple[RecordedChannel, ...]
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[RunEvent, ...]
    origin_mm: float = 0.0
    time_origin_s: float = 0.0
    """`origin_mm`, `time_origin_s`: position and time of the first row in the foreign file."""
    skipped_s: float = 0.0
    """Time by which the run begins after the file's first row."""
    begins_at: datetime | None = None
    """When the file's first row was measured, where its time is a date."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """For each quantity, its column, unit and factor, in words."""


@dataclass(frozen=True, slots=True, eq=False)
class _MappedColumn:
    column: ForeignColumn
    unit: str
    scale: UnitScale

    @property
    def by_stated_factor(self) -> bool:
        """Whether the user's factor, not the unit, converts it; the column is then stored unconverted, too."""
        return all(canonical_unit(self.unit) not in units for units in CONVERTIBLE_UNITS.values())

    def continued(self, numbers: FloatArray) -> tuple[FloatArray, str]:
        """Return the column's numbers over the wraps of a counter or an angle, and then a remark."""
        radians = ROTARY_UNITS["mm"].get(canonical_unit(self.unit) or "")
        return unwrapped(numbers, 2 * np.pi / radians if radians else None)

    def __str__(self) -> str:
        offset = f" + {self.scale.offset:g}" if self.scale.offset else ""
        return f"{self.column.name!r} in {self.unit or '?'} × {self.scale.factor:g}{offset}"


def recordings(table: ForeignTable, settings: ImportSettings) -> tuple[ForeignTable, ...]:
    """Return the stretches of a table that are a recording of their own: between them the clock begins anew.

    Raises `ImportDataError` where the time cannot be read.
    """
    source = _sources(table, settings).get("time")
    if source is None:
        return (table,)
    whole, _ = _without_blank_ends(table, [table.column(source.column)])
    stamps = _time(whole, source, settings).seconds
    stretches = restarts(stamps) if np.isfinite(stamps).all() else ()
    if len(stretches) < 2:
        return (table,)
    told = f"the clock begins anew: a run for each of the {len(stretches)} stretches"
    first, *further = (replace(whole.sliced(rows), remarks=(*table.remarks, told)) for rows in stretches)
    return (first, *(replace(stretch, begins_at=None) for stretch in further))


def convert_table(table: ForeignTable, settings: ImportSettings) -> ConvertedMeasurement:
    """Map and convert columns, and put the rows onto an even grid.

    Raises `ImportDataError` when a column is missing, holds text or gaps where numbers are needed, its unit is not
    understood, or rows are unevenly spaced and neither resampling nor a rate is set.
    """
    sources = _sources(table, settings)
    _require_quantities(table, settings, sources)
    columns = [table.column(source.column) for source in sources.values()]
    for column in columns:
        table.require_numbers(column, throughout=settings.missing == "refuse")
    table, blanks = _without_blank_ends(table, columns)
    time = _time(table, sources["time"], settings) if "time" in sources else None
    mapped = {name: _map_column(table, name, source, settings) for name, source in sources.items() if name != "time"}
    values, counted = _mapped_values(table, mapped, settings)
    values |= {} if time is None else {"time": time.seconds}
    told = [*table.remarks, *(() if time is None else time.remarks), *_contradictions(table, sources), *counted]
    told += [f"column {column.name!r}: {remark}" for column in columns for remark in column.remarks]
    told += [f"{count_text(blanks, 'row')} without a number at begin or end left out"] if blanks else []
    complete = np.flatnonzero(np.all([np.isfinite(array) for array in values.values()], axis=0))
    if not complete.size:
        raise ImportDataError(f"{table.path}: no row has a number in all mapped columns; map others.")
    if len(complete) < table.rows:
        told.append(f"{count_text(table.rows - len(complete), 'row')} without a number left out: a gap")
    used = [source.column for source in mapped.values() if not source.by_stated_factor]
    used += [table.column(sources["time"].column)] if time is not None else []
    stated_units = {id(source.column): source.unit for source in mapped.values()}
    extra, extra_told = _extra_channels(table, used, stated_units)
    values |= {name: column.values for name, column in extra.items()}
    values = {name: array[complete] for name, array in values.items()}
    all_stamps = values.pop("time", None)
    stamps, rows = _select_rows(table, settings, all_stamps, complete)
    values = {name: array[rows] for name, array in values.items()}
    grid, values = _on_grid(table, settings, stamps, values, complete[rows])
    told += extra_told
    told += [
        f"{name} is {source} {TARGET_UNITS[name]}: a stated factor"
        for name, source in mapped.items()
        if source.by_stated_factor
    ]
    position, command, origin_mm, remarks = _position_and_command(values, grid, steady=settings.steady)
    phase, found = phases_of(position, grid.time, grid.sample_rate_hz)
    events = (*map(import_event, (*told, *remarks, found)), *grid.events)
    channels = [
        RecordedChannel(name, TARGET_UNITS.get(name) or extra[name].units, "float64")
        for name in values
        if name != "command"
    ]
    if "position" not in values:
        channels.append(RecordedChannel("position", "mm", "float64"))
    return ConvertedMeasurement(
        sample_rate_hz=grid.sample_rate_hz,
        channels=tuple(channels),
        columns={**values, "time": grid.time, "position": position, "command": command, "phase": phase},
        events=tuple(sorted(events, key=lambda event: event.time_s)),
        origin_mm=origin_mm,
        time_origin_s=float(stamps[0]) if stamps is not None and len(stamps) else 0.0,
        skipped_s=0.0 if stamps is None or all_stamps is None else float(stamps[0] - all_stamps[0]),
        begins_at=time.begins_at if time is not None and time.begins_at is not None else table.begins_at,
        sources={name: str(source) for name, source in mapped.items()}
        | ({"time": repr(table.column(sources["time"].column).name)} if time is not None else {}),
    )


def _mapped_values(
    table: ForeignTable, mapped: Mapping[str, _MappedColumn], settings: ImportSettings
) -> tuple[dict[str, FloatArray], list[str]]:
    """Return the converted columns by quantity, and remarks on counters that wrapped."""
    values, told = dict[str, FloatArray](), list[str]()
    for name, source in mapped.items():
        numbers = table.numbers(source.column, whole=settings.missing == "refuse")
        if name in COUNTED_QUANTITIES:
            numbers, wrapped = source.continued(numbers)
            told += [wrapped] if wrapped else []
        values[name] = source.scale.apply(numbers)
        _require_measurable(table, source.column, values[name], TARGET_UNITS[name])
    return values, told


def phases_of(position: FloatArray, time: FloatArray, sample_rate_hz: float) -> tuple[PhaseArray, str]:
    """Return the phases that a position shows, or steady ones where it shows none, and the remark on that."""
    phase = detect_phases(position, sample_rate_hz, gap_starts(time, sample_rate_hz))
    if phase is not None:
        return phase, "phases detected from the position"
    none_found = "no single move between standstills detected: all samples count as steady"
    return np.full(len(position), int(Phase.STEADY), dtype=np.uint8), none_found


def _sources(table: ForeignTable, settings: ImportSettings) -> Mapping[str, ColumnSource]:
    return settings.columns.mapped() or guess_columns(table).mapped()


def _time(table: ForeignTable, source: ColumnSource, settings: ImportSettings) -> RowTimes:
    """Return the time of the rows: of a column of dates, of a count since a fixed moment, or in a unit of time."""
    column = table.column(source.column)
    numbers, wrapped = unwrapped(table.numbers(column, whole=settings.missing == "refuse"))
    told = (wrapped,) if wrapped else ()
    stated = source.unit or column.units
    if column.begins_at is None and source.factor is None and np.isfinite(numbers).any():
        clock = epoch_clock(numbers, canonical_unit(stated) or stated)
        if clock is not None:
            _require_measurable(table, column, clock.seconds, "s")
            return replace(clock, remarks=(*told, *clock.remarks))
    seconds = _map_column(table, "time", source, settings).scale.apply(numbers)
    if np.nanmax(np.abs(seconds), initial=0.0) > MAX_TRACE_MAGNITUDES["s"] and (clock := epoch_clock(numbers, "")):
        raise ImportDataError(
            f"{table.path}: column {column.name!r} is not in {stated}: {clock.remarks[0]}; state that."
        )
    _require_measurable(table, column, seconds, "s")
    return RowTimes(seconds, column.begins_at, remarks=told)


def _contradictions(table: ForeignTable, sources: Mapping[str, ColumnSource]) -> Iterator[str]:
    """Tell where the map's unit is not the file's."""
    for source in sources.values():
        column = table.column(source.column)
        stated, mapped = (canonical_unit(unit) or unit for unit in (column.units, source.unit))
        if stated and mapped and stated != mapped:
            yield f"column {column.name!r} states {stated}, the map {mapped}: the map counts"


def _require_quantities(table: ForeignTable, settings: ImportSettings, mapped: Collection[str]) -> None:
    """Raise `ImportDataError` with all that no column is mapped to."""
    first, last = table.columns[0].name, table.columns[-1].name
    missing = {
        f"force or motor_force (force={last!r}:N)": not any(quantity in mapped for quantity in SIGNAL_CHANNELS),
        f"time (time={first!r}:s, or the rate by --sample-rate-hz)": "time" not in mapped
        and not (settings.sample_rate_hz or table.sample_rate_hz),
    }
    if any(missing.values()):
        names = ", ".join(repr(column.name) for column in table.columns)
        wanted = " and none to ".join(what for what, is_missing in missing.items() if is_missing)
        raise ImportDataError(f"{table.path}: no column is mapped to {wanted}; the columns are {names}.")


def _require_measurable(table: ForeignTable, column: ForeignColumn, values: FloatArray, unit: str) -> None:
    """Raise `ImportDataError` for a value that no rig measures, and no run file holds."""
    largest = MAX_TRACE_MAGNITUDES.get(unit, np.inf)
    beyond = np.flatnonzero(np.abs(values) > largest)
    if beyond.size:
        row = int(beyond[0])
        raise ImportDataError(
            f"{table.path}: {table.place(row)}, column {column.name!r} holds {column.values[row]:g}, and {largest:g} "
            f"{unit} is the most; remove such rows, or correct the column's unit."
        )


def _without_blank_ends(table: ForeignTable, columns: Sequence[ForeignColumn]) -> tuple[ForeignTable, int]:
    """Return the table without the rows at its begin and end in which a column lacks a number, and their count."""
    rows = np.flatnonzero(np.all([np.isfinite(column.values) for column in columns], axis=0))
    if not rows.size or len(rows) == table.rows:
        return table, 0
    kept = slice(int(rows[0]), int(rows[-1]) + 1)
    left_out = table.rows - (kept.stop - kept.start)
    return (table.sliced(kept), left_out) if left_out else (table, 0)


def motion_stretches(table: ForeignTable, settings: ImportSettings) -> tuple[tuple[float, float], ...]:
    """Return the stretches [s] of a long record that `split_at` makes runs of.

    Raises `ImportDataError` where no time and position are mapped, or there is nothing to split the record at.
    """
    sources = _sources(table, settings)
    if not {"time", "position"} <= set(sources):
        raise ImportDataError(f"{table.path}: split_at = {settings.split_at!r} needs a time and a position; map both.")
    table, _ = _without_blank_ends(table, [table.column(sources[name].column) for name in ("time", "position")])
    time = _time(table, sources["time"], settings).seconds
    mapped = _map_column(table, "position", sources["position"], settings)
    position = mapped.scale.apply(mapped.continued(table.numbers(mapped.column, whole=True))[0])
    strokes = settings.strokes_per_run
    cuts = _reversals(time, position)[strokes - 1 :: strokes] if strokes else _rests(time, position)
    if not cuts:
        raise ImportDataError(f"{table.path}: shows no place for split_at = {settings.split_at!r}; leave it out.")
    return tuple(pairwise((float(time[0]), *cuts, float(time[-1]))))


def _rests(time: FloatArray, position: FloatArray) -> list[float]:
    """Return the middle of each rest between two motions [s]."""
    window_s = max(SPLIT_WINDOW_S, 4 * float(np.median(np.diff(time))))
    ends = np.interp(time + window_s / 2, time, position), np.interp(time - window_s / 2, time, position)
    speed = np.abs(ends[0] - ends[1]) / window_s
    moves = [(time[start], time[stop - 1]) for start, stop in mask_spans(speed > MOVING_SHARE * float(speed.max()))]
    rests = [(before[1], after[0]) for before, after in pairwise(moves)]
    return [float(end + begin) / 2 for end, begin in rests if begin - end >= MIN_REST_BETWEEN_S]


def _reversals(time: FloatArray, position: FloatArray) -> list[float]:
    """Return the middle of the standstill of each reversal [s], however noisy or coarsely counted the position is."""
    extent = float(np.ptp(position))
    turns, furthest, direction = [0], 0, 0
    values = position.tolist()
    for row, value in enumerate(values):
        ahead = value - values[furthest]
        if direction * ahead > 0:
            furthest = row
        elif abs(ahead) > MIN_STROKE_SHARE * extent:
            turns += [furthest] if direction else []
            direction, furthest = (1 if ahead > 0 else -1), row
    cuts: list[float] = []
    for before, turn, after in zip(turns, turns[1:], [*turns[2:], len(position) - 1], strict=False):
        away = (
            np.flatnonzero(np.abs(position[before : after + 1] - position[turn]) > STANDSTILL_SHARE * extent) + before
        )
        left, right = away[away < turn][-1], away[away > turn][0]
        cuts.append(float(time[left] + time[right]) / 2)
    return cuts


def _map_column(table: ForeignTable, quantity: str, source: ColumnSource, settings: ImportSettings) -> _MappedColumn:
    column = table.column(source.column)
    unit = source.unit or column.units
    if not unit and source.factor is None:
        raise ImportDataError(
            f"{table.path}: column {column.name!r} does not state its unit; state it, as in "
            f"{quantity}={column.name!r}:{TARGET_UNITS[quantity]}."
        )
    try:
        return _MappedColumn(column, unit, unit_scale(quantity, unit, source.factor, source.offset, settings.radius_mm))
    except ImportDataError as error:
        raise ImportDataError(f"{table.path}: column {column.name!r}: {error}.") from error


def _extra_channels(
    table: ForeignTable, used: Sequence[ForeignColumn], stated_units: Mapping[int, str]
) -> tuple[dict[str, ForeignColumn], list[str]]:
    """Return the columns of numbers that are stored unconverted, by the name of their channel, and remarks.

    Parameters
    ----------
    stated_units
        By the identity of a column, the unit that a map states.
    """
    extra, told = dict[str, ForeignColumn](), list[str]()
    for number, column in enumerate(table.columns, start=1):
        if any(column is known for known in used):
            continue
        if not np.isfinite(column.values).any():
            if column.bad is not None or column.name != f"column {number}":
                told.append(f"column {column.name!r:.60} {'holds text' if column.bad else 'is empty'} and was left out")
            continue
        if column.bad is not None:
            told.append(
                f"column {column.name!r:.60} holds {column.bad.text!r:.40} in {table.place(column.bad.row)}: missing"
            )
        values = np.where(np.isinf(column.values), np.nan, column.values)
        units, largest = stated_units.get(id(column), column.units), float(np.nanmax(np.abs(values), initial=0.0))
        if largest > MAX_TRACE_MAGNITUDES.get(units, np.inf):
            told.append(f"column {column.name!r:.60} holds {largest:g}, too much for {units}: stored without a unit")
            units = ""
        if largest > MAX_EXACT_INTEGER:
            told.append(f"column {column.name!r:.60} holds integers above 2^53, which are rounded")
        name = re.sub(r"[^\w.-]+", "_", column.label).strip("_.") or "column"
        while name in RESERVED_NAMES or name in extra:
            name += "_as_read"
        extra[name] = replace(column, values=values, units=units)
    return extra, told


def _select_rows(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None, places: npt.NDArray[np.intp]
) -> tuple[FloatArray | None, slice]:
    """Time stamps between `from_s` and `to_s`, and their rows; `places` are those of the rows in the table."""
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
    backward = np.flatnonzero(np.diff(stamps[: rows.stop]) < 0)
    if backward.size:
        row = int(backward[0]) + 1
        raise ImportDataError(
            f"{table.path}: time goes back at {table.place(int(places[row]))}, from {stamps[row - 1]:.9g} s to "
            f"{stamps[row]:.9g} s; correct the clock, or sort the rows."
        )
    return stamps[rows], rows


def _on_grid(
    table: ForeignTable,
    settings: ImportSettings,
    stamps: FloatArray | None,
    values: dict[str, FloatArray],
    places: npt.NDArray[np.intp],
) -> tuple[SampleGrid, dict[str, FloatArray]]:
    stated_hz = settings.sample_rate_hz or (table.sample_rate_hz if stamps is None else None)
    if settings.resample_hz is not None and stamps is not None:
        samples = float(stamps[-1] - stamps[0]) * settings.resample_hz
        if samples > MAX_SAMPLES_PER_ROW * len(stamps):
            row = int(np.argmax(np.diff(stamps))) + 1
            raise ImportDataError(
                f"{table.path}: {settings.resample_hz:g} Hz would make {samples:.3g} samples of {len(stamps)} rows; "
                f"state a lower rate, or correct the time at {table.place(int(places[row]))}."
            )
        return resample(stamps, values, settings.resample_hz)
    if stated_hz is not None:
        return counted_grid(table.path, stamps, places, stated_hz), values
    if stamps is None:
        raise ImportDataError(
            f"{table.path}: no column is mapped to time and no sample_rate_hz is given; map one, as in "
            f"time={table.columns[0].name!r}:s."
        )
    source = _sources(table, settings)["time"]
    unit = canonical_unit(source.unit or table.column(source.column).units)
    unit_s = CONVERTIBLE_UNITS["s"].get(unit or "", 1.0)
    return fit_sample_grid(table.path, stamps, settings.tolerance, unit_s), values


def _position_and_command(
    values: Mapping[str, FloatArray], grid: SampleGrid, *, steady: bool
) -> tuple[FloatArray, FloatArray, float, list[str]]:
    """Position and command relative to the start of the run, that start [mm], and remarks."""
    rows = len(next(iter(values.values())))
    position, command = values.get("position"), values.get("command")
    remarks: list[str] = []
    if position is None:
        position = np.full(rows, np.nan)
        remarks.append("no position in the file: position is missing (NaN)")
    if command is None and steady:
        finite = np.isfinite(position)
        known = np.count_nonzero(finite) >= 2
        slope, offset = np.polyfit(grid.time[finite], position[finite], 1) if known else (np.nan, np.nan)
        command = offset + slope * grid.time
        remarks.append(f"no command in the file: a straight line at {slope:.6g} mm/s through the position, as set")
    elif command is None:
        command = position
        remarks.append("no command in the file: the position is used in its place")
    start = position[0] if np.isfinite(position[0]) else command[0]
    origin_mm = float(start) if np.isfinite(start) else 0.0
    return position - origin_mm, command - origin_mm, origin_mm, remarks


def detect_phases(position: FloatArray, sample_rate_hz: float, gaps: npt.ArrayLike = ()) -> PhaseArray | None:
    """Detect rest, run-up, steady sliding, run-down and hold of a single move at one speed.

    Parameters
    ----------
    position
        Shape `(N,)`, any unit.
    gaps
        Index of each first sample after a gap.

    Returns
    -------
    PhaseArray or None
        None where the position shows no single move with a plateau of speed between standstills.
    """
    window = max(MIN_WINDOW_SAMPLES, 2 * int(SPEED_WINDOW_S * sample_rate_hz / 2) + 1)
    try:
        differentiator = SavgolSettings(window_samples=window, order=1, derivative=1)
        speed = smooth(position, sample_rate_hz, differentiator, gaps).values
    except AnalysisError:
        return None
    if not np.isfinite(speed).all():
        return None
    moving = np.abs(speed) > MOVING_SHARE * np.quantile(np.abs(speed), 0.98)
    moves = [(start, stop) for start, stop in mask_spans(moving) if stop - start > window]
    if len(moves) != 1 or moves[0] == (0, len(speed)):
        return None
    start, stop = moves[0]
    plateau = float(np.median(speed[start:stop]))
    steady = mask_spans(np.abs(speed[start:stop] - plateau) < STEADY_TOLERANCE * abs(plateau))
    first, last = max(steady, key=lambda span: span[1] - span[0], default=(0, 0))
    if last - first < MIN_PLATEAU_SHARE * (stop - start):
        return None
    phase = np.full(len(position), int(Phase.REST), dtype=np.uint8)
    phase[start : start + first] = int(Phase.ACCELERATE)
    phase[start + first : start + last] = int(Phase.STEADY)
    phase[start + last : stop] = int(Phase.DECELERATE)
    phase[stop:] = int(Phase.HOLD)
    return phase
