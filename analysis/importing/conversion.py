"""A foreign table converted to the arrays of a run: units, even time grid, position and command, phases.

Most instruments stamp rows evenly, to within their last digit; some leave rows out, so that the stamps jump by
a whole number of periods, which becomes a gap. A program that stalls now and then samples late, and then in a
burst. It is tempting to move such rows back to where counting puts them, but measured positions show that they were
taken when they were stamped (a motor's, in the tests' data: the jump of the position is that of the time, not of the
count). So rows off the grid are never moved: the user either asks for resampling, or states the rate.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.foreign import (
    CONVERTIBLE_UNITS,
    TARGET_UNITS,
    ForeignColumn,
    ForeignTable,
    UnitScale,
    canonical_unit,
    unit_scale,
)
from dragrig.analysis.importing.mapping import ColumnSource, ImportSettings, guess_columns
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.analysis.segments import finite_spans, gap_starts
from dragrig.config.errors import AnalysisError, ImportDataError
from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Channel, RunEvent

MAX_STRAY_SHARE = 0.05
"""Up to this part of all rows, those off the grid are spoken of as strays from an even rate."""
MAX_GAP_SHARE = 0.01
ALWAYS_ALLOWED_GAPS = 10
"""Fewer gaps than this are never too many, however short the file."""
IMPORT_EVENT = "import"


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
    """Rows that do not stand on an even grid."""


def check_time_order(table: ForeignTable, stamps: FloatArray) -> None:
    """Make sure that time never goes back.

    Raises
    ------
    ImportDataError
        Naming the first line where it does.
    """
    back = np.flatnonzero(np.diff(stamps) < 0)
    if back.size:
        row = int(back[0]) + 1
        raise ImportDataError(
            f"{table.path}: time goes back at {table.place(row)}, from {stamps[row - 1]:.9g} s to {stamps[row]:.9g} s; "
            "import each stretch on its own with from_s and to_s, or sort the rows."
        )


def counted_grid(path: Path, stamps: FloatArray | None, rows: int, sample_rate_hz: float) -> SampleGrid:
    """Grid of rows that are evenly spaced because somebody says so.

    Raises
    ------
    ImportDataError
        When time stamps span a time that differs by more than 1 % and three periods.
    """
    spanned = (rows - 1) / sample_rate_hz
    if stamps is not None and rows > 1:
        said = float(stamps[-1] - stamps[0])
        if abs(said - spanned) > 0.01 * spanned + 3 / sample_rate_hz:
            raise ImportDataError(
                f"{path}: {rows} rows at {sample_rate_hz:g} Hz span {spanned:.6g} s, their time stamps {said:.6g} s; "
                "correct sample_rate_hz, or leave it out."
            )
    message = f"time counted at {sample_rate_hz:g} Hz, as stated"
    return SampleGrid(sample_rate_hz, np.arange(rows, dtype=np.int64), (RunEvent(0.0, IMPORT_EVENT, message),))


def fit_sample_grid(path: Path, stamps: FloatArray, tolerance: float) -> SampleGrid:
    """Find the even grid that time stamps stand on.

    Parameters
    ----------
    stamps
        Seconds, never falling, shape `(N,)`.
    tolerance
        How far from the grid a stamp may lie, in periods; the last written digit is allowed for besides.

    Raises
    ------
    UnevenError
        When there is no such grid; the sentence says how the stamps are spaced and what can be done.
    """
    if len(stamps) < 2:
        raise ImportDataError(f"{path}: has {len(stamps)} row only, from which no sample rate follows; give more.")
    if not np.diff(stamps).all():
        row = int((np.diff(stamps) == 0).argmax())
        raise UnevenRowsError(
            f"{path}: several rows have the time {stamps[row]:.9g} s; where the clock is coarser than the sampling, "
            "state sample_rate_hz, so that rows are counted."
        )
    digit = _time_resolution(stamps)
    # The longest lag of `_sample_period` is at least a quarter of the rows, and both its ends are rounded.
    period = _round_period(_sample_period(stamps), 4 * digit / len(stamps))
    place = (stamps - stamps[0]) / period
    place = place - float(np.angle(np.exp(2j * np.pi * place).mean())) / (2 * np.pi)
    index = np.round(place).astype(np.int64)
    allowance = min(0.49, max(tolerance, 0.51 * digit / period))
    stray = np.abs(place - index) > allowance
    stray[1:] |= np.diff(index) < 1
    gaps = np.flatnonzero(np.diff(index) > 1)
    if 0 < np.count_nonzero(stray) <= MAX_STRAY_SHARE * len(stamps):
        raise _stray_error(path, stamps, stray, 1 / period)
    if stray.any() or gaps.size > max(ALWAYS_ALLOWED_GAPS, MAX_GAP_SHARE * len(stamps)):
        raise _uneven_error(path, stamps)
    index -= index[0]
    return SampleGrid(1 / period, index, tuple(_gap_events(index, gaps, period)))


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
    """Value of the last decimal that the stamps are written with, or how finely they can be told apart."""
    finest = float(np.spacing(np.abs(stamps).max()))
    for decimals in range(10):
        unit = 10.0**-decimals
        if unit < 8 * finest:
            break
        if np.allclose(stamps, np.round(stamps, decimals), rtol=0, atol=4 * finest):
            return unit
    return 8 * finest


def _round_period(period: float, uncertainty: float) -> float:
    """Roundest rate or period, in that order, that the stamps cannot tell from `period`."""
    for digits in range(1, 12):
        for candidate in (1 / float(f"{1 / period:.{digits}g}"), float(f"{period:.{digits}g}")):
            if abs(candidate - period) <= uncertainty:
                return candidate
    return period


def _gap_events(index: npt.NDArray[np.int64], gaps: npt.NDArray[np.intp], period: float) -> list[RunEvent]:
    lost = np.diff(index)[gaps] - 1
    return [
        RunEvent(float(index[k] + 1) * period, "gap", f"{count} samples lost, {count * period:.6g} s")
        for k, count in zip(gaps.tolist(), lost.tolist(), strict=True)
    ]


def _stray_error(path: Path, stamps: FloatArray, stray: npt.NDArray[np.bool_], rate: float) -> UnevenRowsError:
    return UnevenRowsError(
        f"{path}: {np.count_nonzero(stray)} of {len(stamps)} rows are off an even rate of {rate:.9g} Hz, the first at "
        f"{stamps[stray][0]:.9g} s; state resample_hz to have rows interpolated where they are missing, or "
        "sample_rate_hz if they were sampled evenly and only stamped late."
    )


def _uneven_error(path: Path, stamps: FloatArray) -> UnevenRowsError:
    steps = np.diff(stamps)
    part = max(1, len(steps) // 10)
    first, last = float(np.median(steps[:part])), float(np.median(steps[-part:]))
    if max(first, last) > 1.5 * min(first, last):
        how = f"rows are {first:.6g} s apart at the start and {last:.6g} s at the end"
        cut = "import each stretch on its own with from_s and to_s, or "
    else:
        how = f"rows are {steps.min():.6g} to {steps.max():.6g} s apart (median {np.median(steps):.6g} s), unevenly"
        cut = "state sample_rate_hz if the sampling was even and only its stamps are not, or "
    return UnevenRowsError(f"{path}: {how}; {cut}state resample_hz to have rows interpolated to an even rate.")


GAP_FACTOR = 5.0
"""A step longer than so many of the steps around it is a gap, which is not filled."""
MEDIAN_STEPS = 21
MIN_ROWS_AVERAGED = 3
"""From so many rows within a period on, their mean is taken, so that what is faster does not alias."""


@dataclass(frozen=True, slots=True, eq=False)
class ResampledColumns:
    """Values on an even grid, and what was done to get them there."""

    grid: SampleGrid
    columns: Mapping[str, FloatArray]


def resample(stamps: FloatArray, columns: Mapping[str, FloatArray], sample_rate_hz: float) -> ResampledColumns:
    """Bring columns to an even rate.

    A grid sample is the mean of the rows within half a period, or where these are fewer than three the
    straight line between the rows around it. Nothing is put into gaps. A column with missing values is never
    averaged, and missing around them.

    Parameters
    ----------
    stamps
        Times of the rows [s], never falling, shape `(N,)`; of rows at the same time the first counts.
    columns
        Each of shape `(N,)`.
    """
    times, first = np.unique(stamps, return_index=True)
    rate = sample_rate_hz
    count = int(np.floor((times[-1] - times[0]) * rate + 1e-9)) + 1
    index = np.arange(count, dtype=np.int64)
    at = times[0] + index / rate
    holes = _gaps_between(times, rate)
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0))
    kept = ~(holes[before] & (at > times[before]) & (at < times[before + 1])) if holes.size else np.ones(count, bool)
    index, at = index[kept], at[kept]
    edges = np.searchsorted(times, np.stack((at - 0.5 / rate, at + 0.5 / rate)))
    rows = edges[1] - edges[0]
    averaged = {name: _column_at(times, values[first], at, edges, rows) for name, values in columns.items()}
    return ResampledColumns(SampleGrid(rate, index, tuple(_resample_events(times, at, rows, holes, rate))), averaged)


def _column_at(
    times: FloatArray,
    values: FloatArray,
    at: FloatArray,
    edges: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> FloatArray:
    result = np.asarray(np.interp(at, times, values), dtype=np.float64)
    if not np.isfinite(values).all():
        return result
    many = rows >= MIN_ROWS_AVERAGED
    sums = np.concatenate(([0.0], np.cumsum(values - values[0])))
    start, stop = edges[:, many]
    result[many] = values[0] + (sums[stop] - sums[start]) / rows[many]
    return result


def _gaps_between(times: FloatArray, rate: float) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    from scipy.ndimage import median_filter

    steps = np.diff(times)
    if not steps.size:
        return steps > 0
    around = median_filter(steps, size=MEDIAN_STEPS, mode="nearest")
    return np.asarray(steps > np.maximum(GAP_FACTOR * around, 1 / rate))


def _resample_events(
    times: FloatArray,
    at: FloatArray,
    rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    holes: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    rate: float,
) -> list[RunEvent]:
    begin = times[0]
    means, lines = int(np.count_nonzero(rows >= MIN_ROWS_AVERAGED)), int(np.count_nonzero(rows < MIN_ROWS_AVERAGED))
    message = (
        f"resampled to {rate:g} Hz from {len(times)} rows: {means} samples are means of rows, {lines} interpolated"
    )
    events = [RunEvent(0.0, IMPORT_EVENT, message)]
    invented = int(
        np.count_nonzero(np.diff(times)[np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)] > 1.5 / rate)
    )
    if invented:
        message = f"{invented} samples stand between rows that are further apart than the new period: not measured"
        events.append(RunEvent(0.0, IMPORT_EVENT, message))
    for k in np.flatnonzero(holes).tolist():
        message = f"no rows for {times[k + 1] - times[k]:.6g} s: left empty"
        events.append(RunEvent(float(times[k] - begin), "gap", message))
    return events


SPEED_WINDOW_S = 0.05
MIN_WINDOW_SAMPLES = 7
MOVING_SHARE = 0.05
"""Part of the top speed above which the stage is moving."""
STEADY_TOLERANCE = 0.1
"""How far a speed may be off the plateau and still be steady."""
MIN_PLATEAU_SHARE = 0.5
"""Part of the motion that must be steady, for it to be one move at one speed."""


def detect_phases(position: FloatArray, sample_rate_hz: float, gaps: npt.ArrayLike = ()) -> PhaseArray | None:
    """Find rest, run-up, steady sliding, run-down and hold of a single move at one speed.

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
        setting = SavgolSettings(window_samples=window, order=1, derivative=1)
        speed = smooth(position, sample_rate_hz, setting, gaps).values
    except AnalysisError:
        return None
    if not np.isfinite(speed).all():
        return None
    moving = np.abs(speed) > MOVING_SHARE * np.quantile(np.abs(speed), 0.98)
    runs = [(start, stop) for start, stop in _true_spans(moving) if stop - start > window]
    if len(runs) != 1 or (runs[0][0] == 0 and runs[0][1] == len(speed)):
        return None
    start, stop = runs[0]
    plateau = float(np.median(speed[start:stop]))
    steady = _true_spans(np.abs(speed[start:stop] - plateau) < STEADY_TOLERANCE * abs(plateau))
    first, last = max(steady, key=lambda run: run[1] - run[0], default=(0, 0))
    if last - first < MIN_PLATEAU_SHARE * (stop - start):
        return None
    phase = np.full(len(position), int(Phase.REST), dtype=np.uint8)
    phase[start : start + first] = int(Phase.ACCELERATE)
    phase[start + first : start + last] = int(Phase.STEADY)
    phase[start + last : stop] = int(Phase.DECELERATE)
    phase[stop:] = int(Phase.HOLD)
    return phase


