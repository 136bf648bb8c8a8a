"""Lines in the spectrum at rest, mains hum above all, and the effects that the nominal model has already.

Block means average such lines out. Hum and motion errors that the nominal model contains are expected, not a gap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.inference.linear_gaussian import JointProblem
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.segments import at_rest, in_phase
from dragrig.analysis.selection import RunSelection
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase
from dragrig.sim_backend.effects.base import EffectChain

MIN_FREQUENCY_HZ, FREQUENCY_STEP_HZ = 2.5, 0.5
HOLD_SETTLING_S = 0.5
"""So long after a stop a hold is taken to relax smoothly."""
MAX_SEGMENT_S = 4.0
HOLD_TREND_DEGREE = 3
"""Power of time that is taken off a hold."""
MIN_SAMPLES = 100
BACKGROUND_FACTOR = 1.6
"""Noise at a frequency is told from frequencies up to this factor away."""
MAINS_HZ = (50.0, 60.0)
MAINS_TOLERANCE_HZ = 1.1
"""A line this near to a multiple of the mains' frequency is the mains'."""


@dataclass(frozen=True, slots=True)
class SpectralLine:
    """A line.

    Attributes
    ----------
    frequency_hz
        Where it is.
    amplitude
        How large, in the channel's unit.
    llr
        Log likelihood ratio against noise alone, over all stretches.
    """

    frequency_hz: float
    amplitude: float
    llr: float

    @property
    def is_mains(self) -> bool:
        """Whether it is at 50 or 60 Hz or a multiple of them."""
        return any(_is_harmonic(self.frequency_hz, mains) for mains in MAINS_HZ)


NO_LINE = SpectralLine(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SpectralLines:
    """The strongest line of the mains, and the strongest other one; gain 0 where there is none."""

    mains: SpectralLine
    other: SpectralLine


def find_spectral_lines(experiments: Sequence[Experiment], channel: str) -> SpectralLines:
    """Look for lines in all stretches of a channel at which nothing should change, or merely relaxes."""
    seen = _spectrum(experiments, channel)
    if seen is None:
        return SpectralLines(NO_LINE, NO_LINE)
    frequency, mean, background = seen.frequency_hz, seen.power, seen.background
    ratio = mean / background
    gain = np.where(ratio > 1, seen.segments * (ratio - 1 - np.log(np.maximum(ratio, 1e-12))), 0.0)
    amplitude = 2 * np.sqrt(np.maximum(mean - background, 0.0) / seen.segment_samples)
    found = [SpectralLine(float(f), float(a), float(g)) for f, a, g in zip(frequency, amplitude, gain, strict=True)]
    mains = max((line for line in found if line.is_mains), key=lambda line: line.llr, default=NO_LINE)
    other = max((line for line in found if not line.is_mains), key=lambda line: line.llr, default=NO_LINE)
    return SpectralLines(mains, other)


def detectable_line_amplitude(experiments: Sequence[Experiment], channel: str, llr: float) -> float | None:
    """Return the smallest amplitude of a line of the mains that would have this gain; None without still stretches."""
    from scipy.optimize import brentq

    seen = _spectrum(experiments, channel)
    if seen is None:
        return None
    at = min(range(seen.frequency_hz.size), key=lambda index: abs(float(seen.frequency_hz[index]) - MAINS_HZ[0]))
    beyond = float(brentq(lambda more: seen.segments * (more - np.log1p(more)) - llr, 1e-9, 1e9))
    return float(2 * np.sqrt(beyond * seen.background[at] / seen.segment_samples))


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Power over all stretches and about each frequency, shapes `(F,)`, from so many independent stretches."""

    frequency_hz: FloatArray
    power: FloatArray
    background: FloatArray
    segments: float
    segment_samples: float


def _spectrum(experiments: Sequence[Experiment], channel: str) -> _Spectrum | None:
    stretches = [segment for experiment in experiments for segment in _still_segments(experiment, channel)]
    if len(stretches) < 2:
        return None
    rate = min(segment.rate_hz for segment in stretches)
    frequency = np.arange(MIN_FREQUENCY_HZ, 0.48 * rate, FREQUENCY_STEP_HZ)
    if frequency.size < 10:
        return None
    power = np.array([_periodogram(segment, frequency) for segment in stretches])
    weights = np.array([len(segment.values) for segment in stretches], dtype=np.float64)
    mean = np.average(power, axis=0, weights=weights)
    degrees = float(weights.sum() ** 2 / np.sum(weights**2))
    samples = float(np.average(weights, weights=weights))
    return _Spectrum(frequency, mean, _background(frequency, mean), degrees, samples)


@dataclass(frozen=True, slots=True, eq=False)
class _StillSegment:
    values: FloatArray
    rate_hz: float


def _still_segments(experiment: Experiment, channel: str) -> Iterator[_StillSegment]:
    trace = experiment.run.trace
    if channel not in trace.channels:
        return
    values, rate = np.asarray(trace.channels[channel], dtype=np.float64), trace.sample_rate_hz
    usable = experiment.valid & np.isfinite(values)
    still, hold = at_rest(trace), in_phase(trace, Phase.HOLD)
    longest = int(MAX_SEGMENT_S * rate)
    rest = np.flatnonzero(still & usable)[:longest]
    later = np.flatnonzero(hold & usable)
    later = later[int(HOLD_SETTLING_S * rate) :][-longest:]
    parts = ((rest, 0), (later, 0 if experiment.contact is Contact.NONE else HOLD_TREND_DEGREE))
    for index, degree in parts:
        if index.size >= MIN_SAMPLES and np.ptp(index) == index.size - 1:
            powers = np.polynomial.legendre.legvander(np.linspace(-1, 1, index.size), degree)
            array = values[index]
            yield _StillSegment(array - powers @ np.linalg.lstsq(powers, array, rcond=None)[0], rate)


