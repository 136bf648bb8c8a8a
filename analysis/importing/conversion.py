"""A foreign table converted to the arrays of a run: units, even time grid, position and command, phases.

Most instruments stamp rows evenly, to within their last digit; some leave rows out, so that the stamps jump by
a whole number of periods, which becomes a gap. A program that stalls now and then samples late, and then in a
burst. It is tempting to move such rows back to where counting puts them, but measured positions show that they were
taken when they were stamped (a motor's, in the tests' data: the jump of the position is that of the time, not of the
count). So rows off the grid are never moved: the user either asks for resampling, or states the rate.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis import Mask, SavgolSettings, gap_starts, mask_spans, smooth
from dragrig.analysis.importing.foreign import (
    CONVERTIBLE_UNITS,
    TARGET_UNITS,
    ColumnSource,
    ForeignColumn,
    ForeignTable,
    ImportSettings,
    UnitScale,
    canonical_unit,
    guess_columns,
    unit_scale,
)
from dragrig.config import AnalysisError, ImportDataError
from dragrig.rig import MAX_TRACE_MAGNITUDES, AnyFloatArray, FloatArray, Phase, PhaseArray, RecordedChannel, RunEvent

IMPORT_EVENT = "import"
RESERVED_NAMES = frozenset({*TARGET_UNITS, "phase"})
SIGNAL_CHANNELS = ("force", "motor_force")

# Even grid.
MAX_STRAY_SHARE = 0.05
"""Up to this share of rows off the grid, the message speaks of an even rate with strays."""
MAX_GAP_SHARE = 0.01
ALWAYS_ALLOWED_GAPS = 10
"""This many gaps are never too many, however short the file."""

# Resampling.
GAP_FACTOR = 5.0
"""A step longer than this many of the steps around it is a gap, which is not filled."""
MEDIAN_STEPS = 21
MIN_ROWS_AVERAGED = 3
"""With this many rows within a period their mean is taken, so that faster signals do not alias."""

# Phases from the position.
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
class SampleGrid:
    """Rows on an even grid: `index` counts periods from the first row, shape `(N,)`, rising."""

    sample_rate_hz: float
    index: npt.NDArray[np.int64]
    events: tuple[RunEvent, ...] = ()

    @property
    def time(self) -> FloatArray:
        """Time since the first row [s]."""
        return np.asarray(self.index / self.sample_rate_hz, dtype=np.float64)


class UnevenRowsError(ImportDataError):
    """Time stamps that are not on an even grid."""


@dataclass(frozen=True, slots=True, eq=False)
class _MappedColumn:
    column: ForeignColumn
    unit: str
    scale: UnitScale

    @property
    def by_stated_factor(self) -> bool:
        """Whether the user's factor, not the unit, converts it; the column is then stored unconverted, too."""
        return all(canonical_unit(self.unit) not in units for units in CONVERTIBLE_UNITS.values())

    def __str__(self) -> str:
        offset = f" + {self.scale.offset:g}" if self.scale.offset else ""
        return f"{self.column.name!r} in {self.unit or '?'} × {self.scale.factor:g}{offset}"


def convert_table(table: ForeignTable, settings: ImportSettings) -> ConvertedMeasurement:
    """Map and convert columns, and put the rows onto an even grid.

    Raises `ImportDataError` when a column is missing, holds text or gaps where numbers are needed, its unit is not
    understood, or rows are unevenly spaced and neither resampling nor a rate is set.
    """
    sources = settings.columns.mapped() or guess_columns(table).mapped()
    mapped = {quantity: _map_column(table, quantity, source, settings) for quantity, source in sources.items()}
    table, blanks = _without_blank_ends(table, [source.column for source in mapped.values()])
    if blanks:
        mapped = {quantity: _map_column(table, quantity, source, settings) for quantity, source in sources.items()}
    _require_quantities(table, settings, mapped)
    values = {
        quantity: source.scale.apply(table.numbers(source.column, whole=True)) for quantity, source in mapped.items()
    }
    for quantity, source in mapped.items():
        _require_measurable(table, source.column, values[quantity], TARGET_UNITS[quantity])
    extra, events = _extra_channels(table, mapped)
    events += [_event(f"{blanks} rows at begin or end lack a number and were left out")] if blanks else []
    values |= {name: column.values for name, column in extra.items()}
    all_stamps = values.pop("time", None)
    stamps, rows = _select_rows(table, settings, all_stamps)
    grid, values = _on_grid(table, settings, stamps, {name: array[rows] for name, array in values.items()})
    events += grid.events
    events += [
        _event(f"{quantity} is {source} {TARGET_UNITS[quantity]}: a stated factor")
        for quantity, source in mapped.items()
        if source.by_stated_factor
    ]
    position, command, origin_mm, remarks = _position_and_command(values, grid, steady=settings.steady)
    phase = detect_phases(position, grid.sample_rate_hz, gap_starts(grid.time, grid.sample_rate_hz))
    if phase is None:
        phase = np.full(len(position), int(Phase.STEADY), dtype=np.uint8)
        remarks.append("no single move between standstills detected: all samples count as steady")
    else:
        remarks.append("phases detected from the position")
    events += map(_event, remarks)
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
        begins_at=mapped["time"].column.begins_at if "time" in mapped else None,
        sources={quantity: str(source) for quantity, source in mapped.items()},
    )


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


