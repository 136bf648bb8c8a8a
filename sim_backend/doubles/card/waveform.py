"""An analog output's buffer: voltages generated one after the other by a clock, and what is held when it stops."""

import math

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.daqmx import CardError, Code


class Waveform:
    """Voltages of one or more outputs on a common clock. Times are readings of the bench's clock.

    Parameters
    ----------
    size
        Samples per channel that the buffer holds.
    regenerates
        Whether the buffer is generated again and again, or generation ends with an error when it is used up.
    limit
        Samples per channel after which a finite task ends; None for a continuous one.
    """

    def __init__(self, channels: int, size: int, rate_hz: float, regenerates: bool, limit: int | None) -> None:
        self.rate_hz = rate_hz
        self.written = 0
        self._ring = np.zeros((channels, size))
        self._regenerates = regenerates
        self._limit = limit
        self._began_s: float | None = None

    @property
    def size(self) -> int:
        """Samples per channel that the buffer holds."""
        return self._ring.shape[1]

    @property
    def has_begun(self) -> bool:
        """Whether its first sample was generated."""
        return self._began_s is not None

    def refuse_empty(self) -> None:
        """Raise `CardError` when there is no first sample."""
        if self.written == 0:
            raise CardError(Code.SAMPLES_CANNOT_YET_BE_WRITTEN, "Generation cannot start: no samples were written.")

    def start(self, now_s: float) -> None:
        """Generate the first sample now."""
        self._began_s = now_s

    def due_s(self, sample: int) -> float:
        """Return when a sample is generated; infinite before the first one is."""
        return math.inf if self._began_s is None else self._began_s + sample / self.rate_hz

    def kept(self) -> FloatArray:
        """Return what was written and fits the buffer, shape `(channels, n)`."""
        return self._ring[:, : min(self.written, self.size)]

    def generated(self, now_s: float) -> int:
        """Return how many samples per channel were generated."""
        if self._began_s is None:
            return 0
        due = math.floor((now_s - self._began_s) * self.rate_hz) + 1
        most = math.inf if self._regenerates else self.written
        return int(min(due, most, math.inf if self._limit is None else self._limit))

    def used_up(self, now_s: float) -> bool:
        """Whether a sample was due that nobody had written."""
        if self._began_s is None or self._regenerates or (self._limit is not None and self.written >= self._limit):
            return False
        return math.floor((now_s - self._began_s) * self.rate_hz) + 1 > self.written

    def done(self, now_s: float) -> bool:
        """Whether a finite task has generated all its samples."""
        return self._limit is not None and self.generated(now_s) >= self._limit

    def space(self, now_s: float) -> int:
        """Return how many samples per channel can be written."""
        return self.size if self._regenerates else self.size - (self.written - self.generated(now_s))

    def write(self, volts: FloatArray) -> None:
        """Append samples, shape `(channels, n)` with `n` at most the space."""
        places = (self.written + np.arange(volts.shape[1])) % self.size
        self._ring[:, places] = volts
        self.written += volts.shape[1]

    def volts(self, now_s: float) -> FloatArray | None:
        """Return what each output is at, shape `(channels,)`; None before the first sample."""
        generated = self.generated(now_s)
        if generated == 0:
            return None
        return np.array(self._ring[:, (generated - 1) % min(self.size, self.written)])
