"""Where samples are missing: a trace is worked on piece by piece, never across a gap."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray

IndexArray = npt.NDArray[np.intp]


def gap_starts(time: FloatArray, sample_rate_hz: float) -> IndexArray:
    """Return the index of each first sample after a gap.

    Parameters
    ----------
    time
        Times of the samples [s], shape `(N,)`.
    sample_rate_hz
        Rate of the samples between the gaps. A step that differs from `1 / sample_rate_hz` by more
        than half of it is a gap.
    """
    steps = np.diff(time) * sample_rate_hz
    return np.flatnonzero(np.abs(steps - 1) > 0.5) + 1


def unbroken(values: FloatArray, gaps: npt.ArrayLike = ()) -> Iterator[slice]:
    """Yield the stretches of `values` without a gap and without NaN or infinity, in order.

    Raises
    ------
    AnalysisError
        When an index in `gaps` lies outside the values.
    """
    starts = np.unique(np.asarray(gaps, dtype=np.intp))
    if starts.size and (starts[0] < 0 or starts[-1] > len(values)):
        raise AnalysisError(
            f"A gap at sample {int(starts[0] if starts[0] < 0 else starts[-1])} lies outside the {len(values)} samples "
            "of the trace; give the index of each first sample after a gap."
        )
    for begin, end in pairwise((0, *starts.tolist(), len(values))):
        for start, stop in finite_runs(values[begin:end]):
            yield slice(begin + start, begin + stop)


def finite_runs(values: FloatArray) -> Iterator[tuple[int, int]]:
    """Yield start and stop of each run of finite values."""
    finite = np.concatenate(([False], np.isfinite(values), [False]))
    edges = np.flatnonzero(finite[1:] != finite[:-1])
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
