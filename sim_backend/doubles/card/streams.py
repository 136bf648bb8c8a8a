"""Sampled data of the card's double: interface of the bench, input buffers, output waveforms, encoder counter.

Counts are the encoder's own, four a period, 0 at its index pulse.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dragrig.config.rig import RigSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.daqmx import CardError, Decoding, LengthUnit, ReadRelativeTo, StatusCode
from dragrig.sim_backend.doubles.fault_injection import FaultInjector


class PacedClock(Protocol):
    """Time that runs `pace` times as fast as the wall's."""

    @property
    def pace(self) -> float:
        """Seconds of this clock in one of the wall's."""
        ...

    def monotonic(self) -> float:
        """Seconds from an arbitrary start."""
        ...


class Bench(Protocol):
    """Force sensor, encoder and digital lines, as the card's terminals meet them. `World` is one."""

    @property
    def rig(self) -> RigSettings:
        """Settings of the rig: what is wired where, and how long a count of the encoder is."""
        ...

    @property
    def clock(self) -> PacedClock:
        """The time in which samples are taken."""
        ...

    @property
    def faults(self) -> FaultInjector:
        """What goes wrong."""
        ...

    def position_mm(self) -> float:
        """Where the carriage is; 0 at the encoder's index pulse."""
        ...

    def begin_sampling(self, rate_hz: float) -> None:
        """Take sample 0 now."""
        ...

    @property
    def began_s(self) -> float:
        """The clock's reading at sample 0; its present one while no sample is taken."""
        ...

    def available(self) -> int:
        """Return how many samples were taken since then."""
        ...

    def sample(self, first: int, end: int) -> Mapping[str, FloatArray]:
        """Return `force_V`, `encoder_counts` and each further input's volts by its name."""
        ...

    def end_sampling(self) -> None:
        """Take no further sample."""
        ...

    def read_line(self, line: str) -> bool:
        """Return the level of a digital line, as PORT/LINE."""
        ...

    def write_line(self, line: str, high: bool) -> None:
        """Set a digital line."""
        ...


_MIN_WAIT_S = 2e-4


class SampleSource(Protocol):
    """What fills a buffer."""

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present; 0 when none come."""
        ...

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        ...

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return these samples of each channel."""
        ...


@dataclass(slots=True)
class ReadPosition:
    """Where a read begins; `overwrite` says whether unread samples may be lost without an end of the acquisition."""

    relative_to: int = ReadRelativeTo.CURRENT_READ_POSITION
    offset: int = 0
    overwrite: bool = False


@dataclass(frozen=True, slots=True)
class ReadSpan:
    """Samples that a read may have, and why it is not all that was asked."""

    first: int
    end: int
    failure: CardError | None = None


