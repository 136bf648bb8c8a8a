"""Long traces made short enough to draw, without losing an extreme or hiding a gap."""

import numpy as np

from dragrig.rig.arrays import AnyFloatArray, BoolArray, FloatArray

COLUMNS = 2000
"""Columns that an envelope keeps; about the pixels that a picture is wide."""

LATE = 1.5
"""A sample that comes so many periods after the one before it comes after a gap."""


def gap_after(time: FloatArray, sample_rate_hz: float) -> BoolArray:
    """Tell after which samples others are missing.

    Parameters
    ----------
    time
        Shape `(N,)`, rising [s].

    Returns
    -------
    Shape `(N - 1,)`. What comes later than one and a half periods, by the rate or by the time
    between samples that is usual in this trace, comes after a gap.
    """
    if time.size < 2:
        return np.zeros(0, dtype=np.bool_)
    step = np.diff(time)
    usual = max(1.0 / sample_rate_hz, float(np.median(step)))
    return np.asarray(step > LATE * usual)


def envelope(
    time: FloatArray, value: AnyFloatArray, gap: BoolArray, columns: int = COLUMNS
) -> tuple[FloatArray, FloatArray]:
    """Return a line `(t, y)` that looks like the trace at `columns` pixels' width.

    Each column keeps its smallest and its largest value. The line is broken (by NaN) at gaps and
    where the trace itself is not finite. A trace of at most `4 * columns` samples comes back whole.

    Parameters
    ----------
    time, value
        Shape `(N,)`.
    gap
        Shape `(N - 1,)`, as from `gap_after`.
    """
    finite = np.isfinite(value)
    if finite.all():
        t, y, breaks = time, value, np.flatnonzero(gap) + 1
    else:
        whole = np.flatnonzero(finite)
        lost = np.concatenate(([0], np.cumsum(gap)))
        t, y = time[whole], value[whole]
        breaks = np.flatnonzero((np.diff(whole) > 1) | (np.diff(lost[whole]) > 0)) + 1
    if t.size > 4 * columns:
        t, y, breaks = _extremes(t, y, breaks, columns)
    return np.insert(t, breaks, t[breaks]), np.insert(np.asarray(y, dtype=np.float64), breaks, np.nan)


def _extremes(
    t: FloatArray, y: AnyFloatArray, breaks: "np.ndarray[tuple[int], np.dtype[np.intp]]", columns: int
) -> tuple[FloatArray, FloatArray, "np.ndarray[tuple[int], np.dtype[np.intp]]"]:
    regular = np.searchsorted(t, np.linspace(t[0], t[-1], columns, endpoint=False))
    starts = np.union1d(regular, breaks)
    ends = np.append(starts[1:], t.size)
    low, high = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    # A rising column is drawn from below, a falling one from above, so that neighbours join up.
    rising = y[ends - 1] >= y[starts]
    line = np.empty((starts.size, 2))
    line[:, 0] = np.where(rising, low, high)
    line[:, 1] = np.where(rising, high, low)
    times = np.column_stack((t[starts], t[ends - 1]))
    return times.ravel(), line.ravel(), 2 * np.searchsorted(starts, breaks)
