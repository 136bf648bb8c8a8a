"""A counter that follows a linear encoder: decoding, index pulse, units, and samples latched by the inputs' clock.

Counts are the encoder's own, four a period, 0 at its index pulse.
"""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.daqmx import Decoding, Length
from dragrig.sim_backend.doubles.card.wires import Bench

_COUNTS_PER_PERIOD = 4
_EDGES = {Decoding.X1: 1, Decoding.X2: 2, Decoding.X4: 4}


@dataclass(frozen=True, slots=True)
class Encoder:
    """How a counter takes its encoder.

    Attributes
    ----------
    sense
        1, −1 where A and B are swapped, 0 where the terminals carry nothing.
    distance_per_pulse
        Length of a period of the encoder's signals, in the unit of the measurement.
    index
        Whether the index pulse sets the position to `index_position`.
    """

    decoding: Decoding
    unit: Length
    distance_per_pulse: float
    initial_position: float
    index: bool
    index_position: float
    sense: int = 1

    def position(self, counts: FloatArray, origin: FloatArray | float, start: FloatArray | float) -> FloatArray:
        """Return positions at counts, where the position at count `origin` is `start`."""
        edges = _EDGES[self.decoding]
        told = np.floor(self.sense * (counts - origin) * (edges / _COUNTS_PER_PERIOD))
        return np.asarray(start + told * (1.0 if self.unit is Length.TICKS else self.distance_per_pulse / edges))


@dataclass(frozen=True, slots=True)
class InputClock:
    """The analog inputs' sample clock, as a counter meets it.

    Attributes
    ----------
    origin
        The encoder's count at the inputs' first sample.
    skipped
        Samples that the inputs had taken when the counter was armed.
    limit
        Samples after which the inputs stop; None for a continuous task.
    """

    rate_hz: float
    origin: int
    skipped: int
    limit: int | None

    def taken(self, bench: Bench) -> int:
        """Return how many samples the counter was told to latch."""
        total = bench.available()
        return max((total if self.limit is None else min(total, self.limit)) - self.skipped, 0)

    def counts(self, bench: Bench, first: int, end: int) -> FloatArray:
        """Return the encoder's counts at samples that the counter latched."""
        return bench.sample(first + self.skipped, end + self.skipped)["encoder_counts"] + self.origin


class Counter:
    """A counter from its arming on, and the samples that the analog inputs' clock latched of it."""

    def __init__(self, bench: Bench, encoder: Encoder) -> None:
        self._bench = bench
        self._encoder = encoder
        self._armed_at = self._last = count_now(bench)
        self._indexed = False
        self._indexed_from: int | None = None
        self._looked_at = 0
        self._kept = np.zeros(0)
        self._kept_first = 0
        self._base = 0
        self._clock: InputClock | None = None

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present."""
        return self._clock.rate_hz if self._clock is not None else 0.0

    def now(self) -> float:
        """Return the present position."""
        count = self._last if self._bench.mishaps.now.encoder_stuck else count_now(self._bench)
        self._pass_over(count)
        return float(self._scaled(np.array([count]), 0 if self._indexed else 1)[0])

    def count(self) -> int:
        """Return the register's content: edges since arming, modulo 2^32."""
        return (self._encoder.sense * (count_now(self._bench) - self._armed_at)) % 2**32

    def clocked(self, clock: InputClock) -> None:
        """Latch a sample at each edge of the inputs' clock from here on."""
        self._pass_over(clock.origin)
        if self._indexed and self._indexed_from is None:
            self._indexed_from = self._base
        self._clock = clock

    def unclocked(self, oldest: int) -> int:
        """Keep what was latched since `oldest`, for the inputs' clock stops; return the first sample that is kept."""
        total = self.total()
        first = min(max(oldest, self._kept_first), total)
        self._kept = self._counts(first, total)
        self._kept_first, self._base, self._clock = first, total, None
        return first

    def total(self) -> int:
        """Return how many samples were latched since the counter was armed."""
        return self._base + (self._clock.taken(self._bench) if self._clock is not None else 0)

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return latched positions."""
        counts = self._counts(first, end)
        if self._encoder.index and self._indexed_from is None:
            self._look_for_index(end)
        until = end if self._indexed_from is None else self._indexed_from
        return [self._scaled(counts, until - first)]

    def _counts(self, first: int, end: int) -> FloatArray:
        kept = self._kept[max(first - self._kept_first, 0) : max(end - self._kept_first, 0)]
        if end <= self._base or self._clock is None:
            return kept
        latched = self._clock.counts(self._bench, max(first, self._base) - self._base, end - self._base)
        return latched if first >= self._base else np.concatenate([kept, latched])

    def _scaled(self, counts: FloatArray, indexed_from: int) -> FloatArray:
        encoder = self._encoder
        before = encoder.position(counts, self._armed_at, encoder.initial_position)
        if indexed_from >= len(counts):
            return before
        after = encoder.position(counts, 0.0, encoder.index_position)
        return np.where(np.arange(len(counts)) < indexed_from, before, after)

    def _pass_over(self, count: int) -> None:
        if self._encoder.index and (self._last < 0) != (count < 0):
            self._indexed = True
        self._last = count

    def _look_for_index(self, end: int) -> None:
        first = max(self._looked_at, self._kept_first)
        counts = np.concatenate([[self._last], self._counts(first, end)])
        crossed = np.flatnonzero(np.diff(counts < 0))
        self._last, self._looked_at = int(counts[-1]), end
        if len(crossed):
            self._indexed = True
            self._indexed_from = first + int(crossed[0])


def count_now(bench: Bench) -> int:
    """Return the encoder's count at present."""
    count = round(bench.position_mm() * (1000.0 / bench.rig.encoder.resolution_um))
    return -count if bench.rig.hardware.card.encoder.reversed else count
