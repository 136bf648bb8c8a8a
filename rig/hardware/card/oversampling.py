"""Oversampling: the card takes several samples for each recorded one, and a digital filter keeps aliases out of them.

The filter is a low-pass of linear phase (a Kaiser window, `scipy.signal.firwin`). Its delay is compensated: a recorded
sample is the filter's output about the very sample of the card that its count was read at. It needs samples on
both sides for that, so that a recorded sample is there `WINGS` sample times after its instant; before the first sample
the inputs count as constant.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import firwin, freqz, upfirdn

from dragrig.config import RigSettings
from dragrig.rig import FloatArray
from dragrig.rig.hardware.card.tasks import SampleBatch, SampleFetcher

WINGS = 5
"""Recorded samples that the filter reaches to each side."""
PASSBAND, STOPBAND = 0.25, 0.75
"""Ends of pass band and transition, as shares of the recorded rate: what would fold into the pass band is stopped."""
STOPBAND_DB = 77.0
"""Least attenuation of the stop band, as measured for every factor; the pass band is flat within 0.002 dB."""
_DESIGN_DB = 80.0
MAX_DELAY_S = 0.02
"""Longest wait for the samples after an instant: at lower recorded rates nothing is filtered unless settings say so."""
MAX_AGGREGATE_RATE_HZ = 250_000
"""Samples per second that the PCI-6229 converts over all channels (PCI-6229 specifications)."""
SETTLED_S = 14e-6
"""Time between two inputs that NI's driver takes where the rate allows: they settle to far below a converter's step."""
_MAX_RATE_HZ = 25_000
"""Rate per input up to which the card oversamples by itself: more costs processor time and gains little."""


@dataclass(frozen=True, slots=True, eq=False)
class AntiAliasFilter:
    """The filter from `factor` samples of the card to a recorded one; with a factor of 1 nothing is filtered."""

    factor: int
    taps: FloatArray
    """Shape `(2 * WINGS * factor + 1,)`, symmetric, with the sum 1."""

    @classmethod
    def of(cls, factor: int) -> "AntiAliasFilter":
        """Return the filter of a factor."""
        if factor == 1:
            return cls(1, np.ones(1))
        # Kaiser's formula for an attenuation, 0.1102 (A − 8.7); at the stop band's very edge a little less is reached.
        window = ("kaiser", 0.1102 * (_DESIGN_DB - 8.7))
        return cls(factor, firwin(2 * WINGS * factor + 1, (PASSBAND + STOPBAND) / factor, window=window))

    @property
    def wing(self) -> int:
        """Samples of the card that it reaches to each side."""
        return len(self.taps) // 2

    @property
    def description(self) -> str:
        """The filter in one line, for run files."""
        if self.factor == 1:
            return "none"
        return (
            f"low-pass FIR of {len(self.taps)} taps at {self.factor} times the recorded rate (Kaiser window, "
            f"{STOPBAND_DB:g} dB; pass band to {PASSBAND:g}, stop band from {STOPBAND:g} of the recorded rate), delay "
            "compensated"
        )

    def gain(self, frequency: FloatArray) -> FloatArray:
        """Return the gain at frequencies given as shares of the recorded rate, which may lie beyond the card's."""
        if self.factor == 1:
            return np.ones_like(frequency)
        _, response = freqz(self.taps, worN=2 * np.pi * frequency / self.factor)
        return np.abs(response)


def oversampling_factor(rig: RigSettings) -> int:
    """Return how many samples the card takes for each recorded one: the settings' number, or as many as settle."""
    card, rate_hz = rig.hardware.card, rig.sampling.rate_hz
    if card.oversampling:
        return card.oversampling
    if rate_hz * MAX_DELAY_S < WINGS:
        return 1
    inputs = 1 + len(card.inputs)
    settled_hz = 1.0 / (SETTLED_S * inputs)
    return max(1, int(min(settled_hz, _MAX_RATE_HZ) / rate_hz + 1e-9))