def _true_spans(true: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    return list(finite_spans(np.where(true, 0.0, np.nan)))


RESERVED_NAMES = frozenset({*TARGET_UNITS, "phase"})
SIGNAL_CHANNELS = ("force", "motor_force")


@dataclass(frozen=True, slots=True, eq=False)
class ConvertedMeasurement:
    """What a run file needs: `columns` by dataset, `channels` those that are recorded quantities."""

    sample_rate_hz: float
    channels: tuple[Channel, ...]
    columns: Mapping[str, AnyFloatArray | PhaseArray]
    events: tuple[RunEvent, ...]
    origin_mm: float = 0.0
    time_origin_s: float = 0.0
    sources: Mapping[str, str] = field(default_factory=dict)
    """In words, which column each quantity came from and how."""


@dataclass(frozen=True, slots=True, eq=False)
class _MappedColumn:
    """A column that was found for a quantity."""

    column: ForeignColumn
    unit: str
    scale: UnitScale

    @property
    def of_other_kind(self) -> bool:
        """Whether a stated factor, not the unit, makes it ours; the column is then kept as it is, too."""
        return all(canonical_unit(self.unit) not in units for units in CONVERTIBLE_UNITS.values())

    def __str__(self) -> str:
        offset = f" + {self.scale.offset:g}" if self.scale.offset else ""
        return f"{self.column.name!r} in {self.unit or '?'} × {self.scale.factor:g}{offset}"


def convert_table(table: ForeignTable, settings: ImportSettings) -> ConvertedMeasurement:
    """Map, convert and put onto an even grid.

    Raises
    ------
    ImportDataError
        When a column is missing, holds text or gaps where numbers are needed, its unit is not understood,
        or rows are unevenly spaced and nobody asked for resampling.
    """
    sources = settings.columns.mapped() or guess_columns(table).mapped()
    mapped = {name: _map_column(table, name, source) for name, source in sources.items()}
    if not any(name in mapped for name in SIGNAL_CHANNELS):
        names = ", ".join(repr(column.name) for column in table.columns)
        raise ImportDataError(
            f"{table.path}: no column is mapped to force or motor_force; map one of {names}, as in "
            f"force={table.columns[-1].name!r}:N."
        )
    values = {name: _converted_values(table, one) for name, one in mapped.items()}
    further, events = _extra_channels(table, mapped)
    values |= {name: column.values for name, column in further.items()}
    stamps, rows = _select_rows(table, settings, values.pop("time", None))
    values = {name: array[rows] for name, array in values.items()}
    grid, values = _on_grid(table, settings, stamps, values)
    events += [*grid.events, *(RunEvent(0.0, IMPORT_EVENT, str(said)) for said in _scale_remarks(mapped))]
    position, command, origin_mm, said = _position_and_command(values, grid, steady=settings.steady)
    events += said
    phase = detect_phases(position, grid.sample_rate_hz, gap_starts(grid.time, grid.sample_rate_hz))
    if phase is None:
        phase = np.full(len(position), int(Phase.STEADY), dtype=np.uint8)
        events.append(
            RunEvent(0.0, IMPORT_EVENT, "no single move between standstills seen: all of it counts as steady")
        )
    else:
        events.append(RunEvent(0.0, IMPORT_EVENT, "phases found from the position"))
    units = {name: column.units for name, column in further.items()}
    channels = [Channel(name, TARGET_UNITS.get(name) or units[name], "float64") for name in values]
    if "position" not in values:
        channels.append(Channel("position", "mm", "float64"))
    columns: dict[str, AnyFloatArray | PhaseArray]
    columns = {**values, "time": grid.time, "position": position, "command": command, "phase": phase}
    return ConvertedMeasurement(
        sample_rate_hz=grid.sample_rate_hz,
        channels=tuple(channel for channel in channels if channel.name != "command"),
        columns=columns,
        events=tuple(sorted(events, key=lambda event: event.time_s)),
        origin_mm=origin_mm,
        time_origin_s=float(stamps[0]) if stamps is not None and len(stamps) else 0.0,
        sources={name: str(one) for name, one in mapped.items()},
    )


def _map_column(table: ForeignTable, quantity: str, source: ColumnSource) -> _MappedColumn:
    column = table.column(source.column)
    unit = source.unit or column.units
    if not unit and source.factor is None:
        raise ImportDataError(
            f"{table.path}: column {column.name!r} does not say its unit; state it, as in "
            f"{quantity}={column.name!r}:{TARGET_UNITS[quantity]}."
        )
    try:
        return _MappedColumn(column, unit, unit_scale(quantity, unit, source.factor, source.offset))
    except ImportDataError as error:
        raise ImportDataError(f"{table.path}: column {column.name!r}: {error}.") from error


def _converted_values(table: ForeignTable, mapped: _MappedColumn) -> FloatArray:
    return mapped.scale.apply(table.numbers(mapped.column, whole=True))


def _extra_channels(
    table: ForeignTable, mapped: Mapping[str, _MappedColumn]
) -> tuple[dict[str, ForeignColumn], list[RunEvent]]:
    """Columns of numbers that are kept as they are, by the name of their channel."""
    used = {id(one.column) for one in mapped.values() if not one.of_other_kind}
    stated = {id(one.column): one.unit for one in mapped.values()}
    kept: dict[str, ForeignColumn] = {}
    events: list[RunEvent] = []
    for column in table.columns:
        if id(column) in used:
            continue
        if column.bad is not None:
            message = f"column {column.name!r:.60} holds text and was left out"
            events.append(RunEvent(0.0, IMPORT_EVENT, message))
            continue
        name = re.sub(r"[^\w.-]+", "_", column.label).strip("_.") or "column"
        while name in RESERVED_NAMES or name in kept:
            name += "_as_read"
        kept[name] = replace(column, units=stated.get(id(column), column.units))
    return kept, events


def _select_rows(
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
    check_time_order(table, stamps[: rows.stop])
    return stamps[rows], rows


def _on_grid(
    table: ForeignTable, settings: ImportSettings, stamps: FloatArray | None, values: dict[str, FloatArray]
) -> tuple[SampleGrid, dict[str, FloatArray]]:
    rows = len(next(iter(values.values())))
    stated = settings.sample_rate_hz or (table.sample_rate_hz if stamps is None else None)
    if settings.resample_hz is not None and stamps is not None:
        resampled = resample(stamps, values, settings.resample_hz)
        return resampled.grid, dict(resampled.columns)
    if stated is not None:
        return counted_grid(table.path, stamps, rows, stated), values
    if stamps is None:
        raise ImportDataError(
            f"{table.path}: no column is mapped to time and no sample_rate_hz is given; map one, as in "
            f"time={table.columns[0].name!r}:s."
        )
    return fit_sample_grid(table.path, stamps, settings.tolerance), values


def _position_and_command(
    values: Mapping[str, FloatArray], grid: SampleGrid, *, steady: bool
) -> tuple[FloatArray, FloatArray, float, list[RunEvent]]:
    """Position and command from where the run starts, that place, and what is to be said of them."""
    rows = len(next(iter(values.values())))
    position, command = values.get("position"), values.get("command")
    said: list[RunEvent] = []
    if position is None:
        position = np.full(rows, np.nan)
        said.append(RunEvent(0.0, IMPORT_EVENT, "no position in the file: position is missing (NaN)"))
    if command is None and steady:
        command, speed_mm_s = _straight_line(grid.time, position)
        message = f"no command in the file: the straight line at {speed_mm_s:.6g} mm/s through the position, as stated"
        said.append(RunEvent(0.0, IMPORT_EVENT, message))
    elif command is None:
        command = position
        said.append(RunEvent(0.0, IMPORT_EVENT, "no command in the file: the position stands for it"))
    first = position[0] if np.isfinite(position[0]) else command[0]
    origin_mm = float(first) if np.isfinite(first) else 0.0
    return position - origin_mm, command - origin_mm, origin_mm, said


def _straight_line(time_s: FloatArray, position: FloatArray) -> tuple[FloatArray, float]:
    """Return the straight line that is nearest to a position, and its slope; missing positions are left out."""
    seen = np.isfinite(position)
    if np.count_nonzero(seen) < 2:
        return np.full_like(position, np.nan), float("nan")
    line = np.polynomial.Polynomial.fit(time_s[seen], position[seen], 1)
    return np.asarray(line(time_s), dtype=np.float64), float(line.deriv()(0.0))


def _scale_remarks(mapped: Mapping[str, _MappedColumn]) -> list[str]:
    """Say which quantities exist only by a factor that somebody stated."""
    return [
        f"{name} is {one} {TARGET_UNITS[name]}: a stated factor" for name, one in mapped.items() if one.of_other_kind
    ]