def _event(message: str) -> RunEvent:
    return RunEvent(0.0, IMPORT_EVENT, message)


def _without_blank_ends(table: ForeignTable, columns: Sequence[ForeignColumn]) -> tuple[ForeignTable, int]:
    """Return the table without the rows at its begin and end in which a column lacks a number, and their count."""
    complete = np.ones(table.rows, dtype=np.bool_)
    for column in columns:
        complete &= np.isfinite(column.values)
    rows = np.flatnonzero(complete)
    if not rows.size or len(rows) == table.rows:
        return table, 0
    kept = slice(int(rows[0]), int(rows[-1]) + 1)
    trimmed = tuple(replace(column, values=column.values[kept]) for column in table.columns)
    lines = None if table.lines is None else table.lines[kept]
    left_out = table.rows - (kept.stop - kept.start)
    return (replace(table, columns=trimmed, lines=lines), left_out) if left_out else (table, 0)


def motion_stretches(table: ForeignTable, settings: ImportSettings) -> tuple[tuple[float, float], ...]:
    """Return the stretches [s] of a long record with one motion each, cut in the middle of the rests between them.

    Raises `ImportDataError` where no time and position are mapped, or there are not several motions.
    """
    sources = settings.columns.mapped() or guess_columns(table).mapped()
    if not {"time", "position"} <= set(sources):
        raise ImportDataError(f"{table.path}: split_at = 'rests' needs a time and a position; map both.")
    mapped = {name: _map_column(table, name, sources[name], settings) for name in ("time", "position")}
    table, _ = _without_blank_ends(table, [source.column for source in mapped.values()])
    time, position = (
        source.scale.apply(table.numbers(table.column(source.column.name), whole=True)) for source in mapped.values()
    )
    window_s = max(SPLIT_WINDOW_S, 4 * float(np.median(np.diff(time))))
    ends = np.interp(time + window_s / 2, time, position), np.interp(time - window_s / 2, time, position)
    speed = np.abs(ends[0] - ends[1]) / window_s
    moving = speed > MOVING_SHARE * float(speed.max())
    moves = [(time[start], time[stop - 1]) for start, stop in mask_spans(moving)]
    joined: list[tuple[float, float]] = []
    for start, stop in moves:
        if joined and start - joined[-1][1] < MIN_REST_BETWEEN_S:
            joined[-1] = (joined[-1][0], float(stop))
        else:
            joined.append((float(start), float(stop)))
    if len(joined) < 2:
        raise ImportDataError(f"{table.path}: shows no rests between motions to split it at; leave split_at out.")
    cuts = [(before[1] + after[0]) / 2 for before, after in pairwise(joined)]
    return tuple(pairwise((float(time[0]), *cuts, float(time[-1]))))


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
    table: ForeignTable, mapped: Mapping[str, _MappedColumn]
) -> tuple[dict[str, ForeignColumn], list[RunEvent]]:
    """Columns of numbers that are stored unconverted, by the name of their channel."""
    converted = {id(source.column) for source in mapped.values() if not source.by_stated_factor}
    stated_units = {id(source.column): source.unit for source in mapped.values()}
    extra: dict[str, ForeignColumn] = {}
    events: list[RunEvent] = []
    for column in table.columns:
        if id(column) in converted:
            continue
        if column.bad is not None:
            events.append(_event(f"column {column.name!r:.60} holds text and was left out"))
            continue
        name = re.sub(r"[^\w.-]+", "_", column.label).strip("_.") or "column"
        while name in RESERVED_NAMES or name in extra:
            name += "_as_read"
        extra[name] = replace(column, units=stated_units.get(id(column), column.units))
    return extra, events


def _select_rows(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None
) -> tuple[FloatArray | None, slice]:
    """Time stamps between `from_s` and `to_s`, and their rows."""
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
            f"{table.path}: time goes back at {table.place(row)}, from {stamps[row - 1]:.9g} s to {stamps[row]:.9g} s; "
            "import each stretch on its own with from_s and to_s, or sort the rows."
        )
    return stamps[rows], rows


