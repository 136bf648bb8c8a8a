"""Sampled data of the card's double: analog inputs, the encoder counter, input buffers and output waveforms.

Counts are the encoder's own, four a period, 0 at its index pulse.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from nidaqmx.error_codes import DAQmxErrors as Status

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.daqmx import CardError
from dragrig.sim_backend.doubles.card.pci6229 import EncoderChannel, VirtualChannel
from dragrig.sim_backend.doubles.simulated_bench import SimulatedBench

_MIN_WAIT_S = 2e-4


class SampleSource(Protocol):
    """What fills an input buffer."""

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


class AnalogSource:
    """Volts of analog inputs, as the converter reads them; 0 where nothing is wired."""

    def __init__(self, bench: SimulatedBench, channels: list[VirtualChannel], rate_hz: float) -> None:
        self._bench = bench
        self.rate_hz = rate_hz
        card = bench.rig.hardware.card
        signals = {settings.channel.lower(): settings.name for settings in card.inputs}
        signals[card.force.channel.lower()] = "force_V"
        self._signals = [(signals.get(channel.physical), channel.range_V) for channel in channels]

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        return self._bench.available()

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return volts of each channel."""
        samples = self._bench.sample(first, end)
        return [
            pci6229.quantised(samples[signal], range_V) if signal is not None else np.zeros(end - first)
            for signal, range_V in self._signals
        ]


@dataclass(frozen=True, slots=True)
class LatchClock:
    """The analog inputs' sample clock, as a counter receives it.

    Attributes
    ----------
    origin
        The encoder's count at the inputs' first sample.
    skipped
        Samples that the inputs had taken when the counter was started.
    """

    rate_hz: float
    origin: int
    skipped: int


class EncoderCounter:
    """A counter from its start on, and the samples that the analog inputs' clock latched of it."""

    def __init__(self, bench: SimulatedBench, encoder: EncoderChannel, channel: VirtualChannel) -> None:
        self._bench = bench
        self._encoder = encoder
        wired = bench.rig.hardware.card.encoder
        a, b, z = pci6229.encoder_terminals(channel)
        terminals = (wired.a.lower(), wired.b.lower())
        # Swapped terminals count backwards; other terminals carry no signal.
        self._sense = {terminals: 1, terminals[::-1]: -1}.get((a, b), 0)
        self._index = encoder.index and bool(wired.z) and z == wired.z.lower()
        self._start_count = self._last_count = count_now(bench)
        self._indexed = False
        self._indexed_from: int | None = None
        self._searched_to = 0
        self._held = np.zeros(0)
        self._held_first = self._base = 0
        self._clock: LatchClock | None = None

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present."""
        return self._clock.rate_hz if self._clock is not None else 0.0

    def position_m(self) -> float:
        """Return the present position."""
        count = self._last_count if self._bench.faults.active.encoder_stuck else count_now(self._bench)
        self._pass_over(count)
        return float(self._positions(np.array([count]), 0 if self._indexed else 1)[0])

    def set_clock(self, clock: LatchClock) -> None:
        """Latch a sample at each edge of the inputs' clock from here on."""
        self._pass_over(clock.origin)
        if self._indexed and self._indexed_from is None:
            self._indexed_from = self._base
        self._clock = clock

    def end_clock(self, oldest: int) -> int:
        """Hold what was latched since `oldest`, as the inputs' clock stops; return the first sample that is held."""
        total = self.total()
        first = min(max(oldest, self._held_first), total)
        self._held = self._counts(first, total)
        self._held_first, self._base, self._clock = first, total, None
        return first

    def total(self) -> int:
        """Return how many samples were latched since the counter was started."""
        if self._clock is None:
            return self._base
        return self._base + max(self._bench.available() - self._clock.skipped, 0)

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return latched positions."""
        counts = self._counts(first, end)
        if self._index and self._indexed_from is None:
            self._search_index(end)
        until = end if self._indexed_from is None else self._indexed_from
        return [self._positions(counts, until - first)]

    def _counts(self, first: int, end: int) -> FloatArray:
        held = self._held[max(first - self._held_first, 0) : max(end - self._held_first, 0)]
        if end <= self._base or self._clock is None:
            return held
        shift = self._clock.skipped - self._base
        latched = self._bench.sample(max(first, self._base) + shift, end + shift)["encoder_counts"] + self._clock.origin
        return latched if first >= self._base else np.concatenate([held, latched])

    def _positions(self, counts: FloatArray, indexed_from: int) -> FloatArray:
        encoder = self._encoder
        before = encoder.start_m + self._sense * (counts - self._start_count) * encoder.count_m
        if indexed_from >= len(counts):
            return np.asarray(before)
        after = encoder.index_m + self._sense * counts * encoder.count_m
        return np.where(np.arange(len(counts)) < indexed_from, before, after)

    def _pass_over(self, count: int) -> None:
        if self._index and (self._last_count < 0) != (count < 0):
            self._indexed = True
        self._last_count = count

    def _search_index(self, end: int) -> None:
        first = max(self._searched_to, self._held_first)
        counts = np.concatenate([[self._last_count], self._counts(first, end)])
        crossings = np.flatnonzero(np.diff(counts < 0))
        self._last_count, self._searched_to = int(counts[-1]), end
        if len(crossings):
            self._indexed = True
            self._indexed_from = first + int(crossings[0])


def count_now(bench: SimulatedBench) -> int:
    """Return the encoder's present count."""
    count = round(bench.position_mm() * (1000.0 / bench.rig.encoder.resolution_um))
    return -count if bench.rig.hardware.card.encoder.reversed else count


