"""How a position measured in counts is made smooth: rests, the ways between them, and turns.

Edges are indices of samples on a uniform grid.
"""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import BoolArray, FloatArray

IndexArray = npt.NDArray[np.intp]

ORDER = 2
"""Order of the smoothing polynomial: a ramp of constant acceleration passes unchanged."""

TURN_JITTERS = 5.0
"""A way back shorter than this many times the jitter is not a turn."""


def smooth_between_rests(
    position_mm: FloatArray, window: int, jitter_mm: float, rest_window: int | None = None
) -> tuple[FloatArray, IndexArray]:
    """Make rests exactly still and each way between turns monotone, smoothed without looking beyond a rest.

    Parameters
    ----------
    window
        Samples that are smoothed together.
    jitter_mm
        How far the position wanders within a window at rest.
    rest_window
        Samples of the shortest rest, as many as the window unless given.

    Returns
    -------
    The smoothed position, and the edges of rests and of ways from turn to turn.
    """
    from scipy.signal import savgol_filter

    still = _still(position_mm, rest_window or window, jitter_mm)
    changes = np.flatnonzero(np.diff(still))
    edges = np.unique(np.concatenate(([0], np.where(still[changes], changes, changes + 1), [still.size - 1])))
    smooth = position_mm.copy()
    turns: list[int] = []
    for begin, end in pairwise(edges.tolist()):
        if still[(begin + end) // 2]:
            smooth[begin : end + 1] = position_mm[begin : end + 1].mean()
    for begin, end in pairwise(edges.tolist()):
        inner = slice(begin + int(still[begin]), end + 1 - int(still[end]))
        length = min(window, (inner.stop - inner.start - 1) // 2 * 2 + 1)
        if not still[(begin + end) // 2] and length > ORDER:
            smooth[inner] = savgol_filter(position_mm[inner], length, ORDER)
            turns += (begin + _turns(smooth[begin : end + 1], TURN_JITTERS * jitter_mm)).tolist()
    edges = np.union1d(edges, np.array(turns, dtype=np.intp))
    return _monotone(smooth, edges), edges


def _still(position_mm: FloatArray, window: int, span_mm: float) -> BoolArray:
    """Whether each sample lies in some window that spans no more than `span_mm`."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    quiet = maximum_filter1d(position_mm, window) - minimum_filter1d(position_mm, window) <= span_mm
    return np.asarray(maximum_filter1d(quiet.astype(np.uint8), window) > 0)


def _turns(position_mm: FloatArray, least_mm: float) -> IndexArray:
    """Peaks and valleys of a way, each at least `least_mm` above or below what is around it."""
    from scipy.signal import find_peaks

    return np.concatenate([find_peaks(side * position_mm, prominence=least_mm)[0] for side in (1.0, -1.0)])


def _monotone(position_mm: FloatArray, edges: IndexArray) -> FloatArray:
    """Make a position rise or fall throughout between edges, where it keeps its value."""
    monotone = position_mm.copy()
    for begin, end in pairwise(edges.tolist()):
        first, last = position_mm[begin], position_mm[end]
        sign = 1.0 if last >= first else -1.0
        rising = np.maximum.accumulate(sign * position_mm[begin : end + 1])
        monotone[begin : end + 1] = sign * np.clip(rising, sign * first, sign * last)
    return monotone
