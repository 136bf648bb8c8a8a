"""Time stamps of a foreign file turned into sample numbers on an even grid, or refused with the reason.

Instruments write time in three ways. Most stamp rows evenly, to within their last digit. Some leave rows
out: the stamps jump by a whole number of periods, which becomes a gap. Programs that stamp rows as these
come off a bus stamp some late and the rows behind them in a burst, though every sample was taken on time: then as
many rows stand between two punctual ones as there are periods, and each late row belongs where it is
counted. A stamp can be late but never early; so a row's place cannot lie after the place that any later row's
stamp allows, and the latest place so allowed is taken. Whatever fits none of these is uneven.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.config.errors import ImportDataError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Event

MOST_LATE = 0.01
"""Part of the rows that may be stamped late."""
MOST_GAPS = 0.01
FEW_GAPS = 10
"""Fewer gaps than this are never too many, however short the file."""
IMPORT_EVENT = "import"


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Rows on an even grid: `index` counts periods from the first row, shape `(N,)`, rising."""

    sample_rate_hz: float
    index: npt.NDArray[np.int64]
    events: tuple[Event, ...] = ()

    @property
    def time(self) -> FloatArray:
        """Time since the first row [s]."""
        return np.asarray(self.index / self.sample_rate_hz, dtype=np.float64)


class UnevenError(ImportDataError):
    """Rows that do not stand on an even grid."""


def check_order(table: ForeignTable, stamps: FloatArray) -> None:
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


def counted(path: Path, stamps: FloatArray | None, rows: int, sample_rate_hz: float) -> Grid:
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
    return Grid(sample_rate_hz, np.arange(rows, dtype=np.int64), (Event(0.0, IMPORT_EVENT, message),))


def fit_grid(path: Path, stamps: FloatArray, tolerance: float) -> Grid:
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
        raise UnevenError(
            f"{path}: several rows have the time {stamps[row]:.9g} s; where the clock is coarser than the sampling, "
            "state sample_rate_hz, so that rows are counted."
        )
    digit = _last_digit(stamps)
    period = _rounded(_period(stamps), 2 * digit / len(stamps))
    place = (stamps - stamps[0]) / period - np.arange(len(stamps))
    allowed = np.minimum.accumulate(place[::-1])[::-1]
    shift = np.floor(allowed - allowed[0] + 0.5)
    late = place - shift
    late -= np.median(late)
    allowance = min(0.49, max(tolerance, 0.51 * digit / period))
    is_late, lost = late > allowance, np.diff(shift)
    gaps = np.flatnonzero(lost > 0)
    if (
        np.count_nonzero(is_late) > MOST_LATE * len(stamps)
        or (late < -allowance).any()
        or gaps.size > max(FEW_GAPS, MOST_GAPS * len(stamps))
    ):
        raise _uneven(path, stamps)
    index = (np.arange(len(stamps)) + shift - shift[0]).astype(np.int64)
    return Grid(1 / period, index, tuple(_events(index, lost, gaps, late, is_late, period)))


def _period(stamps: FloatArray) -> float:
    """Median spacing, refined over ever longer lags; lags across gaps count as that many more periods."""
    period = float(np.median(np.diff(stamps)))
    lag = 2
    while lag <= len(stamps) // 2:
        spans = stamps[lag:] - stamps[:-lag]
        period = float(np.median(spans / np.maximum(np.round(spans / period), 1)))
        lag *= 2
    return period


def _last_digit(stamps: FloatArray) -> float:
    """Value of the last decimal that the stamps are written with, or how finely they can be told apart."""
    finest = float(np.spacing(np.abs(stamps).max()))
    for decimals in range(10):
        unit = 10.0**-decimals
        if unit < 8 * finest:
            break
        if np.allclose(stamps, np.round(stamps, decimals), rtol=0, atol=4 * finest):
            return unit
    return 8 * finest


def _rounded(period: float, uncertainty: float) -> float:
    """Roundest rate or period, in that order, that the stamps cannot tell from `period`."""
    for digits in range(1, 12):
        for candidate in (1 / float(f"{1 / period:.{digits}g}"), float(f"{period:.{digits}g}")):
            if abs(candidate - period) <= uncertainty:
                return candidate
    return period


def _events(
    index: npt.NDArray[np.int64],
    lost: FloatArray,
    gaps: npt.NDArray[np.intp],
    late: FloatArray,
    is_late: npt.NDArray[np.bool_],
    period: float,
) -> list[Event]:
    events = [
        Event(float(index[k] + 1) * period, "gap", f"{int(lost[k])} samples lost, {lost[k] * period:.6g} s")
        for k in gaps.tolist()
    ]
    if is_late.any():
        first = int(is_late.argmax())
        message = (
            f"{int(is_late.sum())} rows were stamped up to {1e3 * period * late.max():.3g} ms late; "
            "they stand where they are counted"
        )
        events.append(Event(float(index[first]) * period, IMPORT_EVENT, message))
    return events


def _uneven(path: Path, stamps: FloatArray) -> UnevenError:
    steps = np.diff(stamps)
    part = max(1, len(steps) // 10)
    first, last = float(np.median(steps[:part])), float(np.median(steps[-part:]))
    if max(first, last) > 1.5 * min(first, last):
        how = f"rows are {first:.6g} s apart at the start and {last:.6g} s at the end"
        cut = "import each stretch on its own with from_s and to_s, or "
    else:
        how = f"rows are {steps.min():.6g} to {steps.max():.6g} s apart (median {np.median(steps):.6g} s), unevenly"
        cut = "state sample_rate_hz if the sampling was even and only its stamps are not, or "
    return UnevenError(f"{path}: {how}; {cut}state resample_hz to have rows interpolated to an even rate.")