def _periodogram(stretch: _StillSegment, frequency_hz: FloatArray) -> FloatArray:
    """Return |Σ w x exp(−2πi f t)|² over the sum of squared weights, shape `(F,)`, with a Hann window."""
    n = stretch.values.size
    window = np.hanning(n + 2)[1:-1]
    length = int(2 ** np.ceil(np.log2(max(n, 8 * stretch.rate_hz))))
    spectrum = np.abs(np.fft.rfft(stretch.values * window, length)) ** 2 / np.sum(window**2)
    return np.asarray(np.interp(frequency_hz, np.fft.rfftfreq(length, 1 / stretch.rate_hz), spectrum))


def _background(frequency_hz: FloatArray, power: FloatArray) -> FloatArray:
    """Return the median power of frequencies near each one, what is within two bins of it left out."""
    result = np.empty_like(power)
    for index, frequency in enumerate(frequency_hz.tolist()):
        near = (frequency_hz > frequency / BACKGROUND_FACTOR) & (frequency_hz < frequency * BACKGROUND_FACTOR)
        near &= np.abs(frequency_hz - frequency) > 2.1 * FREQUENCY_STEP_HZ
        result[index] = np.median(power[near]) if near.any() else power[index]
    return result


def _is_harmonic(frequency_hz: float, mains_hz: float) -> bool:
    multiple = max(round(frequency_hz / mains_hz), 1)
    return abs(frequency_hz - multiple * mains_hz) <= MAINS_TOLERANCE_HZ


MAINS_HUM = "mains_hum"
NEW_HUM_FACTOR = 1.5
"""A line is a gap beside the known one if it is so many times as large."""
LEAKAGE_SHARE = 0.02
"""Share of a line's gain that may show at other frequencies."""


def known_effects(nominal: NominalModel) -> EffectChain:
    """Return the effects that a nominal model has already; only the friction model can have any."""
    return EffectChain.of(nominal.settings) if isinstance(nominal, CapsuleModel) else EffectChain()


def correct_known_motion(selection: RunSelection, chain: EffectChain) -> RunSelection:
    """Let the command be where the motor's known effects take the stage, and the record what the stage did.

    The stage then goes where it is told to unless there is a gap: what the encoder's known effects add to a record is
    taken out of it.
    """
    if not chain.changes_position:
        return selection
    return replace(
        selection, experiments=tuple(_with_known_motion(experiment, chain) for experiment in selection.experiments)
    )


def lines_beyond_known(lines: SpectralLines, chain: EffectChain) -> SpectralLines:
    """Leave the mains' line out where the nominal model has it, unless it is much larger, and what leaks from it."""
    for amplitude, frequency_hz in _known_lines(chain):
        near = abs(frequency_hz - lines.mains.frequency_hz) <= MAINS_TOLERANCE_HZ
        if near and lines.mains.amplitude <= NEW_HUM_FACTOR * amplitude:
            line = replace(lines.other, llr=max(lines.other.llr - LEAKAGE_SHARE * lines.mains.llr, 0.0))
            return SpectralLines(replace(lines.mains, llr=0.0, amplitude=0.0), line)
    return lines


def add_known_hum_to_noise(problem: JointProblem, chain: EffectChain) -> JointProblem:
    """Count hum that the nominal model has as noise: no run starts in step with the mains."""
    noises = problem.noises
    for amplitude, frequency_hz in _known_lines(chain):
        noises = tuple(replace(noise, hum=amplitude, hum_hz=frequency_hz) for noise in noises)
    return replace(problem, noises=noises)


def without_hum(chain: EffectChain) -> EffectChain:
    """Return the effects without the hum, whose phase in a run nobody knows."""
    return chain.only(lambda effect: not effect.spectral_line)


def _known_lines(chain: EffectChain) -> Iterator[tuple[float, float]]:
    """Yield amplitude and frequency of the chain's spectral lines."""
    for active in chain.effects:
        if active.effect.spectral_line and active.effect.period is not None:
            yield active.values[active.effect.size.name], active.values[active.effect.period.name]


def _with_known_motion(experiment: Experiment, chain: EffectChain) -> Experiment:
    trace, time = experiment.run.trace, experiment.time_s
    command = np.asarray(trace.command, dtype=np.float64)
    if "position" not in trace.channels or not np.isfinite(command).all():
        return experiment
    moved = chain.stage_position(time, command - command[0])
    counted = chain.counted_position(time, moved)
    there = moved + command[0]
    position = np.asarray(trace.position, dtype=np.float64) - (counted - moved)
    for array in (there, position):
        array.setflags(write=False)
    known = replace(trace, command=there, channels={**trace.channels, "position": position})
    return replace(experiment, run=replace(experiment.run, trace=known), computes_command=chain.moves_stage)