def _on_grid(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None, values: dict[str, FloatArray]
) -> tuple[SampleGrid, dict[str, FloatArray]]:
    rows = len(next(iter(values.values())))
    stated_hz = settings.sample_rate_hz or (table.sample_rate_hz if stamps is None else None)
    if settings.resample_hz is not None and stamps is not None:
        return resample(stamps, values, settings.resample_hz)
    if stated_hz is not None:
        return counted_grid(table.path, stamps, rows, stated_hz), values
    if stamps is None:
        raise ImportDataError(
            f"{table.path}: no column is mapped to time and no sample_rate_hz is given; map one, as in "
            f"time={table.columns[0].name!r}:s."
        )
    return fit_sample_grid(table.path, stamps, settings.tolerance), values


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


def counted_grid(path: Path, stamps: FloatArray | None, rows: int, sample_rate_hz: float) -> SampleGrid:
    """Grid of rows that are evenly spaced at a stated rate.

    Raises `ImportDataError` when the time stamps' span differs by more than 1 % and three periods.
    """
    span_s = (rows - 1) / sample_rate_hz
    if stamps is not None and rows > 1:
        stamped_s = float(stamps[-1] - stamps[0])
        if abs(stamped_s - span_s) > 0.01 * span_s + 3 / sample_rate_hz:
            raise ImportDataError(
                f"{path}: {rows} rows at {sample_rate_hz:g} Hz span {span_s:.6g} s, their time stamps {stamped_s:.6g} "
                "s; correct sample_rate_hz, or leave it out."
            )
    event = _event(f"time counted at {sample_rate_hz:g} Hz, as stated")
    return SampleGrid(sample_rate_hz, np.arange(rows, dtype=np.int64), (event,))


def fit_sample_grid(path: Path, stamps: FloatArray, tolerance: float) -> SampleGrid:
    """Find the even grid that time stamps lie on.

    Parameters
    ----------
    stamps
        Seconds, never falling, shape `(N,)`.
    tolerance
        Allowed distance of a stamp from the grid, in periods; the last written digit is allowed for besides.

    Raises
    ------
    UnevenRowsError
        When there is no such grid; the message says how the stamps are spaced and what can be done.
    """
    if len(stamps) < 2:
        raise ImportDataError(f"{path}: has {len(stamps)} row only, from which no sample rate follows; give more.")
    if not np.diff(stamps).all():
        row = int((np.diff(stamps) == 0).argmax())
        raise UnevenRowsError(
            f"{path}: several rows have the time {stamps[row]:.9g} s; where the clock is coarser than the sampling, "
            "state sample_rate_hz, so that rows are counted."
        )
    resolution = _time_resolution(stamps)
    # The longest lag of `_sample_period` is at least a quarter of the rows, and both its ends are rounded.
    period = _round_period(_sample_period(stamps), 4 * resolution / len(stamps))
    place = (stamps - stamps[0]) / period
    place = place - float(np.angle(np.exp(2j * np.pi * place).mean())) / (2 * np.pi)
    index = np.round(place).astype(np.int64)
    allowance = min(0.49, max(tolerance, 0.51 * resolution / period))
    stray = np.abs(place - index) > allowance
    stray[1:] |= np.diff(index) < 1
    gaps = np.flatnonzero(np.diff(index) > 1)
    if 0 < np.count_nonzero(stray) <= MAX_STRAY_SHARE * len(stamps):
        raise UnevenRowsError(
            f"{path}: {np.count_nonzero(stray)} of {len(stamps)} rows are off an even rate of {1 / period:.9g} Hz, the "
            f"first at {stamps[stray][0]:.9g} s; state resample_hz to have rows interpolated where they are missing, "
            "or sample_rate_hz if they were sampled evenly and only stamped late."
        )
    if stray.any() or gaps.size > max(ALWAYS_ALLOWED_GAPS, MAX_GAP_SHARE * len(stamps)):
        raise _uneven_error(path, stamps)
    index -= index[0]
    lost = np.diff(index)[gaps] - 1
    events = [
        RunEvent(float(index[row] + 1) * period, "gap", f"{count} samples lost, {count * period:.6g} s")
        for row, count in zip(gaps.tolist(), lost.tolist(), strict=True)
    ]
    return SampleGrid(1 / period, index, tuple(events))


def _sample_period(stamps: FloatArray) -> float:
    """Median spacing, refined over ever longer lags; lags across gaps count as that many more periods."""
    period = float(np.median(np.diff(stamps)))
    lag = 2
    while lag <= len(stamps) // 2:
        spans = stamps[lag:] - stamps[:-lag]
        period = float(np.median(spans / np.maximum(np.round(spans / period), 1)))
        lag *= 2
    return period


