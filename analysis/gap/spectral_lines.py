"""Lines in the spectrum at rest, mains hum above all, and the effects that the nominal model has already.

Block means average such lines out. Hum and motion errors that the nominal model contains are expected, not a gap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis import (
    AmendedModel,
    CapsuleModel,
    Experiment,
    JointProblem,
    MovingLine,
    NominalModel,
    RunSelection,
    at_rest,
    in_phase,
)
from dragrig.rig import Contact, FloatArray, Phase
from dragrig.sim_backend.effects import EffectChain

MIN_FREQUENCY_HZ, FREQUENCY_STEP_HZ = 2.5, 0.5
HOLD_SETTLING_S = 0.5
"""Time after a stop from which a hold is taken to relax smoothly."""
MAX_SEGMENT_S = 4.0
HOLD_TREND_DEGREE = 3
"""Degree of the polynomial in time that is subtracted from a hold."""
MIN_SAMPLES = 100
HANN_BANDWIDTH = 1.5
"""Equivalent noise bandwidth of a Hann window, in bins: by so much less than white noise it raises a line."""
BACKGROUND_FACTOR = 1.6
"""Noise at a frequency is estimated from frequencies up to this factor away."""
MAINS_HZ = (50.0, 60.0)
MIN_MAINS_LLR = 14.0
"""Log likelihood ratio from which on a line at a frequency of the mains is there."""
MAINS_TOLERANCE_HZ = 1.1
"""Largest distance of a mains line from a multiple of the mains frequency."""
ALIASED_MULTIPLES = 3
"""Multiples of the mains frequency whose aliases are recognised, at rates too slow for them."""


@dataclass(frozen=True, slots=True)
class SpectralLine:
    """A line in the spectrum of a channel."""

    frequency_hz: float
    """Its frequency."""
    amplitude: float
    """Its amplitude, in the channel's unit."""
    llr: float
    """Log likelihood ratio against noise alone, over all segments."""
    rate_hz: float = 0.0
    """Sampling rate of the channel, 0 where it is not known."""

    @property
    def mains_multiple_hz(self) -> float | None:
        """The multiple of 50 or 60 Hz that it is, or of which it is the alias at a slow rate; None for neither."""
        near = [mains * max(round(self.frequency_hz / mains), 1) for mains in MAINS_HZ]
        slow = [mains * multiple for mains in MAINS_HZ for multiple in range(1, ALIASED_MULTIPLES + 1)]
        sources = [(source, source) for source in near]
        sources += [
            (source, abs(source - round(source / self.rate_hz) * self.rate_hz)) for source in slow if self.rate_hz
        ]
        found = (source for source, shown in sources if abs(self.frequency_hz - shown) <= MAINS_TOLERANCE_HZ)
        return next(found, None)

    @property
    def is_mains(self) -> bool:
        """Whether it is at a multiple of 50 or 60 Hz, or at the alias of one."""
        return self.mains_multiple_hz is not None

    @property
    def source_hz(self) -> float:
        """Frequency of its source, its own unless it is an alias of the mains."""
        multiple = self.mains_multiple_hz
        aliased = multiple is not None and 0.0 < self.rate_hz < 2 * multiple
        return multiple if multiple is not None and aliased else self.frequency_hz


