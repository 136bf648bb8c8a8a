"""Samples of both tasks side by side, each accounted for by its index."""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.rig.hardware.card.buffered import BufferedInput, OverwrittenError

TIMEOUT_S = 0.1
"""Longest wait of one call of the driver, twice a block: shorter ones stall it, longer ones delay a stop."""


@dataclass(frozen=True, slots=True, eq=False)
class Fetched:
    """Consecutive samples, as views of buffers that the next fetch overwrites.

    Attributes
    ----------
    first_index
        Index of the first sample since the start.
    lost
        How many samples before it are lost.
    volts, counts
        Shape `(inputs, n)` and `(n,)`; `n` is 0 when nothing arrived in time.
    """

    first_index: int
    lost: int
    volts: FloatArray
    counts: FloatArray

    @property
    def samples(self) -> int:
        """How many samples there are of every channel."""
        return len(self.counts)


class Fetcher:
    """Reads both tasks block by block into buffers of its own. Belongs to one thread.

    Parameters
    ----------
    inputs
        How many analog inputs there are.
    metres_per_count
        Length that the encoder's task gives a count.
    """

    def __init__(
        self, analog: BufferedInput, encoder: BufferedInput, inputs: int, block_samples: int, metres_per_count: float
    ) -> None:
        self._analog, self._encoder = analog, encoder
        self._inputs = inputs
        self._metres_per_count = metres_per_count
        self._volts = np.empty(inputs * block_samples)
        self._counts = np.empty(block_samples)
        self._volts_held = 0
        self._counts_held = 0
        self._next = 0
        self._lost = 0

    @property
    def next_index(self) -> int:
        """Index of the next sample."""
        return self._next

    @property
    def lost(self) -> int:
        """How many samples before `next_index` are lost and not yet told by a `Fetched`."""
        return self._lost

    @property
    def acquired(self) -> int:
        """How many samples the card has taken."""
        return self._analog.acquired

    def fetch(self, samples: int) -> Fetched:
        """Return the next samples, at most `samples`, fewer or none when they do not arrive in `TIMEOUT_S`.

        What one task has given and the other has not yet is kept for the next call.
        """
        try:
            if not self._volts_held:
                self._volts_held = self._analog.read(self._shaped(samples), samples, TIMEOUT_S)
            missing = self._volts_held - self._counts_held
            if missing:
                into = self._counts[self._counts_held : self._volts_held]
                self._counts_held += self._encoder.read(into, missing, TIMEOUT_S)
        except OverwrittenError:
            self._leap()
        return self._take()

    def _take(self) -> Fetched:
        came = self._volts_held if self._counts_held == self._volts_held else 0
        counts = self._counts[:came]
        # DAQmx gives lengths; a count is a whole number.
        counts /= self._metres_per_count
        np.rint(counts, out=counts)
        fetched = Fetched(self._next, self._lost if came else 0, self._shaped(came), counts)
        if came:
            self._next += came
            self._volts_held = self._counts_held = self._lost = 0
        return fetched

    def _leap(self) -> None:
        """Go on with the newest sample: what is between is lost."""
        newest = max(self._analog.acquired, self._encoder.acquired, self._next + 1)
        self._lost += newest - self._next
        self._next = newest
        self._volts_held = self._counts_held = 0
        self._analog.leap_to(newest)
        self._encoder.leap_to(newest)

    def _shaped(self, samples: int) -> FloatArray:
        return self._volts[: self._inputs * samples].reshape(self._inputs, samples)
