"""Traces of any length drawn at any zoom in constant time: against time (a min/max pyramid), or against a channel."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]

BLOCKS_PER_LEVEL = 8
"""Blocks of one level in a block of the next."""


class TracePyramid:
    """Samples, with the minimum and maximum of blocks of growing length.

    Parameters
    ----------
    base
        Samples of the shortest block; 1 keeps every sample. A live trace of 250 kS/s has blocks of half a millisecond,
        so that a day of it fits into memory.
    """

    def __init__(self, base: int = 1) -> None:
        self.base = base
        self.count = 0
        self._levels = [_PyramidLevel(single=base == 1)]

    def append(self, values: npt.NDArray[np.floating]) -> None:
        """Append samples, in a time that depends on their number alone."""
        if len(values) == 0:
            return
        new = np.asarray(values, dtype=np.float32)
        missing = -self.count % self.base
        if missing:
            self._levels[0].widen_last(new[:missing])
        rest = new[missing:]
        changed = self.count // self.base
        if len(rest):
            if self.base == 1:
                self._levels[0].extend(rest, rest)
            else:
                starts = np.arange(0, len(rest), self.base)
                self._levels[0].extend(np.fmin.reduceat(rest, starts), np.fmax.reduceat(rest, starts))
        self.count += len(new)
        self._carry(changed)

    def view(self, start: float, stop: float, columns: int) -> tuple[npt.NDArray[np.float64], Floats]:
        """Return a line through samples `start` to `stop`, of at most about `4 * columns` points.

        Returns
        -------
        Indices of samples and values, shape `(n,)` each: every sample if there are few, else the minimum and maximum
        of each column.
        """
        first = max(0, int(start) // self.base)
        last = min(self._levels[0].count, int(-(-stop // self.base)) + 1)
        if last <= first:
            return np.zeros(0), np.zeros(0, np.float32)
        level = 0
        while level + 1 < len(self._levels) and (last - first) > 2 * columns * BLOCKS_PER_LEVEL ** (level + 1):
            level += 1
        width = BLOCKS_PER_LEVEL**level
        low, high = self._levels[level].part(first // width, -(-last // width))
        begin = first // width * width
        if level == 0 and self.base == 1 and len(low) <= 2 * columns:
            return np.arange(begin, begin + len(low), dtype=np.float64), low
        step = max(1, -(-len(low) // columns))
        starts = np.arange(0, len(low), step)
        line = np.empty((len(starts), 2), np.float32)
        line[:, 0], line[:, 1] = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
        # Alternate up and down: short strokes from column to column are fast to draw.
        line[1::2] = line[1::2, ::-1]
        indices = (begin + starts * width) * float(self.base)
        return np.repeat(indices, 2), line.ravel()

    def _carry(self, changed: int) -> None:
        """Update the blocks of the higher levels."""
        for below, above in pairwise([*self._levels, _PyramidLevel(single=False)]):
            if below.count <= BLOCKS_PER_LEVEL:
                return
            changed //= BLOCKS_PER_LEVEL
            if above not in self._levels:
                self._levels.append(above)
                changed = 0
            low, high = below.part(changed * BLOCKS_PER_LEVEL, below.count)
            starts = np.arange(0, len(low), BLOCKS_PER_LEVEL)
            above.cut(changed)
            above.extend(np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts))


MAX_PATH_BLOCKS = 100_000
"""So many pieces of a trace are kept at most where it is drawn against another channel."""


class TracePath:
    """A trace against another channel of the run; of a long one, the highest and lowest sample of each short piece.

    Parameters
    ----------
    x, y
        Values at the same times, shape `(N,)` each; NaN for lost samples.
    """

    def __init__(self, x: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> None:
        length = min(len(x), len(y))
        kept = _extremes(np.asarray(y[:length], np.float32), MAX_PATH_BLOCKS)
        self._x, self._y = np.asarray(x[:length], np.float32)[kept], np.asarray(y[:length], np.float32)[kept]

    @property
    def ends(self) -> tuple[float, float] | None:
        """Lowest and highest x; None without a sample."""
        known = self._x[np.isfinite(self._x)]
        return (float(known.min()), float(known.max())) if len(known) else None

    def view(self, low: float, high: float, columns: int) -> tuple[Floats, Floats]:
        """Return the line's points between two x, NaN where it leaves that range, and no more than are seen."""
        inside = (self._x >= low) & (self._x <= high)
        # A sample more on either side, so that the line reaches the edges.
        near = inside.copy()
        near[1:] |= inside[:-1]
        near[:-1] |= inside[1:]
        places = np.nonzero(near)[0]
        x, y = self._x[places], self._y[places]
        # The line does not jump to where it comes back.
        y[1:][np.diff(places) > 1] = np.nan
        kept = _extremes(y, _PIECES_PER_COLUMN * columns)
        return x[kept], y[kept]