class OversampledFetcher:
    """Fetches the card's samples and returns recorded ones. Belongs to one thread.

    Indices and numbers of samples are those of recorded samples. Where samples are lost, recording goes on with the
    first recorded sample with a sampled instant.

    Parameters
    ----------
    fetcher
        Fetches the samples of a block and of a wing of the filter.
    """

    def __init__(self, fetcher: SampleFetcher, anti_alias: AntiAliasFilter, inputs: int) -> None:
        self._fetcher, self._filter = fetcher, anti_alias
        self._volts, self._counts = np.empty((inputs, 0)), np.empty(0)
        self.next_index = 0
        """Index of the next recorded sample."""
        self._lost = 0

    @property
    def acquired(self) -> int:
        """How many recorded samples the card has taken all samples for."""
        return max((self._fetcher.acquired - 1 - self._filter.wing) // self._filter.factor + 1, 0)

    @property
    def lost(self) -> int:
        """How many recorded samples before `next_index` are lost and not yet reported."""
        return self._lost + -(-self._fetcher.lost // self._filter.factor)

    def fetch(self, samples: int) -> SampleBatch:
        """Return the next recorded samples, at most `samples`, fewer or none when they do not arrive in time."""
        factor, wing = self._filter.factor, self._filter.wing
        begin = -(-self._fetcher.next_index // factor) if self._fetcher.lost else self.next_index
        wanted = (begin + samples - 1) * factor + wing + 1 - self._fetcher.next_index
        batch = self._fetcher.fetch(max(wanted, 1))
        if batch.samples:
            self._append(batch)
        # The instants that all their samples are there for: the first one's begin the arrays.
        count = min(max((self._counts.size - 2 * wing - 1) // factor + 1, 0), samples)
        first, lost = self.next_index, self._lost if count else 0
        if not count:
            return SampleBatch(first, 0, self._volts[:, :0], self._counts[:0], batch.force_input)
        span = (count - 1) * factor + 2 * wing + 1
        volts = upfirdn(self._filter.taps, self._volts[:, :span], down=factor, axis=-1)[
            :, 2 * WINGS : 2 * WINGS + count
        ]
        counts = self._counts[wing : wing + count * factor : factor].copy()
        self._volts, self._counts = self._volts[:, count * factor :], self._counts[count * factor :]
        self.next_index += count
        self._lost = 0
        return SampleBatch(first, lost, volts, counts, batch.force_input)

    def skip_to_newest(self) -> None:
        """Pass over the samples in the card, which count as lost."""
        self._fetcher.skip_to_newest()

    def _append(self, batch: SampleBatch) -> None:
        factor, wing = self._filter.factor, self._filter.wing
        volts, counts = batch.volts, batch.counts
        if batch.lost or batch.first_index == 0:
            first = -(-batch.first_index // factor)
            self._lost += first - self.next_index
            self.next_index = first
            # What was not sampled counts as the first sample that was.
            before = batch.first_index - (first * factor - wing)
            self._volts = np.repeat(volts[:, :1], before, axis=1)
            self._counts = np.repeat(counts[:1], before)
        self._volts = np.concatenate((self._volts, volts), axis=1)
        self._counts = np.concatenate((self._counts, counts))


@dataclass(frozen=True, slots=True)
class Tone:
    """A line of a spectrum beyond half the recorded rate."""

    rms_V: float
    frequency_hz: float
    recorded_hz: float
    """Where it would be recorded."""


@dataclass(frozen=True, slots=True)
class Alias:
    """Force beyond half the recorded rate at the input, and its share in the recorded force."""

    input_V: float
    """All of it at the input (root of the mean square)."""
    recorded_V: float
    """All of it in the record."""
    strongest: Tone
    """The highest line at the input."""
    folded: Tone
    """The highest line in the record."""


_LINE_BINS = 3
"""Bins to each side of a line's highest over which a Hann window spreads it."""


def find_aliases(volts: FloatArray, rate_hz: float, anti_alias: AntiAliasFilter, recorded_hz: float) -> Alias:
    """Return the force beyond half of a recording's rate, and the part that the recording would fold down.

    Parameters
    ----------
    volts, rate_hz
        The input, shape `(n,)`, and its sample rate, not below the recording's.
    """
    window = np.hanning(len(volts))
    spectrum = np.fft.rfft((volts - volts.mean()) * window)
    power = np.asarray(2 * np.abs(spectrum) ** 2 / (len(volts) * float(window @ window)), np.float64)
    frequency = np.asarray(np.fft.rfftfreq(len(volts), 1.0 / rate_hz), np.float64)
    beyond = frequency >= min(recorded_hz / 2, frequency[-1])
    power, frequency = power[beyond], frequency[beyond]
    folded = power * anti_alias.gain(frequency / recorded_hz) ** 2
    return Alias(
        input_V=float(np.sqrt(power.sum())),
        recorded_V=float(np.sqrt(folded.sum())),
        strongest=_highest_line(power, frequency, recorded_hz),
        folded=_highest_line(folded, frequency, recorded_hz),
    )


def _highest_line(power: FloatArray, frequency: FloatArray, recorded_hz: float) -> Tone:
    at = int(np.argmax(power))
    frequency_hz = float(frequency[at])
    return Tone(
        rms_V=float(np.sqrt(power[max(at - _LINE_BINS, 0) : at + _LINE_BINS + 1].sum())),
        frequency_hz=frequency_hz,
        recorded_hz=abs(frequency_hz - recorded_hz * round(frequency_hz / recorded_hz)),
    )