NO_LINE = SpectralLine(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SpectralLines:
    """The strongest mains line and the strongest other line; `llr` 0 for none."""

    mains: SpectralLine
    non_mains: SpectralLine


def lines_that_matter(lines: SpectralLines, tolerance_mN: float) -> SpectralLines:
    """Drop lines whose rms is below the tolerance: they are noise, and no gap."""
    mains, non_mains = (
        line if line.amplitude >= np.sqrt(2.0) * tolerance_mN else replace(line, llr=0.0)
        for line in (lines.mains, lines.non_mains)
    )
    return SpectralLines(mains, non_mains)


def find_spectral_lines(experiments: Sequence[Experiment], channel: str) -> SpectralLines:
    """Search all segments of a channel in which nothing changes, or merely relaxes."""
    spectrum = _spectrum(experiments, channel)
    if spectrum is None:
        return SpectralLines(NO_LINE, NO_LINE)
    lines = _lines_of(spectrum)
    mains = max((line for line in lines if line.is_mains), key=lambda line: line.llr, default=NO_LINE)
    non_mains = max((line for line in lines if not line.is_mains), key=lambda line: line.llr, default=NO_LINE)
    return SpectralLines(mains, non_mains)


def _lines_of(spectrum: "_HoldSpectrum") -> list[SpectralLine]:
    frequency, mean, background = spectrum.frequency_hz, spectrum.power, spectrum.background
    ratio = mean / background
    llr = np.where(ratio > 1, spectrum.segments * (ratio - 1 - np.log(np.maximum(ratio, 1e-12))), 0.0)
    amplitude = 2 * np.sqrt(HANN_BANDWIDTH * np.maximum(mean - background, 0.0) / spectrum.segment_samples)
    return [
        SpectralLine(float(hertz), float(size), float(ratio), spectrum.rate_hz)
        for hertz, size, ratio in zip(frequency, amplitude, llr, strict=True)
    ]


def detectable_line_amplitude(experiments: Sequence[Experiment], channel: str, llr: float) -> float | None:
    """Return the smallest mains amplitude that reaches this log likelihood ratio; None without still segments."""
    from scipy.optimize import brentq

    spectrum = _spectrum(experiments, channel)
    if spectrum is None:
        return None
    at = int(np.abs(spectrum.frequency_hz - MAINS_HZ[0]).argmin())
    excess = float(brentq(lambda ratio: spectrum.segments * (ratio - np.log1p(ratio)) - llr, 1e-9, 1e9))
    return float(2 * np.sqrt(HANN_BANDWIDTH * excess * spectrum.background[at] / spectrum.segment_samples))


@dataclass(frozen=True, slots=True, eq=False)
class _HoldSpectrum:
    """Mean power and background, shapes `(F,)`, over an effective number of independent segments."""

    frequency_hz: FloatArray
    power: FloatArray
    background: FloatArray
    segments: float
    segment_samples: float
    rate_hz: float


def _spectrum(experiments: Sequence[Experiment], channel: str) -> _HoldSpectrum | None:
    segments = [segment for experiment in experiments for segment in _still_segments(experiment, channel)]
    rate = min((segment.rate_hz for segment in segments), default=0.0)
    return _spectrum_at(segments, np.arange(MIN_FREQUENCY_HZ, 0.48 * rate, FREQUENCY_STEP_HZ))


def _spectrum_at(segments: "Sequence[_Segment]", frequency: FloatArray) -> _HoldSpectrum | None:
    """Return the mean spectrum at evenly spaced frequencies; None for fewer than two segments or ten frequencies."""
    if len(segments) < 2 or frequency.size < 10:
        return None
    rate = min(segment.rate_hz for segment in segments)
    power = np.array([_periodogram(segment, frequency) for segment in segments])
    weights = np.array([len(segment.values) for segment in segments], dtype=np.float64)
    mean = np.average(power, axis=0, weights=weights)
    effective_count = float(weights.sum() ** 2 / np.sum(weights**2))
    samples = float(np.average(weights, weights=weights))
    return _HoldSpectrum(frequency, mean, _background(frequency, mean), effective_count, samples, rate)


@dataclass(frozen=True, slots=True, eq=False)
class _Segment:
    values: FloatArray
    rate_hz: float


def _still_segments(experiment: Experiment, channel: str) -> Iterator[_Segment]:
    trace = experiment.run.trace
    if channel not in trace.channels:
        return
    values, rate = np.asarray(trace.channels[channel], dtype=np.float64), trace.sample_rate_hz
    usable = experiment.valid & np.isfinite(values)
    still, hold = at_rest(trace), in_phase(trace, Phase.HOLD)
    max_samples = int(MAX_SEGMENT_S * rate)
    rest = np.flatnonzero(still & usable)[:max_samples]
    held = np.flatnonzero(hold & usable)
    held = held[int(HOLD_SETTLING_S * rate) :][-max_samples:]
    segments = ((rest, 0), (held, 0 if experiment.contact is Contact.NONE else HOLD_TREND_DEGREE))
    for index, degree in segments:
        if index.size >= MIN_SAMPLES and np.ptp(index) == index.size - 1:
            powers = np.polynomial.legendre.legvander(np.linspace(-1, 1, index.size), degree)
            segment = values[index]
            yield _Segment(segment - powers @ np.linalg.lstsq(powers, segment, rcond=None)[0], rate)


MIN_MOVING_LINE_HZ, MAX_RIPPLE_MM = 8.0, 0.6
"""What is slower, or longer along the way, is a force that people use: folds, a ripple of the stage."""
RIPPLE_STEP_PER_MM, MAX_WAVES_PER_MM = 0.01, 10.0
MIN_MOVING_LINE_LLR, MIN_LINE_SPEEDS = 60.0, 4
"""Log likelihood ratio, and number of speeds, that show a line of the drive."""
MOVING_SEGMENT_S, DETREND_S = 2.0, 0.25
"""Steady motion is taken in pieces of the first, against its mean over the second."""


def find_moving_line(experiments: Sequence[Experiment], channel: str) -> MovingLine | None:
    """Search the steady motion of all runs for a line other than hum, at a frequency or along the way.

    A drive's controller makes such lines. They average out of the force, but not out of short blocks.
    """
    moving = [pair for experiment in experiments for pair in _moving_segments(experiment, channel)]
    if len({speed_mm_s for speed_mm_s, _ in moving}) < MIN_LINE_SPEEDS:
        return None
    rate = min(segment.rate_hz for _, segment in moving)
    frequency = np.arange(MIN_MOVING_LINE_HZ, 0.48 * rate, FREQUENCY_STEP_HZ)
    in_time = _strongest_line([segment for _, segment in moving], frequency)
    # At constant speed a wave along the way is a line, at as many waves per millimetre in all runs.
    along = [
        (speed_mm_s, replace(segment, rate_hz=segment.rate_hz / speed_mm_s))
        for speed_mm_s, segment in moving
        if speed_mm_s >= MIN_MOVING_LINE_HZ * MAX_RIPPLE_MM
    ]
    in_space = NO_LINE
    if len({speed_mm_s for speed_mm_s, _ in along}) >= MIN_LINE_SPEEDS:
        shortest = min(0.48 * min(segment.rate_hz for _, segment in along), MAX_WAVES_PER_MM)
        waves_per_mm = np.arange(1.0 / MAX_RIPPLE_MM, shortest, RIPPLE_STEP_PER_MM)
        in_space = _strongest_line([segment for _, segment in along], waves_per_mm)
    best = max((in_time, in_space), key=lambda line: line.llr)
    if best.llr < MIN_MOVING_LINE_LLR:
        return None
    if best is in_time:
        mains = find_spectral_lines(experiments, channel).mains
        # Hum is everywhere, and known already.
        is_hum = abs(mains.frequency_hz - best.frequency_hz) <= MAINS_TOLERANCE_HZ
        if is_hum and best.amplitude < NEW_HUM_FACTOR * mains.amplitude:
            return None
        return MovingLine(best.amplitude, frequency_hz=best.frequency_hz)
    return MovingLine(best.amplitude, wavelength_mm=1.0 / best.frequency_hz)


def _strongest_line(segments: "Sequence[_Segment]", frequency: FloatArray) -> SpectralLine:
    spectrum = _spectrum_at(segments, frequency)
    return NO_LINE if spectrum is None else max(_lines_of(spectrum), key=lambda line: line.llr)


def _moving_segments(experiment: Experiment, channel: str) -> Iterator[tuple[float, _Segment]]:
    """Yield pieces of steady motion with their speed [mm/s], without slow changes."""
    from scipy.ndimage import uniform_filter1d

    trace = experiment.run.trace
    if channel not in trace.channels:
        return
    values, rate = np.asarray(trace.channels[channel], dtype=np.float64), trace.sample_rate_hz
    usable = np.flatnonzero(in_phase(trace, Phase.STEADY) & experiment.valid & np.isfinite(values))
    half = round(0.5 * DETREND_S * rate)
    for piece in np.array_split(usable, max(round(usable.size / (MOVING_SEGMENT_S * rate)), 1)):
        if piece.size < max(MIN_SAMPLES, 4 * half) or half == 0 or np.ptp(piece) != piece.size - 1:
            continue
        fast = (values[piece] - uniform_filter1d(values[piece], 2 * half + 1))[half:-half]
        time_s = experiment.time_s[piece]
        travel_mm = float(np.abs(np.diff(experiment.position(time_s[[0, -1]])))[0])
        if travel_mm > 0:
            yield round(travel_mm / float(time_s[-1] - time_s[0]), 2), _Segment(fast, rate)


def moving_line_remark(line: MovingLine) -> str:
    """Return the remark on a line in motion."""
    where = f"at {line.frequency_hz:.3g} Hz" if line.frequency_hz else f"every {line.wavelength_mm:.3g} mm of travel"
    return (
        f"while the stage moves, the force has a line {where} of {line.amplitude:.2g} mN: it was taken as noise, "
        "since it averages out; look at the drive's controller and its motor"
    )


def _periodogram(segment: _Segment, frequency_hz: FloatArray) -> FloatArray:
    """Return |Σ w x exp(−2πi f t)|² over the sum of squared weights, shape `(F,)`, with a Hann window."""
    n = segment.values.size
    window = np.hanning(n + 2)[1:-1]
    length = int(2 ** np.ceil(np.log2(max(n, 8 * segment.rate_hz))))
    spectrum = np.abs(np.fft.rfft(segment.values * window, length)) ** 2 / np.sum(window**2)
    return np.asarray(np.interp(frequency_hz, np.fft.rfftfreq(length, 1 / segment.rate_hz), spectrum))


def _background(frequency_hz: FloatArray, power: FloatArray) -> FloatArray:
    """Return the median power of nearby frequencies, without the two nearest bins."""
    background = np.empty_like(power)
    for index, frequency in enumerate(frequency_hz.tolist()):
        near = (frequency_hz > frequency / BACKGROUND_FACTOR) & (frequency_hz < frequency * BACKGROUND_FACTOR)
        near &= np.abs(frequency_hz - frequency) > 2.1 * FREQUENCY_STEP_HZ
        background[index] = np.median(power[near]) if near.any() else power[index]
    return background


NEW_HUM_FACTOR = 1.5
"""A mains line counts as a gap if its amplitude exceeds the known one by this factor."""
LEAKAGE_SHARE = 0.02
"""Share of a line's log likelihood ratio that may leak to other frequencies."""


def known_effects(nominal: NominalModel) -> EffectChain:
    """Return the effects that a nominal model already contains; a friction model or an amended one may have some."""
    return EffectChain.of(nominal.settings) if isinstance(nominal, CapsuleModel | AmendedModel) else EffectChain()


def correct_known_motion(selection: RunSelection, chain: EffectChain) -> RunSelection:
    """Apply known motor effects to the command, and remove known encoder effects from the record.

    Without a gap, the stage then follows its command.
    """
    if not chain.changes_position:
        return selection
    return replace(
        selection, experiments=tuple(_with_known_motion(experiment, chain) for experiment in selection.experiments)
    )


def lines_beyond_known(lines: SpectralLines, chain: EffectChain) -> SpectralLines:
    """Remove the mains line that the nominal model contains, unless it is much larger, and its leakage."""
    for amplitude, frequency_hz in _known_lines(chain):
        same_frequency = abs(frequency_hz - lines.mains.frequency_hz) <= MAINS_TOLERANCE_HZ
        if same_frequency and lines.mains.amplitude <= NEW_HUM_FACTOR * amplitude:
            non_mains = replace(lines.non_mains, llr=max(lines.non_mains.llr - LEAKAGE_SHARE * lines.mains.llr, 0.0))
            return SpectralLines(replace(lines.mains, llr=0.0, amplitude=0.0), non_mains)
    return lines


def add_known_hum_to_noise(problem: JointProblem, chain: EffectChain) -> JointProblem:
    """Treat hum of the nominal model as noise: its phase differs from run to run."""
    noises = problem.noises
    for amplitude, frequency_hz in _known_lines(chain):
        noises = tuple(replace(noise, hum=amplitude, hum_hz=frequency_hz) for noise in noises)
    return replace(problem, noises=noises)


def without_hum(chain: EffectChain) -> EffectChain:
    """Return the chain without hum, whose phase in a run is unknown."""
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
    true_position = chain.stage_position(time, command - command[0])
    counted_position = chain.counted_position(time, true_position)
    corrected_command = true_position + command[0]
    position = np.asarray(trace.position, dtype=np.float64) - (counted_position - true_position)
    for array in (corrected_command, position):
        array.setflags(write=False)
    known = replace(trace, command=corrected_command, channels={**trace.channels, "position": position})
    return replace(experiment, run=replace(experiment.run, trace=known), computes_command=chain.moves_stage)