class TraceCrossings:
    """Finds where a channel first comes to a value, by the highest and lowest sample of each short piece.

    Parameters
    ----------
    values
        Shape `(N,)`; NaN for lost samples.
    """

    def __init__(self, values: npt.NDArray[np.floating]) -> None:
        self._values = np.asarray(values, np.float32)
        kept = _extremes(self._values, MAX_PATH_BLOCKS)
        self._kept = kept[np.isfinite(self._values[kept])]

    def first(self, value: float) -> int | None:
        """Return the last sample before the channel first comes to a value, or None where it never does."""
        changes = np.flatnonzero(np.diff(self._values[self._kept] >= value))
        if not len(changes):
            return None
        # A piece may have come to it before its own two kept samples; the piece before has not.
        begin, end = (self._kept[changes[0] - 1] if changes[0] else 0), self._kept[changes[0] + 1]
        places = begin + np.flatnonzero(np.isfinite(self._values[begin : end + 1]))
        return int(places[np.flatnonzero(np.diff(self._values[places] >= value))[0]])


_PIECES_PER_COLUMN = 4


def _extremes(values: Floats, blocks: int) -> npt.NDArray[np.intp]:
    """Return the places of the lowest and the highest value of each of so many blocks, in order."""
    step = -(-len(values) // max(blocks, 1))
    if step <= 2:  # two of two are all
        return np.arange(len(values))
    whole = np.full(-(-len(values) // step) * step, np.nan, np.float32)
    whole[: len(values)] = values
    rows = whole.reshape(-1, step)
    lost = np.isnan(rows)
    starts = np.arange(len(rows)) * step
    lowest = starts + np.argmin(np.where(lost, np.float32(np.inf), rows), axis=1)
    highest = starts + np.argmax(np.where(lost, np.float32(-np.inf), rows), axis=1)
    places = np.sort(np.stack((lowest, highest), axis=1), axis=1).ravel()
    return np.asarray(places[places < len(values)], dtype=np.intp)


class _PyramidLevel:
    """Minima and maxima of blocks, in arrays that grow by doubling; one array if a block is one sample."""

    def __init__(self, *, single: bool) -> None:
        self.count = 0
        self._low: Floats = np.empty(1024, np.float32)
        self._high: Floats = self._low if single else np.empty(1024, np.float32)

    def extend(self, low: Floats, high: Floats) -> None:
        end = self.count + len(low)
        if end > len(self._low):
            single = self._high is self._low
            self._low = _doubled(self._low, self.count, end)
            self._high = self._low if single else _doubled(self._high, self.count, end)
        self._low[self.count : end] = low
        if self._high is not self._low:
            self._high[self.count : end] = high
        self.count = end

    def cut(self, count: int) -> None:
        self.count = count

    def part(self, start: int, stop: int) -> tuple[Floats, Floats]:
        end = min(stop, self.count)
        return self._low[start:end], self._high[start:end]

    def widen_last(self, values: Floats) -> None:
        last = self.count - 1
        self._low[last] = np.fmin(self._low[last], np.fmin.reduce(values))
        self._high[last] = np.fmax(self._high[last], np.fmax.reduce(values))


def _doubled(array: Floats, used: int, needed: int) -> Floats:
    larger = np.empty(max(2 * len(array), needed), np.float32)
    larger[:used] = array[:used]
    return larger