class InputBuffer:
    """One running task's buffer. Whoever owns it holds `changed` while calling anything.

    Parameters
    ----------
    size
        Samples per channel that the buffer holds.
    limit
        Samples per channel after which a finite task ends; None for a continuous one.
    pace
        Seconds of the source's time in one of the wall's.
    changed
        Notified whenever something happens that a waiting read must look at.
    still_there
        Raises what keeps the read from going on: the card is gone, the task was stopped.
    """

    def __init__(
        self,
        source: SampleSource,
        size: int,
        limit: int | None,
        pace: float,
        changed: threading.Condition,
        still_there: Callable[[], None],
    ) -> None:
        self.source = source
        self.size = size
        self.limit = limit
        self.position = 0
        self._pace = pace
        self._changed = changed
        self._still_there = still_there
        self._stalled_at: int | None = None
        self._lost_before = 0
        self._overrun = False
        self._short_reads = 0

    @property
    def done(self) -> bool:
        """Whether a finite task has taken all its samples."""
        return self.limit is not None and self.total() >= self.limit

    def total(self) -> int:
        """Return how many samples per channel reached the buffer."""
        total = self.source.total() if self._stalled_at is None else self._stalled_at
        return total if self.limit is None else min(total, self.limit)

    def oldest(self) -> int:
        """Return the first sample that the buffer still holds."""
        return max(self.total() - self.size, self._lost_before, 0)

    def begins(self, position: ReadPosition) -> int:
        """Return the first sample of the next read."""
        match position.relative_to:
            case ReadRelativeTo.FIRST_SAMPLE:
                return position.offset
            case ReadRelativeTo.MOST_RECENT_SAMPLE:
                return self.total() + position.offset
            case _:
                return self.position + position.offset

    def stall(self, stalled: bool) -> None:
        """Let no further sample reach the buffer, or all that were taken meanwhile at once."""
        if stalled != (self._stalled_at is not None):
            self._stalled_at = self.total() if stalled else None

    def forget_before(self, index: int) -> None:
        """Let everything before a sample be lost."""
        self._lost_before = max(self._lost_before, index)

    def lose(self, samples: int) -> None:
        """Let so many samples that were not read be lost."""
        self.forget_before(self.position + samples)

    def wait(self, samples: int, timeout_s: float, position: ReadPosition, short_reads: int) -> ReadSpan:
        """Wait for samples from the position on; advance it by those that are there in the end.

        Raises
        ------
        CardError
            When there is nothing to be had: overwritten (−200279), beyond the end (−200278), the card gone.
        """
        self._still_there()
        first = self.begins(position)
        wanted = self._shortened(samples, short_reads)
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        while True:
            self._refuse_overwritten(first, position.overwrite)
            total = self.total()
            if total >= first + wanted:
                break
            if self.done:
                return self._part(first, total, _beyond_end_error())
            left_s = deadline_s - time.perf_counter()
            if left_s <= 0:
                return self._part(first, total, _timeout_error(samples, total - first))
            self._sleep(min(left_s, self._due_s(first + wanted - total)))
            self._still_there()
        return self._part(first, first + wanted, None if wanted == samples else _timeout_error(samples, wanted))

    def _part(self, first: int, end: int, failure: CardError | None) -> ReadSpan:
        end = max(end, first)
        self.position = end
        if failure is not None:
            failure.samples = end - first
        return ReadSpan(first, end, failure)

    def _shortened(self, samples: int, short_reads: int) -> int:
        if self._short_reads >= short_reads:
            return samples
        self._short_reads += 1
        return samples // 2

    def _refuse_overwritten(self, first: int, overwrite: bool) -> None:
        if first < 0 or self._overrun or first < self.oldest():
            # Without leave to overwrite, the acquisition ends where it meets a sample that was not read.
            self._overrun = not overwrite
            raise CardError(
                StatusCode.SAMPLES_OVERWRITTEN,
                "The application is not able to keep up with the hardware acquisition: the sample to be read was "
                f"overwritten.\n\nSample: {first}\nOldest Sample in Buffer: {self.oldest()}",
            )

    def _due_s(self, samples: int) -> float:
        rate_hz = self.source.rate_hz if self._stalled_at is None else 0.0
        return max(samples / (rate_hz * self._pace), _MIN_WAIT_S) if rate_hz > 0 else math.inf

    def _sleep(self, duration_s: float) -> None:
        self._changed.wait(None if math.isinf(duration_s) else duration_s)


def _timeout_error(samples: int, there: int) -> CardError:
    return CardError(
        StatusCode.SAMPLES_NOT_YET_AVAILABLE,
        "Some or all of the samples requested have not yet been acquired.\n\n"
        f"Samples Requested: {samples}\nSamples There: {max(there, 0)}",
    )


def _beyond_end_error() -> CardError:
    return CardError(
        StatusCode.SAMPLES_WILL_NEVER_BE_AVAILABLE,
        "Attempted to read a sample beyond the final sample acquired.",
    )


class OutputWaveform:
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
            raise CardError(
                StatusCode.SAMPLES_CANNOT_YET_BE_WRITTEN, "Generation cannot start: no samples were written."
            )

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


_COUNTS_PER_PERIOD = 4
_EDGES = {Decoding.X1: 1, Decoding.X2: 2, Decoding.X4: 4}


@dataclass(frozen=True, slots=True)
class EncoderDecoding:
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
    unit: LengthUnit
    distance_per_pulse: float
    initial_position: float
    index: bool
    index_position: float
    sense: int = 1

    def position(self, counts: FloatArray, origin: FloatArray | float, start: FloatArray | float) -> FloatArray:
        """Return positions at counts, where the position at count `origin` is `start`."""
        edges = _EDGES[self.decoding]
        told = np.floor(self.sense * (counts - origin) * (edges / _COUNTS_PER_PERIOD))
        return np.asarray(start + told * (1.0 if self.unit is LengthUnit.TICKS else self.distance_per_pulse / edges))


@dataclass(frozen=True, slots=True)
class LatchClock:
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


class EncoderCounter:
    """A counter from its arming on, and the samples that the analog inputs' clock latched of it."""

    def __init__(self, bench: Bench, encoder: EncoderDecoding) -> None:
        self._bench = bench
        self._encoder = encoder
        self._armed_at = self._last = count_now(bench)
        self._indexed = False
        self._indexed_from: int | None = None
        self._looked_at = 0
        self._kept = np.zeros(0)
        self._kept_first = 0
        self._base = 0
        self._clock: LatchClock | None = None

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present."""
        return self._clock.rate_hz if self._clock is not None else 0.0

    def now(self) -> float:
        """Return the present position."""
        count = self._last if self._bench.faults.active.encoder_stuck else count_now(self._bench)
        self._pass_over(count)
        return float(self._scaled(np.array([count]), 0 if self._indexed else 1)[0])

    def count(self) -> int:
        """Return the register's content: edges since arming, modulo 2^32."""
        return (self._encoder.sense * (count_now(self._bench) - self._armed_at)) % 2**32

    def clocked(self, clock: LatchClock) -> None:
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
