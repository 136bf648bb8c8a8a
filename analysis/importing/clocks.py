"""Clocks of foreign files: dates, times of day, elapsed times, counters and serial numbers of days become seconds."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, tzinfo
from math import floor, log10
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.foreign import ForeignColumn
from dragrig.rig import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

DAY_S = 86_400.0
HOUR_S = 3_600.0
COUNTER_BITS = (16, 24, 32)
"""Widths of counters that wrap within a recording: microseconds in 32 bits after 72 minutes."""
MIN_COUNTER_SHARE = 0.75
"""Share of its range that a counter must have covered before a fall counts as wrapping."""
MIN_STRETCH_ROWS = 3
"""Rows that a clock which begins anew stays behind."""
MIXED_FORMATS = (
    "%d.%m.%y %H:%M:%S", "%d.%m.%y %H:%M", "%m/%d/%y %H:%M:%S", "%d/%m/%y %H:%M:%S", "%m/%d/%y %I:%M:%S %p", "%d.%m.%y",
)  # fmt: skip
"""Dates with years of two digits, which pandas does not guess."""

_TIME_OF_DAY = r"^(?P<h>\d{1,3}):(?P<m>[0-5]?\d):(?P<s>[0-5]?\d(?:[.,]\d*)?)$"
_MINUTES = r"^(?P<m>\d{1,4}):(?P<s>[0-5]?\d(?:[.,]\d*)?)$"


@dataclass(frozen=True, slots=True, eq=False)
class RowTimes:
    """Times of the rows, shape `(N,)`, NaN where there is none."""

    seconds: FloatArray
    """Since the first row of a date, since midnight for a time of day, as counted for anything else."""
    begins_at: datetime | None = None
    """When the first row was measured, with a time zone; None where no date is known."""
    is_date: bool = False
    """Whether the cells are days without a time."""
    is_time_of_day: bool = False
    """Whether the cells are hours, minutes and seconds, which a date beside them completes."""
    remarks: tuple[str, ...] = ()
    """How ambiguous cells were read."""

    def column(self, name: str) -> ForeignColumn:
        """Return the clock as a column, of seconds since the first row."""
        known = np.flatnonzero(np.isfinite(self.seconds))
        seconds = self.seconds - self.seconds[known[0]] if known.size else self.seconds
        return ForeignColumn(name, "s", seconds, begins_at=self.begins_at, remarks=self.remarks)


@dataclass(frozen=True, slots=True)
class _Epoch:
    """A count since a fixed moment, recognised by its magnitude where `low` ≤ count [s] < `high`."""

    name: str
    units: tuple[str, ...]
    low: float
    high: float
    zero_s: float
    """What is subtracted for seconds since 1970."""
    is_local: bool = False
    needs_unit: bool = False


_UNIX_2000_S, _UNIX_2065_S = 946_684_800.0, 3_000_000_000.0
_EPOCHS = (
    _Epoch("Unix time", ("s", "ms", "µs", "ns"), _UNIX_2000_S, _UNIX_2065_S, 0.0),
    # LabVIEW counts seconds since 1904-01-01 UTC; MATLAB days since the year 0, Excel since 1899-12-30, both local.
    _Epoch("LabVIEW time", ("s",), _UNIX_2000_S + 2_082_844_800.0, _UNIX_2065_S + 2_082_844_800.0, 2_082_844_800.0),
    _Epoch("MATLAB datenum", ("d",), 730_486 * DAY_S, 754_000 * DAY_S, 719_529 * DAY_S, is_local=True),
    _Epoch("serial date of a spreadsheet", ("d",), 36_526 * DAY_S, 60_000 * DAY_S, 25_569 * DAY_S, True, True),
)
_SECONDS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9, "d": DAY_S}


def epoch_clock(values: FloatArray, unit: str) -> RowTimes | None:
    """Recognise a count since a fixed moment by its magnitude.

    Parameters
    ----------
    values
        Shape `(N,)`, rising; NaN where there is none.
    unit
        Of the values; where it is not stated, the only unit in which they are a date of these decades. Days are then
        MATLAB's alone: a count of 46,000 may be anything.

    Returns
    -------
    RowTimes or None
        Seconds since the first row; None for an elapsed time.
    """
    first, last = float(np.nanmin(values)), float(np.nanmax(values))
    for epoch in _EPOCHS:
        for known in epoch.units:
            scale = _SECONDS[known]
            is_possible = unit == known or not (unit or epoch.needs_unit)
            if not is_possible or not epoch.low <= first * scale <= last * scale < epoch.high:
                continue
            # The last digit of a large count is coarse: ten microseconds in days since the year 0.
            decimals = floor(-log10(2 * float(np.spacing(last)) * scale))
            begin = float(values[np.isfinite(values)][0])
            seconds = np.round((values - begin) * scale, decimals)
            moment = datetime.fromtimestamp(0, UTC) + timedelta(seconds=begin * scale - epoch.zero_s)
            rounded = moment.replace(microsecond=0) + timedelta(microseconds=round(moment.microsecond, -1))
            moment = rounded if epoch.is_local else moment
            begins = moment.replace(tzinfo=None).astimezone() if epoch.is_local else moment
            return RowTimes(seconds, begins, remarks=(f"time is {epoch.name} in {known}",))
    return None


def unwrapped(values: FloatArray, turn: float | None = None) -> tuple[FloatArray, str]:
    """Continue a counter over its wraps, or an angle from `turn` to turn.

    Returns
    -------
    The values as they came, or continued, and then a remark.
    """
    if len(values) < 3 or not np.isfinite(values).all():
        return values, ""
    steps, low, high = np.diff(values), float(values.min()), float(values.max())
    periods = {turn: "an angle"} if turn else {}
    if (values == np.rint(values)).all():
        periods |= {2.0**bits: f"a counter of {bits} bits" for bits in COUNTER_BITS}
    for period, kind in periods.items():
        most = 1.001 * period  # for the last digit of an angle may be rounded up
        if not (low >= 0 and high < most) and not (-most / 2 <= low and high < most / 2):
            continue
        wraps = np.abs(steps) > MIN_COUNTER_SHARE * period
        ordinary = float(np.abs(steps[~wraps]).max(initial=0.0))
        after = np.abs(np.abs(steps[wraps]) - period)
        # A wrap goes on at the pace of the counter; a clock that begins anew would have to do so by chance.
        if wraps.any() and ordinary < period / 8 and (after <= 3 * max(ordinary, min(1.0, period / 100))).all():
            turns = np.concatenate(([0.0], np.cumsum(-np.sign(steps) * wraps)))
            return values + turns * period, f"{kind} is continued over {int(wraps.sum())} of its ends"
    return values, ""


def moments_column(name: str, moments: npt.NDArray[np.generic], zone: tzinfo | None = None) -> ForeignColumn:
    """Return a column of dates and times as seconds since the first, or of durations as seconds.

    Parameters
    ----------
    moments
        Shape `(N,)`, of the type datetime64 or timedelta64; NaT becomes NaN.
    zone
        That of the stamps; None for the local time of this computer.
    """
    if moments.dtype.kind == "m":
        return ForeignColumn(name, "s", np.asarray(np.divide(moments, np.timedelta64(1, "s")), dtype=np.float64))
    return _moments_clock(moments, zone).column(name)


def moment_of(stamp: np.generic, zone: tzinfo | None = None) -> datetime | None:
    """Return a datetime64 as a date and time with its zone (None: local time); None outside the years 1 to 9999."""
    moment: object = stamp.astype("datetime64[us]").item()
    if not isinstance(moment, datetime):
        return None
    try:
        return moment.replace(tzinfo=zone) if zone else moment.astimezone()
    except (OverflowError, OSError, ValueError):
        return None


def _moments_clock(moments: npt.NDArray[np.generic], zone: tzinfo | None = None) -> RowTimes:
    known = np.flatnonzero(~np.isnat(moments))
    if not known.size:
        return RowTimes(np.full(len(moments), np.nan))
    first = moments[known[0]]
    seconds = np.asarray((moments - first) / np.timedelta64(1, "s"), dtype=np.float64)
    begin = moment_of(first, zone)
    if zone is not None:
        return RowTimes(seconds, begin)
    is_date = bool((moments[known] == moments[known].astype("datetime64[D]")).all())
    seconds, remarks = _over_changed_clocks(seconds, moments)
    return RowTimes(seconds, begin, is_date=is_date, remarks=remarks)


def _over_changed_clocks(seconds: FloatArray, moments: npt.NDArray[np.generic]) -> tuple[FloatArray, tuple[str, ...]]:
    """Close the hour that local time gains or loses where the clocks are changed.

    Only a jump of one hour to within the rows' spacing counts, at the full hour at which clocks change: whichever zone
    the file comes from.
    """
    steps = np.diff(seconds)
    usual = float(np.median(np.abs(steps))) if steps.size else 0.0
    jumps = np.flatnonzero(np.abs(np.abs(steps) - HOUR_S) <= max(2 * usual, 1.0))
    if usual > HOUR_S / 4 or not jumps.size:
        return seconds, ()
    after = (moments - moments.astype("datetime64[h]")) / np.timedelta64(1, "s")
    changes = [int(jump) for jump in jumps if after[jump + 1] <= max(2 * usual, 1.0)]
    shift = np.zeros(len(seconds))
    for jump in changes:
        shift[jump + 1 :] -= np.copysign(HOUR_S, steps[jump])
    told = tuple(f"the clocks were changed at row {jump + 2}: the hour is taken out" for jump in changes)
    return seconds + shift, told


def read_clock(texts: "pa.StringArray") -> RowTimes | None:
    """Read cells that are all empty or a date, a date with a time, a time of day or an elapsed time; else None."""
    import pyarrow.compute as pc

    filled = texts.filter(pc.not_equal(texts, ""))
    if not len(filled) or not any(mark in filled[0].as_py() for mark in ":-/.P "):
        return None
    # Data loggers part milliseconds as they part seconds.
    texts = pc.replace_substring_regex(texts, r"(:\d\d)[: ](\d{3})$", r"\1.\2")
    if ":" in filled[0].as_py()[:3] and filled[0].as_py().upper().endswith("M"):
        return _of_half_days(texts)
    return _divided(texts) or _dated(texts)


def _of_half_days(texts: "pa.StringArray") -> RowTimes | None:
    """Read times of day with AM and PM, as those of any day."""
    import pyarrow.compute as pc

    clock = _dated(pc.binary_join_element_wise("1/1/2000", texts, " "))
    if clock is None or clock.begins_at is None:
        return None
    begin = clock.begins_at.replace(tzinfo=None) - datetime(2000, 1, 1)  # noqa: DTZ001
    return RowTimes(_over_midnight(clock.seconds + begin.total_seconds()), is_time_of_day=True)


def _over_midnight(seconds: FloatArray, period_s: float = DAY_S, fall: float = 0.5) -> FloatArray:
    """Let the clock go on where it falls by so much of its period: after midnight, or the full hour."""
    return seconds + period_s * np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -fall * period_s)


def _divided(texts: "pa.StringArray") -> RowTimes | None:
    """Hours, minutes and seconds with colons between them."""
    import pyarrow.compute as pc

    is_empty = np.asarray(np.from_dlpack(pc.binary_length(texts)) == 0)
    for pattern, scales in ((_TIME_OF_DAY, (HOUR_S, 60.0, 1.0)), (_MINUTES, (60.0, 1.0))):
        parts = pc.extract_regex(texts, pattern)
        if not (np.asarray(parts.is_valid(), dtype=np.bool_) | is_empty).all():
            continue
        fields = (pc.struct_field(parts, number) for number in range(len(scales)))
        numbers = (pc.cast(pc.replace_substring(part, ",", "."), "float64") for part in fields)
        columns = (np.asarray(part.to_numpy(zero_copy_only=False), dtype=np.float64) for part in numbers)
        seconds = np.sum([column * scale for column, scale in zip(columns, scales, strict=True)], axis=0)
        seconds = _over_midnight(seconds) if len(scales) == 3 else _over_midnight(seconds, HOUR_S, 0.95)
        remarks = () if len(scales) == 3 else (f"{texts[len(texts) - 1].as_py()} is read as minutes and seconds",)
        return RowTimes(seconds, is_time_of_day=len(scales) == 3, remarks=remarks)
    return None


def _dated(texts: "pa.StringArray") -> RowTimes | None:
    """Dates in any of the usual forms, by pandas; dates that the order of day and month leaves open are told."""
    import pandas as pd
    import pyarrow.compute as pc
    from pandas.tseries.api import guess_datetime_format

    plain = pc.replace_substring_regex(texts, r"(\d),(\d)", r"\1.\2")
    plain = pc.replace_substring_regex(plain, r"\s*(UTC|GMT)$", "Z")
    for half in "ap":
        plain = pc.replace_substring_regex(plain, rf"(?i)\s*{half}\.?m\.?$", f" {half.upper()}M")
    cells = pd.Series(plain.to_pandas()).replace("", None)
    filled = cells.dropna()
    first = str(filled.iloc[0])
    if first[:1] == "P" or "day" in first:
        lengths_s = pd.to_timedelta(cells, errors="coerce").dt.total_seconds()
        return None if lengths_s[filled.index].isna().any() else RowTimes(np.asarray(lengths_s, dtype=np.float64))
    if first[:4].isdigit() and (iso := _moments(cells, "ISO8601")) is not None:
        return iso
    is_american = first.endswith("M")
    orders = (True,) if "." in first[:3] else (False,) if is_american or first[:4].isdigit() else (False, True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where only the other order is a date
        # pandas guesses no hour that it counts otherwise.
        known = re.sub(r"\b12:", "11:", first.replace("PM", "AM")) if is_american else first
        guesses = dict.fromkeys(guess_datetime_format(known, dayfirst=day_first) for day_first in orders)
    formats = [known for known in guesses if known] or list(MIXED_FORMATS)
    clocks = [clock for known in formats if (clock := _moments(cells, known)) is not None]
    if not clocks:
        return None
    # Of day and month in either order, the right one gives the recording that is short.
    spans = [float(np.nanmax(clock.seconds) - np.nanmin(clock.seconds)) for clock in clocks]
    chosen = clocks[int(np.argmin(spans))]
    if min(spans) == max(spans) and len({clock.begins_at for clock in clocks}) > 1:
        told = f"{first} may have day or month first: the date is not known (--start-time states it)"
        return replace(chosen, begins_at=None, remarks=(*chosen.remarks, told))
    return chosen


def _moments(cells: "pd.Series", known: str) -> RowTimes | None:
    """Read dates by a format, whose fraction of a second and long month's name are optional."""
    import pandas as pd

    is_filled = cells.notna()
    with_zone = "%z" in known or bool(cells[is_filled].str.contains(r":.*(?:Z|[-+]\d\d:?\d\d)$").iloc[0])
    others = (known.replace("%S.%f", "%S"), known.replace("%S", "%S.%f"), known.replace("%B", "%b"))
    moments: pd.Series[pd.Timestamp] | None = None
    for form in (known, *others) if known != "ISO8601" else (known,):
        if form.count("%f") < 2 and (moments is None or moments[is_filled].isna().any()):
            try:
                read = pd.to_datetime(cells, format=form, errors="coerce", utc=with_zone).dt.as_unit("ns")
            except pd.errors.OutOfBoundsDatetime:
                return None  # before 1677 or after 2262, and so no time of a measurement
            moments = read if moments is None else moments.fillna(read)
    if moments is None or moments[is_filled].isna().any():
        return None
    plain = moments.dt.tz_convert(None) if with_zone else moments
    return _moments_clock(plain.to_numpy(dtype="datetime64[ns]"), UTC if with_zone else None)


