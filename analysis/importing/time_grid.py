"""Rows on an even time grid: found in their time stamps, counted at a stated rate, or resampled.

Most instruments stamp rows evenly, to within their last digit; some leave rows out, so that the stamps jump by
a whole number of periods, which becomes a gap. A program that stalls now and then samples late, and then in a
burst. It is tempting to move such rows back to where counting puts them, but measured positions show that they were
taken when they were stamped (a motor's, in the tests' data: the jump of the position is that of the time, not of the
count). So rows off the grid are never moved: the user either asks for resampling, or states the rate.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis import Mask
from dragrig.config import ImportDataError
from dragrig.rig import FloatArray, RunEvent

MAX_STRAY_SHARE = 0.05
"""Up to this share of rows off the grid, the message speaks of an even rate with strays."""
MAX_GAP_SHARE = 0.01
ALWAYS_ALLOWED_GAPS = 10
"""This many gaps are never too many, however short the file."""

GAP_FACTOR = 5.0
"""A step longer than this many of the steps around it is a gap, which is not filled."""
MEDIAN_STEPS = 21
MIN_ROWS_AVERAGED = 3
"""With this many rows within a period their mean is taken, so that faster signals do not alias."""


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


def counted_grid(
    path: Path, stamps: FloatArray | None, places: npt.NDArray[np.intp], sample_rate_hz: float
) -> SampleGrid:
    """Grid of rows that are evenly spaced at a stated rate, by their places among all rows, shape `(N,)`.

    Raises `ImportDataError` when the time stamps' span differs by more than 1 %, three periods and two digits.
    """
    index = np.asarray(places - places[0], dtype=np.int64)
    rows, span_s = int(index[-1]) + 1, float(index[-1]) / sample_rate_hz
    if stamps is not None and rows > 1:
        stamped_s = float(stamps[-1] - stamps[0])
        if abs(stamped_s - span_s) > 0.01 * span_s + 3 / sample_rate_hz + 2 * _time_resolution(stamps):
            raise ImportDataError(
                f"{path}: {rows} rows at {sample_rate_hz:g} Hz span {span_s:.6g} s, their time stamps {stamped_s:.6g} "
                "s; correct sample_rate_hz, or leave it out."
            )
    event = import_event(f"time counted at {sample_rate_hz:g} Hz, as stated")
    return SampleGrid(sample_rate_hz, index, (event, *_lost_samples(index, 1 / sample_rate_hz)))


def _lost_samples(index: npt.NDArray[np.int64], period: float) -> Iterator[RunEvent]:
    for row in np.flatnonzero(np.diff(index) > 1).tolist():
        count = int(index[row + 1] - index[row]) - 1
        yield RunEvent(float(index[row] + 1) * period, "gap", f"{count} samples lost, {count * period:.6g} s")


def fit_sample_grid(path: Path, stamps: FloatArray, tolerance: float, unit_s: float = 1.0) -> SampleGrid:
    """Find the even grid that time stamps lie on.

    Parameters
    ----------
    stamps
        Seconds, never falling, shape `(N,)`.
    tolerance
        Allowed distance of a stamp from the grid, in periods; the last written digit is allowed for besides.
    unit_s
        Unit that the stamps were written in: of minutes the last digit is coarser than it looks in seconds.

    Raises
    ------
    ImportDataError
        When there is no such grid; the message says how the stamps are spaced, and the remedies.
    """
    if len(stamps) < 2:
        raise ImportDataError(f"{path}: has {len(stamps)} row only, from which no sample rate follows; give more.")
    if not np.diff(stamps).all():
        row = int((np.diff(stamps) == 0).argmax())
        raise ImportDataError(
            f"{path}: several rows have the time {stamps[row]:.9g} s; where the clock is coarser than the sampling, "
            "state sample_rate_hz, so that rows are counted."
        )
    resolution = max(_time_resolution(stamps), unit_s * _time_resolution(stamps / unit_s))
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
        raise ImportDataError(
            f"{path}: {np.count_nonzero(stray)} of {len(stamps)} rows are off an even rate of {1 / period:.9g} Hz, the "
            f"first at {stamps[stray][0]:.9g} s; state resample_hz to have rows interpolated where they are missing, "
            "or sample_rate_hz if they were sampled evenly and only stamped late."
        )
    if stray.any() or gaps.size > max(ALWAYS_ALLOWED_GAPS, MAX_GAP_SHARE * len(stamps)):
        raise _uneven_error(path, stamps)
    index -= index[0]
    return SampleGrid(1 / period, index, tuple(_lost_samples(index, period)))


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


def _uneven_error(path: Path, stamps: FloatArray) -> ImportDataError:
    steps = np.diff(stamps)
    part = max(1, len(steps) // 10)
    first, last = float(np.median(steps[:part])), float(np.median(steps[-part:]))
    if max(first, last) > 1.5 * min(first, last):
        spacing = f"rows are {first:.6g} s apart at the start and {last:.6g} s at the end"
        remedy = "import each part on its own with from_s and to_s, or "
    else:
        spacing = f"rows are {steps.min():.6g} to {steps.max():.6g} s apart (median {np.median(steps):.6g} s), unevenly"
        remedy = "state sample_rate_hz if the sampling was even and only its stamps are not, or "
    return ImportDataError(f"{path}: {spacing}; {remedy}state resample_hz to have rows interpolated to an even rate.")


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
        Times of the rows [s], never falling, shape `(N,)`; between samples, rows at the same time count as their mean.
    columns
        Each of shape `(N,)`.
    """
    times, first = np.unique(stamps, return_index=True)
    at_same_time = np.diff(np.append(first, len(stamps)))
    count = int(np.floor((times[-1] - times[0]) * sample_rate_hz + 1e-9)) + 1
    index = np.arange(count, dtype=np.int64)
    at = times[0] + index / sample_rate_hz
    is_gap = _gaps_between(times, sample_rate_hz)
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0))
    if is_gap.size:
        measured = ~(is_gap[before] & (at > times[before]) & (at < times[before + 1]))
        index, at = index[measured], at[measured]
    edges = np.searchsorted(stamps, np.stack((at - 0.5 / sample_rate_hz, at + 0.5 / sample_rate_hz)))
    averaged = edges[1] - edges[0] >= MIN_ROWS_AVERAGED

    def resampled(values: FloatArray) -> FloatArray:
        means = values if len(times) == len(values) else np.add.reduceat(values, first) / at_same_time
        result = np.asarray(np.interp(at, times, means), dtype=np.float64)
        if np.isfinite(values).all():
            sums = np.concatenate(([0.0], np.cumsum(values - values[0])))
            start, stop = edges[:, averaged]
            result[averaged] = values[0] + (sums[stop] - sums[start]) / (stop - start)
        return result

    events = tuple(_resample_events(times, at, averaged, is_gap, sample_rate_hz))
    grid = SampleGrid(sample_rate_hz, index, events)
    return grid, {name: resampled(values) for name, values in columns.items()}


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
    yield import_event(
        f"resampled to {sample_rate_hz:g} Hz from {len(times)} rows: {means} samples are means of rows, "
        f"{len(at) - means} interpolated"
    )
    step_around = np.diff(times)[np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)]
    if invented := int(np.count_nonzero(step_around > 1.5 / sample_rate_hz)):
        yield import_event(
            f"{invented} samples lie between rows that are further apart than the new period: not measured"
        )
    for row in np.flatnonzero(is_gap).tolist():
        message = f"no rows for {times[row + 1] - times[row]:.6g} s: not filled"
        yield RunEvent(float(times[row] - times[0]), "gap", message)


def import_event(message: str) -> RunEvent:
    """Return an event about how a file was read, at the begin of the run."""
    return RunEvent(0.0, "import", message)
