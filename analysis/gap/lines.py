"""Lines in the spectrum of a channel that stands still: what blocks average out, mains hum above all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import at_rest, in_phase
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

LOWEST_HZ, STEP_HZ = 2.5, 0.5
SETTLED_S = 0.5
"""So long after a stop a hold is taken to relax smoothly."""
LONGEST_S = 4.0
RELAXING = 3
"""Power of time that is taken off a hold."""
FEWEST_SAMPLES = 100
NEIGHBOURS = 1.6
"""Noise at a frequency is told from frequencies up to this factor away."""
MAINS_HZ = (50.0, 60.0)
WITHIN_HZ = 1.1
"""A line this near to a multiple of the mains' frequency is the mains'."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line.

    Attributes
    ----------
    frequency_hz
        Where it is.
    amplitude
        How large, in the channel's unit.
    gain
        Log likelihood ratio against noise alone, over all stretches.
    """

    frequency_hz: float
    amplitude: float
    gain: float

    @property
    def mains(self) -> bool:
        """Whether it is at 50 or 60 Hz or a multiple of them."""
        return any(_near(self.frequency_hz, mains) for mains in MAINS_HZ)


NO_LINE = Line(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Lines:
    """The strongest line of the mains, and the strongest other one; gain 0 where there is none."""

    mains: Line
    other: Line


def find_lines(experiments: Sequence[Experiment], channel: str) -> Lines:
    """Look for lines in all stretches of a channel at which nothing should change, or merely relaxes."""
    seen = _spectrum(experiments, channel)
    if seen is None:
        return Lines(NO_LINE, NO_LINE)
    frequency, mean, background = seen.frequency_hz, seen.power, seen.background
    ratio = mean / background
    gain = np.where(ratio > 1, seen.degrees * (ratio - 1 - np.log(np.maximum(ratio, 1e-12))), 0.0)
    amplitude = 2 * np.sqrt(np.maximum(mean - background, 0.0) / seen.samples)
    found = [Line(float(f), float(a), float(g)) for f, a, g in zip(frequency, amplitude, gain, strict=True)]
    mains = max((one for one in found if one.mains), key=lambda one: one.gain, default=NO_LINE)
    other = max((one for one in found if not one.mains), key=lambda one: one.gain, default=NO_LINE)
    return Lines(mains, other)


def least_line(experiments: Sequence[Experiment], channel: str, gain: float) -> float | None:
    """Return the smallest amplitude of a line of the mains that would have this gain; None without still stretches."""
    from scipy.optimize import brentq

    seen = _spectrum(experiments, channel)
    if seen is None:
        return None
    at = min(range(seen.frequency_hz.size), key=lambda one: abs(float(seen.frequency_hz[one]) - MAINS_HZ[0]))
    beyond = float(brentq(lambda more: seen.degrees * (more - np.log1p(more)) - gain, 1e-9, 1e9))
    return float(2 * np.sqrt(beyond * seen.background[at] / seen.samples))


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Power over all stretches and about each frequency, shapes `(F,)`, from so many independent stretches."""

    frequency_hz: FloatArray
    power: FloatArray
    background: FloatArray
    degrees: float
    samples: float


def _spectrum(experiments: Sequence[Experiment], channel: str) -> _Spectrum | None:
    stretches = [one for experiment in experiments for one in _quiet(experiment, channel)]
    if len(stretches) < 2:
        return None
    rate = min(one.rate_hz for one in stretches)
    frequency = np.arange(LOWEST_HZ, 0.48 * rate, STEP_HZ)
    if frequency.size < 10:
        return None
    power = np.array([_periodogram(one, frequency) for one in stretches])
    weights = np.array([len(one.values) for one in stretches], dtype=np.float64)
    mean = np.average(power, axis=0, weights=weights)
    degrees = float(weights.sum() ** 2 / np.sum(weights**2))
    samples = float(np.average(weights, weights=weights))
    return _Spectrum(frequency, mean, _background(frequency, mean), degrees, samples)


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    values: FloatArray
    rate_hz: float


def _quiet(experiment: Experiment, channel: str) -> Iterator[_Stretch]:
    trace = experiment.run.trace
    if channel not in trace.channels:
        return
    values, rate = np.asarray(trace.channels[channel], dtype=np.float64), trace.sample_rate_hz
    usable = experiment.valid & np.isfinite(values)
    still, hold = at_rest(trace), in_phase(trace, Phase.HOLD)
    longest = int(LONGEST_S * rate)
    rest = np.flatnonzero(still & usable)[:longest]
    later = np.flatnonzero(hold & usable)
    later = later[int(SETTLED_S * rate) :][-longest:]
    parts = ((rest, 0), (later, 0 if experiment.contact is Contact.NONE else RELAXING))
    for index, degree in parts:
        if index.size >= FEWEST_SAMPLES and np.ptp(index) == index.size - 1:
            powers = np.polynomial.legendre.legvander(np.linspace(-1, 1, index.size), degree)
            part = values[index]
            yield _Stretch(part - powers @ np.linalg.lstsq(powers, part, rcond=None)[0], rate)


def _periodogram(stretch: _Stretch, frequency_hz: FloatArray) -> FloatArray:
    """Return |Σ w x exp(−2πi f t)|² over the sum of squared weights, shape `(F,)`, with a Hann window."""
    n = stretch.values.size
    window = np.hanning(n + 2)[1:-1]
    length = int(2 ** np.ceil(np.log2(max(n, 8 * stretch.rate_hz))))
    spectrum = np.abs(np.fft.rfft(stretch.values * window, length)) ** 2 / np.sum(window**2)
    return np.asarray(np.interp(frequency_hz, np.fft.rfftfreq(length, 1 / stretch.rate_hz), spectrum))


def _background(frequency_hz: FloatArray, power: FloatArray) -> FloatArray:
    """Return the median power of frequencies near each one, what is within two bins of it left out."""
    found = np.empty_like(power)
    for index, frequency in enumerate(frequency_hz.tolist()):
        near = (frequency_hz > frequency / NEIGHBOURS) & (frequency_hz < frequency * NEIGHBOURS)
        near &= np.abs(frequency_hz - frequency) > 2.1 * STEP_HZ
        found[index] = np.median(power[near]) if near.any() else power[index]
    return found


def _near(frequency_hz: float, mains_hz: float) -> bool:
    multiple = max(round(frequency_hz / mains_hz), 1)
    return abs(frequency_hz - multiple * mains_hz) <= WITHIN_HZ