class InputBuffer:
    """The buffer of one running task. The caller of a method holds `changed`.

    Parameters
    ----------
    size
        Samples per channel that the buffer holds; a sample that was not read in time is overwritten.
    pace
        Seconds of the source's time in a second of wall time.
    changed
        Notified of whatever a waiting read must react to.
    check_running
        Raises what ends a read: the card is gone, the task was stopped.
    """

    def __init__(
        self,
        source: SampleSource,
        size: int,
        pace: float,
        changed: threading.Condition,
        check_running: Callable[[], None],
    ) -> None:
        self.source = source
        self.position = 0
        """Index of the next sample of a relative read."""
        self._size = size
        self._pace = pace
        self._changed = changed
        self._check_running = check_running
        self._stalled_at: int | None = None
        self._lost_before = 0
        self._short_reads = 0

    def total(self) -> int:
        """Return how many samples per channel reached the buffer."""
        return self.source.total() if self._stalled_at is None else self._stalled_at

    def oldest(self) -> int:
        """Return the first sample that the buffer still holds."""
        return max(self.total() - self._size, self._lost_before, 0)

    def stall(self, stalled: bool) -> None:
        """Let no further sample reach the buffer, or at once all that were taken meanwhile."""
        if stalled != (self._stalled_at is not None):
            self._stalled_at = self.total() if stalled else None

    def forget_before(self, index: int) -> None:
        """Lose everything before a sample."""
        self._lost_before = max(self._lost_before, index)

    def read(self, first: int, samples: int, timeout_s: float, short_reads: int) -> tuple[int, CardError | None]:
        """Wait for samples from an index on, and advance the position by those that came.

        Returns
        -------
        int, CardError or None
            The index after the last sample that came, and why it is not all that was requested.

        Raises
        ------
        CardError
            When the first sample was overwritten (−200279), or the card is gone.
        """
        self._check_running()
        wanted = samples
        if self._short_reads < short_reads:
            self._short_reads += 1
            wanted = samples // 2
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        while True:
            if first < self.oldest():
                raise CardError(
                    Status.SAMPLES_NO_LONGER_AVAILABLE,
                    "The application is not able to keep up with the hardware acquisition: the sample to be read was "
                    f"overwritten.\n\nSample: {first}\nOldest Sample in Buffer: {self.oldest()}",
                )
            missing = first + wanted - self.total()
            left_s = deadline_s - time.perf_counter()
            if missing <= 0 or left_s <= 0:
                break
            rate_hz = self.source.rate_hz if self._stalled_at is None else 0.0
            due_s = max(missing / (rate_hz * self._pace), _MIN_WAIT_S) if rate_hz > 0 else math.inf
            wait_s = min(left_s, due_s)
            self._changed.wait(None if math.isinf(wait_s) else wait_s)
            self._check_running()
        self.position = max(min(first + wanted, self.total()), first)
        arrived = self.position - first
        if arrived == samples:
            return self.position, None
        return self.position, CardError(
            Status.SAMPLES_NOT_YET_AVAILABLE,
            "Some or all of the samples requested have not yet been acquired.\n\n"
            f"Samples Requested: {samples}\nSamples There: {arrived}",
            arrived,
        )


class OutputWaveform:
    """Voltages of an analog output on a clock, generated once each. Times are readings of the bench's clock.

    Parameters
    ----------
    size
        Samples that the buffer holds.
    """

    def __init__(self, size: int, rate_hz: float) -> None:
        self.size = size
        self.rate_hz = rate_hz
        self.written = 0
        self.began_s: float | None = None
        """When the first sample was generated."""
        self._ring = np.zeros(size)

    def generated(self, now_s: float) -> int:
        """Return how many samples were generated."""
        return min(self._due(now_s), self.written)

    def ran_empty(self, now_s: float) -> bool:
        """Whether a sample was due that had not been written."""
        return self._due(now_s) > self.written

    def space(self, now_s: float) -> int:
        """Return how many samples can be written."""
        return self.size - (self.written - self.generated(now_s))

    def write(self, volts: FloatArray) -> None:
        """Append samples, at most the space."""
        self._ring[(self.written + np.arange(len(volts))) % self.size] = volts
        self.written += len(volts)

    def buffered(self) -> FloatArray:
        """Return what was written before the start."""
        return self._ring[: self.written]

    def voltage(self, now_s: float) -> float | None:
        """Return the present voltage; None before the first sample."""
        generated = self.generated(now_s)
        return float(self._ring[(generated - 1) % self.size]) if generated else None

    def _due(self, now_s: float) -> int:
        return 0 if self.began_s is None else math.floor((now_s - self.began_s) * self.rate_hz) + 1
