"""Rows at uneven times brought to an even rate, when somebody asks for it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.importing.timebase import IMPORT_EVENT, Grid
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Event

HOLE = 5.0
"""A step longer than so many of the steps around it is a gap, which is not filled."""
NEIGHBOURS = 21
FEWEST_AVERAGED = 3
"""From so many rows within a period on, their mean is taken, so that what is faster does not alias."""


@dataclass(frozen=True, slots=True, eq=False)
class Resampled:
    """Values on an even grid, and what was done to get them there."""

    grid: Grid
    columns: Mapping[str, FloatArray]


def resample(stamps: FloatArray, columns: Mapping[str, FloatArray], sample_rate_hz: float) -> Resampled:
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
    holes = _holes(times, rate)
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0))
    kept = ~(holes[before] & (at > times[before]) & (at < times[before + 1])) if holes.size else np.ones(count, bool)
    index, at = index[kept], at[kept]
    edges = np.searchsorted(times, np.stack((at - 0.5 / rate, at + 0.5 / rate)))
    rows = edges[1] - edges[0]
    averaged = {name: _at(times, values[first], at, edges, rows) for name, values in columns.items()}
    return Resampled(Grid(rate, index, tuple(_events(times, at, rows, holes, rate))), averaged)


def _at(
    times: FloatArray,
    values: FloatArray,
    at: FloatArray,
    edges: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
) -> FloatArray:
    result = np.asarray(np.interp(at, times, values), dtype=np.float64)
    if not np.isfinite(values).all():
        return result
    many = rows >= FEWEST_AVERAGED
    sums = np.concatenate(([0.0], np.cumsum(values - values[0])))
    start, stop = edges[:, many]
    result[many] = values[0] + (sums[stop] - sums[start]) / rows[many]
    return result


def _holes(times: FloatArray, rate: float) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    from scipy.ndimage import median_filter

    steps = np.diff(times)
    if not steps.size:
        return steps > 0
    around = median_filter(steps, size=NEIGHBOURS, mode="nearest")
    return np.asarray(steps > np.maximum(HOLE * around, 1 / rate))


def _events(
    times: FloatArray,
    at: FloatArray,
    rows: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    holes: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    rate: float,
) -> list[Event]:
    begin = times[0]
    means, lines = int(np.count_nonzero(rows >= FEWEST_AVERAGED)), int(np.count_nonzero(rows < FEWEST_AVERAGED))
    message = (
        f"resampled to {rate:g} Hz from {len(times)} rows: {means} samples are means of rows, {lines} interpolated"
    )
    events = [Event(0.0, IMPORT_EVENT, message)]
    invented = int(
        np.count_nonzero(np.diff(times)[np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)] > 1.5 / rate)
    )
    if invented:
        message = f"{invented} samples stand between rows that are further apart than the new period: not measured"
        events.append(Event(0.0, IMPORT_EVENT, message))
    for k in np.flatnonzero(holes).tolist():
        message = f"no rows for {times[k + 1] - times[k]:.6g} s: left empty"
        events.append(Event(float(times[k] - begin), "gap", message))
    return events
