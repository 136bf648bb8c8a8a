"""Savitzky–Golay smoothing of samples as they arrive: the same values as `savgol.smooth`, half a window later."""

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gaps import finite_runs
from dragrig.analysis.savgol import SavgolSettings, too_short
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Event


class SavgolStream:
    """One channel, filtered block by block.

    Every sample pushed comes out once, in order, filtered; what `push` and `flush` return, put end to
    end, is what `smooth` gives for the same samples and gaps. Memory: one window and one block.
    Not to be shared between threads.

    Parameters
    ----------
    sample_rate_hz
        Rate of the samples.
    settings
        Window, order and derivative.

    Raises
    ------
    AnalysisError
        When the window does not suit the order or the rate.
    """

    def __init__(self, sample_rate_hz: float, settings: SavgolSettings) -> None:
        self._rate = sample_rate_hz
        self._kernel = settings.kernel(sample_rate_hz)
        self._window = self._kernel.window
        self._half = self._kernel.half
        self._next_index = 0
        self._piece_start = 0
        self._seen = 0
        self._held = np.empty(0)
        self._events: list[Event] = []

    @property
    def delay_samples(self) -> int:
        """How many samples a filtered value lags behind its raw one: half a window."""
        return self._half

    @property
    def events(self) -> tuple[Event, ...]:
        """One event for each piece that was too short to filter, so far."""
        return tuple(self._events)

    def push(self, values: npt.ArrayLike, first_index: int | None = None) -> FloatArray:
        """Take samples in and return those that are ready.

        Parameters
        ----------
        values
            Shape `(n,)`, any `n`.
        first_index
            Index of the first sample, counted from the run's first and including lost samples, as a
            block carries it; a value beyond the samples so far is a gap. Left out: no gap.

        Raises
        ------
        AnalysisError
            When `first_index` lies before samples that were pushed already.
        """
        block = np.asarray(values, dtype=np.float64)
        ready: list[FloatArray] = []
        if first_index is not None and first_index != self._next_index:
            if first_index < self._next_index:
                raise AnalysisError(
                    f"Sample {first_index} was pushed after sample {self._next_index - 1}; push blocks in order."
                )
            ready.append(self._end_piece())
            self._next_index = first_index
        at = 0
        for start, stop in finite_runs(block):
            if start > at:
                ready.append(self._skip(start - at))
            ready.append(self._extend(block[start:stop]))
            at = stop
        if at < len(block):
            ready.append(self._skip(len(block) - at))
        return np.concatenate(ready) if ready else np.empty(0)

    def flush(self) -> FloatArray:
        """End the piece and return the samples still held back; what is pushed next begins a new piece."""
        return self._end_piece()

    def _extend(self, samples: FloatArray) -> FloatArray:
        if self._seen == 0:
            self._piece_start = self._next_index
        before = max(0, self._seen - self._half) if self._seen >= self._window else 0
        self._seen += len(samples)
        self._next_index += len(samples)
        self._held = np.concatenate((self._held, samples))
        if self._seen < self._window:
            return np.empty(0)
        held_from = self._seen - len(self._held)
        ready = [] if before else [self._kernel.ends(self._held[: self._window])[: self._half]]
        middle = self._kernel.middle(self._held)
        ready.append(middle[max(0, before - held_from - self._half) :])
        self._held = self._held[-self._window :].copy()
        return np.concatenate(ready)

    def _skip(self, samples: int) -> FloatArray:
        ended = self._end_piece()
        self._next_index += samples
        return np.concatenate((ended, np.full(samples, np.nan)))

    def _end_piece(self) -> FloatArray:
        seen, held = self._seen, self._held
        self._seen, self._held = 0, np.empty(0)
        if seen == 0:
            return held
        if seen < self._window:
            self._events.append(too_short(self._piece_start / self._rate, seen, self._window))
            return np.full(seen, np.nan)
        return self._kernel.ends(held[-self._window :])[self._half + 1 :]
