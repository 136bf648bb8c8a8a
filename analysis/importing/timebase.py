"""Time stamps of a foreign file turned into sample numbers on an even grid, or refused with the reason.

Most instruments stamp rows evenly, to within their last digit; some leave rows out, so that the stamps jump by
a whole number of periods, which becomes a gap. A program that stalls now and then samples late, and then in a
burst. It is tempting to put such rows back where they are counted, but measured positions show that they were
taken when they say (a motor's, in the tests' data: the jump of the position is that of the time, not of the
count). So rows off the grid are never moved: either somebody asks for resampling, or states the rate.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.config.errors import ImportDataError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Event

FEW_STRAY = 0.05
"""Up to this part of all rows, those off the grid are spoken of as strays from an even rate."""
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
    # The longest lag of `_period` is at least a quarter of the rows, and both its ends are rounded.
    period = _rounded(_period(stamps), 4 * digit / len(stamps))
    place = (stamps - stamps[0]) / period
    place = place - float(np.angle(np.exp(2j * np.pi * place).mean())) / (2 * np.pi)
    index = np.round(place).astype(np.int64)
    allowance = min(0.49, max(tolerance, 0.51 * digit / period))
    stray = np.abs(place - index) > allowance
    stray[1:] |= np.diff(index) < 1
    gaps = np.flatnonzero(np.diff(index) > 1)
    if 0 < np.count_nonzero(stray) <= FEW_STRAY * len(stamps):
        raise _strays(path, stamps, stray, 1 / period)
    if stray.any() or gaps.size > max(FEW_GAPS, MOST_GAPS * len(stamps)):
        raise _uneven(path, stamps)
    index -= index[0]
    return Grid(1 / period, index, tuple(_gap_events(index, gaps, period)))


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


def _gap_events(index: npt.NDArray[np.int64], gaps: npt.NDArray[np.intp], period: float) -> list[Event]:
    lost = np.diff(index)[gaps] - 1
    return [
        Event(float(index[k] + 1) * period, "gap", f"{count} samples lost, {count * period:.6g} s")
        for k, count in zip(gaps.tolist(), lost.tolist(), strict=True)
    ]


def _strays(path: Path, stamps: FloatArray, stray: npt.NDArray[np.bool_], rate: float) -> UnevenError:
    return UnevenError(
        f"{path}: {np.count_nonzero(stray)} of {len(stamps)} rows are off an even rate of {rate:.9g} Hz, the first at "
        f"{stamps[stray][0]:.9g} s; state resample_hz to have rows interpolated where they are missing, or "
        "sample_rate_hz if they were sampled evenly and only stamped late."
    )


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