def joined(date: RowTimes, time: RowTimes) -> RowTimes:
    """Return the clock of a column of days and one of times of day."""
    midnight = date.begins_at.replace(tzinfo=None) if date.begins_at is not None else None
    first = int(np.isfinite(time.seconds).argmax())
    # A day may be written once, for all rows below it.
    latest = np.maximum.accumulate(np.where(np.isfinite(date.seconds), np.arange(len(date.seconds)), 0))
    seconds = date.seconds[latest] + np.mod(time.seconds, DAY_S)
    begin = (
        None if midnight is None else moment_of(np.datetime64(midnight + timedelta(seconds=float(time.seconds[first]))))
    )
    return RowTimes(seconds - seconds[first], begin, remarks=(*date.remarks, *time.remarks))


def restarts(seconds: FloatArray) -> Sequence[slice]:
    """Return the stretches of rows between which the clock begins anew.

    It falls by more than a tenth of the stretch before, and is not back in a few rows, as after a late stamp.
    """
    falls = np.flatnonzero(np.diff(seconds) < 0) + 1
    begins = [0]
    for row in falls.tolist():
        first, last = seconds[begins[-1]], seconds[row - 1]
        next_rows = seconds[row : row + MIN_STRETCH_ROWS]
        if len(next_rows) == MIN_STRETCH_ROWS and first < last and next_rows.max() < last - (last - first) / 10:
            begins.append(row)
    return [slice(begin, end) for begin, end in zip(begins, [*begins[1:], len(seconds)], strict=True)]