def _time_resolution(stamps: FloatArray) -> float:
    """Value of the last decimal that the stamps are written with, at least the resolution of their floats."""
    finest = float(np.spacing(np.abs(stamps).max()))
    for decimals in range(10):
        unit = 10.0**-decimals
        if unit < 8 * finest:
            break
        if np.allclose(stamps, np.round(stamps, decimals), rtol=0, atol=4 * finest):
            return unit
    return 8 * finest


def _round_period(period: float, uncertainty: float) -> float:
    """Roundest rate or period, in that order, that agrees with `period` within its uncertainty."""
    for digits in range(1, 12):
        for candidate in (1 / float(f"{1 / period:.{digits}g}"), float(f"{period:.{digits}g}")):
            if abs(candidate - period) <= uncertainty:
                return candidate
    return period


def _uneven_error(path: Path, stamps: FloatArray) -> UnevenRowsError:
    steps = np.diff(stamps)
    part = max(1, len(steps) // 10)
    first, last = float(np.median(steps[:part])), float(np.median(steps[-part:]))
    if max(first, last) > 1.5 * min(first, last):
        spacing = f"rows are {first:.6g} s apart at the start and {last:.6g} s at the end"
        remedy = "import each stretch on its own with from_s and to_s, or "
    else:
        spacing = f"rows are {steps.min():.6g} to {steps.max():.6g} s apart (median {np.median(steps):.6g} s), unevenly"
        remedy = "state sample_rate_hz if the sampling was even and only its stamps are not, or "
    return UnevenRowsError(f"{path}: {spacing}; {remedy}state resample_hz to have rows interpolated to an even rate.")


def resample(
    stamps: FloatArray, columns: Mapping[str, FloatArray], sample_rate_hz: float
) -> tuple[SampleGrid, dict[str, FloatArray]]:
    """Resample columns at an even rate.

    A sample is the mean of the rows within half a period, or with fewer than three such rows a linear interpolation
    between the rows around it. Gaps are not filled. A column with missing values is never averaged, and is missing
    around them.

    Parameters
    ----------
    stamps
        Times of the rows [s], never falling, shape `(N,)`; of rows at the same time the first counts.
    columns
        Each of shape `(N,)`.
    """
    times, first = np.unique(stamps, return_index=True)
    count = int(np.floor((times[-1] - times[0]) * sample_rate_hz + 1e-9)) + 1
    index = np.arange(count, dtype=np.int64)
    at = times[0] + index / sample_rate_hz
    is_gap = _gaps_between(times, sample_rate_hz)
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0))
    if is_gap.size:
        measured = ~(is_gap[before] & (at > times[before]) & (at < times[before + 1]))
        index, at = index[measured], at[measured]
    edges = np.searchsorted(times, np.stack((at - 0.5 / sample_rate_hz, at + 0.5 / sample_rate_hz)))
    averaged = edges[1] - edges[0] >= MIN_ROWS_AVERAGED

    def resampled(values: FloatArray) -> FloatArray:
        result = np.asarray(np.interp(at, times, values), dtype=np.float64)
        if np.isfinite(values).all():
            sums = np.concatenate(([0.0], np.cumsum(values - values[0])))
            start, stop = edges[:, averaged]
            result[averaged] = values[0] + (sums[stop] - sums[start]) / (stop - start)
        return result

    events = tuple(_resample_events(times, at, averaged, is_gap, sample_rate_hz))
    grid = SampleGrid(sample_rate_hz, index, events)
    return grid, {name: resampled(values[first]) for name, values in columns.items()}


def _gaps_between(times: FloatArray, sample_rate_hz: float) -> Mask:
    """Which steps between rows are gaps, shape `(N - 1,)`."""
    from scipy.ndimage import median_filter

    steps = np.diff(times)
    if not steps.size:
        return steps > 0
    around = median_filter(steps, size=MEDIAN_STEPS, mode="nearest")
    return np.asarray(steps > np.maximum(GAP_FACTOR * around, 1 / sample_rate_hz))


def _resample_events(
    times: FloatArray, at: FloatArray, averaged: Mask, is_gap: Mask, sample_rate_hz: float
) -> Iterator[RunEvent]:
    means = int(np.count_nonzero(averaged))
    yield _event(
        f"resampled to {sample_rate_hz:g} Hz from {len(times)} rows: {means} samples are means of rows, "
        f"{len(at) - means} interpolated"
    )
    step_around = np.diff(times)[np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)]
    if invented := int(np.count_nonzero(step_around > 1.5 / sample_rate_hz)):
        yield _event(f"{invented} samples lie between rows that are further apart than the new period: not measured")
    for row in np.flatnonzero(is_gap).tolist():
        message = f"no rows for {times[row + 1] - times[row]:.6g} s: not filled"
        yield RunEvent(float(times[row] - times[0]), "gap", message)


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
