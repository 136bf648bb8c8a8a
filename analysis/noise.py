"""Noise of a channel, and its trace as means over blocks of time, short where the prediction changes fast.

White noise, slow noise with exponential correlation, and 1/f noise where there is any, come from where the force
stands still: the rests before a motion, the holds of capsules that nothing squeezes, and the ends of relaxations'
holds, from which a cubic is subtracted; from slow steady motion too, where it shows the same noise.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.models import Experiment
from dragrig.analysis.segments import at_rest, in_phase, mask_spans
from dragrig.rig import Contact, FloatArray, IndexArray, Phase

NOISE_BLOCK_S = 0.05
"""Stretches are averaged in blocks of this length; differences of samples show faster noise."""
MIN_BLOCKS = 8
MAX_DIFFERENCE_SIGMAS, MAX_OUTSIDE_SHARE = 6.0, 0.9
"""Differences beyond so many standard deviations are of small impulses, and no noise, unless there are many of them."""
MIN_DIFFERENCES = 12
"""Fewer differences in all runs do not show the noise."""
MAX_STRETCH_S = 60.0
"""Longest part of a stretch that is used."""
RELAXATION_DEGREE = 3
"""Degree of the polynomial that is subtracted from the end of a relaxation."""
CLEAR_TREND = 100.0
"""A force relaxes at rest where the squares of its trend are so many times what blocks differ by from one to the next;
slow noise of 5 s correlation reaches a third of it."""
CREEPING_PIECE_S, CREEPING_MM, CREEPING_DEGREE = 2.0, 1.0, 2
"""Slow motion shows slow noise in pieces of this time and travel, of which a parabola is subtracted."""
MAX_POOLING_LOSS = 9.0
"""Twice the log likelihood ratio that rests may lose where slow motion shows the same noise: 1 % by chance."""
MIN_MOVING_SAMPLES = 100
"""Samples of steady motion that show white noise where nothing rests."""
MIN_RUNS_IN_MOTION = 4
CLEAR_ADDED_SHARE = 0.4
"""Motion adds noise where its variance exceeds that at rest by this share; a 12-bit converter makes a third of it."""
NORMAL_MEDIAN = 0.6745
"""Median over standard deviation of a normal distribution's magnitudes."""
MIN_WHITE_SHARE = 1e-5
"""Smallest white noise relative to the channel's largest value, about a step of a 16-bit converter."""
DEFAULT_CORRELATION_S = 0.2
MAX_CORRELATION_S = 5.0
DEFAULT_SLOW_SHARE = 1.0 / 3.0
"""Slow noise over white noise where no stretch is long enough to show it."""
DEFAULT_WHITE = 2.0
"""White noise [mN] where no run shows any, at the upper end for such sensors."""
FLICKER_TIMES_S = tuple(40.0 * 0.25**number for number in range(10))
"""Correlation times whose noises, of equal variance, add up to 1/f noise from 0.004 Hz to 1 kHz within 5 %."""
MIN_FLICKER_GAIN = 1.5
"""Twice the log likelihood ratio above which there is 1/f noise; 11 campaigns without it reached 0.1 at most."""
FIRST_FLICKER_FACTORS = (
    (0.9, 1.0, 0.3),
    (0.8, 1.0, 0.6),
    (0.8, 2.0, 0.6),
    (0.6, 2.0, 1.0),
    (0.3, 1.0, 1.0),
    (0.3, 1.0, 3.0),
)
MAX_FIRST_LOSS = 20.0
"""`FIRST_FLICKER_FACTORS`: factors on slow noise as it was, on its time, and on 1/f noise of a usual size, one of which
must be likelier than no 1/f noise less `MAX_FIRST_LOSS`, or it is not fitted."""
PRIOR_SDS = np.array([np.log(3.0), np.log(3.0), 2.0 * np.log(3.0), 0.15])
"""Prior standard deviations of the logarithms of slow noise, its time and 1/f noise, and of the power of the latter."""
MAX_POWER_OFF = 0.4
MAX_FLICKER_BLOCKS = 240
"""Longer stretches have wider blocks in the search for 1/f noise."""
MIN_WHITE_PART = 0.1
"""Smallest part of the differences between samples that is white noise, in standard deviations."""
LINE_COHERENCE_S = 1.0
"""Time over which a line stays coherent with its stated frequency."""
MAINS_HZ, MAINS_WANDER_HZ, MAX_SLOW_ALIAS_HZ = (50.0, 60.0), 0.03, 0.2
"""Mains frequencies, how far they are off at any time, one standard deviation, and the highest frequency as which slow
sampling shows them that no rest is long enough for."""
MAINS_AMPLITUDES = (0.4, 0.7, 1.0, 1.5, 2.0)
"""Amplitudes of such a line that are tried, relative to white noise."""
LINE_FIT_S = 0.5
"""A line is removed with amplitude and phase of its own in pieces of this length."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of a channel, in its unit."""

    white: float
    """Standard deviation of one sample's white noise."""
    slow: float
    correlation_s: float
    """`slow`, `correlation_s`: standard deviation and correlation time of the slow noise."""
    degrees: int
    """Independent numbers of the estimate; 0 where the noise was assumed."""
    hum: float = 0.0
    hum_hz: float = 0.0
    """`hum`, `hum_hz`: amplitude and frequency of a known line, 0 for none; its phase is not known. A frequency of 0 is
    of the mains sampled at its own rate, which wander about each other.
    """
    flicker: float = 0.0
    step_s: float = 0.0
    """`flicker`, `step_s`: standard deviation of 1/f noise within each of `FLICKER_TIMES_S`, 0 for none, and the time
    between samples; what is faster than that counts as white.
    """
    flicker_power: float = 1.0
    """Power of the frequency with which 1/f noise falls: `flicker` is then its part with a correlation time of 1 s."""

    @property
    def flicker_times_s(self) -> tuple[float, ...]:
        """Correlation times of the 1/f noise, the longest first."""
        return tuple(time_s for time_s in FLICKER_TIMES_S if time_s >= self.step_s)

    @property
    def flicker_variances(self) -> FloatArray:
        """Variance of the 1/f noise within each of its correlation times."""
        return np.asarray(self.flicker**2 * np.array(self.flicker_times_s) ** (self.flicker_power - 1.0))

    @property
    def slow_sd(self) -> float:
        """Standard deviation of all slow noise."""
        of_mains = self.hum / np.sqrt(2.0) if self.hum_hz == 0.0 else 0.0
        return float(np.sqrt(self.slow**2 + self.flicker_variances.sum() + of_mains**2))

    def covariance(self, start_s: FloatArray, end_s: FloatArray, samples: FloatArray) -> FloatArray:
        """Return the covariance of means over successive stretches of time, shapes `(B,)` to `(B, B)`."""
        pairs = BlockPairs.all_of(start_s, end_s, samples)
        covariance, values = np.empty((samples.size, samples.size)), self.covariances(pairs)
        covariance[pairs.late, pairs.early] = values
        covariance[pairs.early, pairs.late] = values
        return covariance

    def covariances(self, pairs: "BlockPairs") -> FloatArray:
        """Return the covariance of the means of each pair of blocks, shape `(N,)`."""
        covariances = self.slow**2 * pairs.correlation(self.correlation_s)
        if self.flicker > 0:
            for variance, correlation in zip(self.flicker_variances, pairs.flicker_correlations, strict=False):
                covariances += variance * correlation
        covariances[pairs.same] += self.white**2 / pairs.samples[pairs.late[pairs.same]]
        if self.hum > 0:
            lag = pairs.lag_s
            attenuation = np.sinc(self.hum_hz * (pairs.end_s - pairs.start_s))
            coherence = np.exp(-lag / LINE_COHERENCE_S)
            if self.hum_hz == 0.0:
                coherence = np.exp(-0.5 * (2 * np.pi * MAINS_WANDER_HZ * lag) ** 2)
            wave = np.cos(2 * np.pi * self.hum_hz * lag) * coherence
            covariances += 0.5 * self.hum**2 * wave * attenuation[pairs.late] * attenuation[pairs.early]
        return np.asarray(covariances)


@dataclass(frozen=True, eq=False)
class BlockPairs:
    """Pairs of successive blocks of time, and the common part of covariances of their means under any noise."""

    start_s: FloatArray
    end_s: FloatArray
    samples: FloatArray
    """`start_s`, `end_s`, `samples`: of the blocks, shape `(B,)`."""
    late: IndexArray
    early: IndexArray
    """`late`, `early`: numbers of the later and the earlier block of each pair, shape `(N,)`."""
    same: IndexArray
    """Numbers of the pairs of a block with itself."""

    @classmethod
    def all_of(cls, start_s: FloatArray, end_s: FloatArray, samples: FloatArray) -> "BlockPairs":
        """Pair each block with itself and all before it, by rows of a lower triangle."""
        late, early = np.tril_indices(samples.size)
        return cls(start_s, end_s, samples, late, early, np.flatnonzero(late == early))

    @classmethod
    def even(cls, blocks: int, width_s: float, samples: int) -> "BlockPairs":
        """Pair the first of `blocks` of one width with each: the first column of a Toeplitz matrix."""
        start_s, first = width_s * np.arange(blocks, dtype=np.float64), np.zeros(blocks, dtype=np.intp)
        return cls(start_s, start_s + width_s, np.full(blocks, float(samples)), np.arange(blocks), first, first[:1])

    @cached_property
    def lag_s(self) -> FloatArray:
        """Time between the middles of the blocks, shape `(N,)`."""
        middle_s = 0.5 * (self.start_s + self.end_s)
        return np.asarray(np.abs(middle_s[self.late] - middle_s[self.early]))

    @cached_property
    def flicker_correlations(self) -> FloatArray:
        """Correlation of means of noise with each of `FLICKER_TIMES_S`, shape `(T, N)`."""
        correlations, decay = np.empty((len(FLICKER_TIMES_S), self.late.size)), self._decay(FLICKER_TIMES_S[0])
        for number, time_s in enumerate(FLICKER_TIMES_S):
            # Each time is a quarter of the one before.
            decay = (decay**2) ** 2 if number else decay
            correlations[number] = self._of_means(decay, time_s)
        return correlations

    def correlation(self, time_s: float) -> FloatArray:
        """Return the covariance of means of noise with exponential correlation and unit variance, shape `(N,)`.

        `time_s` is its correlation time.
        """
        return self._of_means(self._decay(time_s), time_s)

    def _decay(self, time_s: float) -> FloatArray:
        """Return the correlation of such noise over the time from the end of one block to the start of the other."""
        apart_s = np.maximum(self.start_s[self.late] - self.end_s[self.early], 0.0)
        return np.asarray(np.exp(-apart_s / time_s))

    def _of_means(self, decay: FloatArray, time_s: float) -> FloatArray:
        width_s = np.maximum(self.end_s - self.start_s, 1e-9)
        share = -np.expm1(-width_s / time_s) * time_s / width_s
        correlation = decay * share[self.late] * share[self.early]
        itself = self.late[self.same]
        correlation[self.same] = 2 * (time_s / width_s[itself]) * (1 - share[itself])
        return np.asarray(correlation)


DEFAULT_NOISE = NoiseModel(DEFAULT_WHITE, DEFAULT_SLOW_SHARE * DEFAULT_WHITE, DEFAULT_CORRELATION_S, 0)


@dataclass(frozen=True, slots=True, eq=False)
class _QuietStretch:
    """Samples that differ by noise and by a polynomial of time of this degree only."""

    values: FloatArray
    rate_hz: float
    degree: int


@dataclass(frozen=True)
class _BlockLayout:
    """Shape of a stretch of block means: number, width and samples of the blocks, and the degree of its polynomial."""

    blocks: int
    width_s: float
    samples: int
    degree: int

    @cached_property
    def pairs(self) -> BlockPairs:
        """The first block with each."""
        return BlockPairs.even(self.blocks, self.width_s, self.samples)

    @cached_property
    def polynomials(self) -> FloatArray:
        """Shape `(blocks, degree + 1)`."""
        return np.asarray(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, self.blocks), self.degree))


@dataclass(frozen=True, slots=True, eq=False)
class RepeatDifference:
    """Block means of a run less those of a repeat: noise, and the offset of either run as a whole."""

    start_s: FloatArray
    end_s: FloatArray
    samples: FloatArray
    """`start_s`, `end_s`, `samples`: start, end and samples of the blocks, shape `(B,)`."""
    difference: FloatArray
    """Shape `(B,)`."""
    signatures: FloatArray
    """What the runs' own zeros and factors change, shape `(B, k)`."""


def estimate_noise(
    experiments: Iterable[Experiment],
    channel: str,
    hum: float = 0.0,
    hum_hz: float = 0.0,
    repeats: Sequence[RepeatDifference] = (),
) -> NoiseModel:
    """Estimate a channel's noise from all stretches in which it should be constant or merely relaxes.

    Restricted maximum likelihood of block means, each stretch with a polynomial of its own; where stretches are too
    short for slow noise, a third of the white noise with 0.2 s correlation is assumed. Where there are none, white
    noise is the difference of neighbouring samples of steady motion beyond a straight line, and `DEFAULT_NOISE` where
    there is no steady motion either; both count as assumed.

    Parameters
    ----------
    hum, hum_hz
        Amplitude and frequency of a known line, which is removed first; 0 for none.
    repeats
        Differences of repeats: over the length of a run they show noise that is slower than rests are long. It counts
        as far as the rests may have the same noise.
    """
    runs = tuple(experiments)
    squares, count, largest = 0.0, 0, 0.0
    still = _BlockGroups()
    for quiet in _quiet_stretches(runs, channel):
        stretch = _remove_line(quiet, hum_hz) if hum > 0 else quiet
        square, number = _difference_squares(np.diff(stretch.values))
        squares, count = squares + square, count + number
        largest = max(largest, float(np.abs(stretch.values).max()))
        still.add(stretch)
    if count < MIN_DIFFERENCES:
        return replace(_estimate_in_motion(runs, channel), hum=hum, hum_hz=hum_hz if hum > 0 else 0.0)
    white = max(float(np.sqrt(squares / count)), MIN_WHITE_SHARE * largest, 1e-9)
    slow, correlation_s = DEFAULT_SLOW_SHARE * white, DEFAULT_CORRELATION_S
    groups = still.groups
    if groups:
        slow, correlation_s = _fit_slow_noise(groups, white)
        creeping = _BlockGroups()
        for quiet in _creeping_stretches(runs, channel):
            creeping.add(_remove_line(quiet, hum_hz) if hum > 0 else quiet)
        groups = _pooled_if_alike(groups, creeping.groups, white, (slow, correlation_s))
        if groups is not still.groups:
            slow, correlation_s = _fit_slow_noise(groups, white)
    # Differences of neighbours hold two independent numbers in three.
    noise = NoiseModel(white, slow, correlation_s, count * 2 // 3, hum, hum_hz if hum > 0 else 0.0)
    return _with_flicker(noise, groups, repeats) if groups else noise


def _difference_squares(differences: FloatArray) -> tuple[float, int]:
    """Return half the sum of the squares of differences without those far outside, and their number."""
    squares = differences**2
    kept = squares <= MAX_DIFFERENCE_SIGMAS**2 * float(np.mean(squares))
    while not kept.all():
        before, squares = squares.size, squares[kept]
        kept = squares <= MAX_DIFFERENCE_SIGMAS**2 * float(np.mean(squares))
        if squares.size < MAX_OUTSIDE_SHARE * before:
            break
    return 0.5 * float(np.sum(squares)), squares.size


class _BlockGroups:
    """Block means of stretches, those of one layout together."""

    def __init__(self) -> None:
        self.groups: dict[_BlockLayout, list[FloatArray]] = {}

    def add(self, stretch: _QuietStretch) -> None:
        size = max(1, round(NOISE_BLOCK_S * stretch.rate_hz))
        blocks = min(len(stretch.values) // size, round(MAX_STRETCH_S * stretch.rate_hz / size))
        if blocks >= MIN_BLOCKS:
            means = stretch.values[: blocks * size].reshape(blocks, size).mean(axis=1)
            layout = _BlockLayout(blocks, size / stretch.rate_hz, size, _sufficient_degree(means, stretch.degree))
            self.groups.setdefault(layout, []).append(means)


def _sufficient_degree(means: FloatArray, degree: int) -> int:
    """Return the degree of the polynomial to subtract: more than stated where the force relaxes all the same."""
    if degree >= RELAXATION_DEGREE:
        return degree
    powers = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, means.size), RELAXATION_DEGREE)
    trend = np.linalg.qr(powers)[0][:, degree + 1 :].T @ means
    from_block_to_block = float(np.mean(np.diff(means) ** 2)) / 2
    return RELAXATION_DEGREE if float(trend @ trend) > CLEAR_TREND * trend.size * from_block_to_block else degree


def _pooled_if_alike(
    still: dict[_BlockLayout, list[FloatArray]],
    creeping: dict[_BlockLayout, list[FloatArray]],
    white: float,
    fitted: tuple[float, float],
) -> dict[_BlockLayout, list[FloatArray]]:
    """Return stretches at rest and in slow motion together, where one slow noise explains both; else those at rest.

    Rests are short and show little of the slow noise; slow motion of it may have forces that are no noise.
    """
    if not creeping:
        return still
    together = {layout: [*still.get(layout, ()), *creeping.get(layout, ())] for layout in (*still, *creeping)}
    pooled = _fit_slow_noise(together, white)

    def misfit(slow_noise: tuple[float, float]) -> float:
        noise = NoiseModel(white, *slow_noise, 0)
        return sum(_restricted_likelihood(noise, layout, np.array(means)) for layout, means in still.items())

    return together if misfit(pooled) - misfit(fitted) < MAX_POOLING_LOSS else still


def _recorded(experiments: Iterable[Experiment], channel: str) -> Iterator[tuple[Experiment, FloatArray]]:
    """Yield the runs that recorded a channel, with its values."""
    for experiment in experiments:
        if channel in experiment.run.trace.channels:
            yield experiment, np.asarray(experiment.run.trace.channels[channel], dtype=np.float64)


def _estimate_in_motion(experiments: Sequence[Experiment], channel: str) -> NoiseModel:
    """White noise that steady motion shows from sample to sample; slower noise looks like a signal."""
    curvatures, largest = [np.zeros(0)], 0.0
    for experiment, values in _recorded(experiments, channel):
        trace = experiment.run.trace
        for start, stop in mask_spans(in_phase(trace, Phase.STEADY) & experiment.valid & np.isfinite(values)):
            curvatures.append(np.abs(np.diff(values[start:stop], 2)) / np.sqrt(6.0))
            largest = max(largest, float(np.abs(values[start:stop]).max()))
    curvature = np.concatenate(curvatures)
    if curvature.size < MIN_MOVING_SAMPLES:
        return DEFAULT_NOISE
    white = max(float(np.median(curvature)) / NORMAL_MEDIAN, MIN_WHITE_SHARE * largest, 1e-9)
    return NoiseModel(white, DEFAULT_SLOW_SHARE * white, DEFAULT_CORRELATION_S, 0)


def added_white_in_motion(experiments: Iterable[Experiment], channel: str) -> float:
    """Return the standard deviation of the white noise that steady motion adds to that of the rests; 0 for none.

    Both are read from how samples differ from the straight line between their neighbours, so that a slow change
    is no noise; the median of the runs counts, so that it is not of a single speed or place.
    """
    moving, resting = list[float](), list[float]()
    for experiment, values in _recorded(experiments, channel):
        trace = experiment.run.trace
        usable = experiment.valid & np.isfinite(values)
        for phase_values, mask in ((moving, in_phase(trace, Phase.STEADY)), (resting, at_rest(trace))):
            bends = [np.diff(values[start:stop], 2) for start, stop in mask_spans(mask & usable) if stop - start > 2]
            samples = np.concatenate(bends) if bends else np.zeros(0)
            if samples.size >= MIN_MOVING_SAMPLES:
                half_squares, count = _difference_squares(samples)
                phase_values.append(half_squares / (3.0 * count))
    if min(len(moving), len(resting)) < MIN_RUNS_IN_MOTION:
        return 0.0
    at_rest_variance = float(np.mean(resting))
    added = float(np.median(moving)) - at_rest_variance
    return float(np.sqrt(added)) if added > CLEAR_ADDED_SHARE * at_rest_variance else 0.0


def _quiet_stretches(experiments: Iterable[Experiment], channel: str) -> Iterator[_QuietStretch]:
    for experiment, values in _recorded(experiments, channel):
        trace = experiment.run.trace
        usable = experiment.valid & np.isfinite(values)
        still, relaxing = at_rest(trace), np.zeros_like(usable)
        if experiment.contact is Contact.NONE:
            still = still | in_phase(trace, Phase.HOLD)
        elif experiment.contact is Contact.STICKING:
            hold = np.flatnonzero(in_phase(trace, Phase.HOLD))
            relaxing[hold[hold.size - min(hold.size // 2, int(MAX_STRETCH_S * trace.sample_rate_hz)) :]] = True
        for part, degree in ((still, 0), (relaxing, RELAXATION_DEGREE)):
            for start, stop in mask_spans(part & usable):
                if stop - start > 2:
                    yield _QuietStretch(values[start:stop], trace.sample_rate_hz, degree)


def _creeping_stretches(experiments: Iterable[Experiment], channel: str) -> Iterator[_QuietStretch]:
    """Yield pieces of slow steady motion in which the stage moves so little that nothing changes with the place."""
    for experiment, values in _recorded(experiments, channel):
        trace = experiment.run.trace
        steady = in_phase(trace, Phase.STEADY)
        if np.count_nonzero(steady) < MIN_MOVING_SAMPLES:
            continue
        times_s = experiment.time_s[steady][[0, -1]]
        travel_mm = float(np.abs(np.diff(experiment.position(times_s)))[0])
        duration_s = float(times_s[1] - times_s[0])
        piece_s = min(CREEPING_PIECE_S, CREEPING_MM * duration_s / max(travel_mm, 1e-9))
        size = round(piece_s * trace.sample_rate_hz)
        if piece_s < MIN_BLOCKS * NOISE_BLOCK_S or duration_s < 2 * piece_s:
            continue
        late = experiment.time_s > times_s[0] + CREEPING_PIECE_S
        for start, stop in mask_spans(steady & late & experiment.valid & np.isfinite(values)):
            for begin in range(start, stop - size + 1, size):
                yield _QuietStretch(values[begin : begin + size], trace.sample_rate_hz, CREEPING_DEGREE)


def _remove_line(stretch: _QuietStretch, hertz: float) -> _QuietStretch:
    """Subtract a sine from a stretch, piece by piece, fitted with a straight line in each."""
    size = max(round(LINE_FIT_S * stretch.rate_hz), MIN_DIFFERENCES)
    remainders = []
    for piece in np.array_split(stretch.values, max(stretch.values.size // size, 1)):
        sample = np.arange(piece.size, dtype=np.float64)
        angle = 2 * np.pi * hertz / stretch.rate_hz * sample
        columns = np.column_stack((np.cos(angle), np.sin(angle), np.ones_like(sample), sample))
        coefficients = np.linalg.lstsq(columns, piece, rcond=None)[0]
        remainders.append(piece - columns[:, :2] @ coefficients[:2])
    return replace(stretch, values=np.concatenate(remainders))


def _fit_slow_noise(groups: dict[_BlockLayout, list[FloatArray]], white: float) -> tuple[float, float]:
    from scipy.optimize import minimize

    stacks = [(layout, np.array(means)) for layout, means in groups.items()]
    start = np.log([DEFAULT_SLOW_SHARE, DEFAULT_CORRELATION_S])

    def misfit(logs: FloatArray) -> float:
        correlation_s = float(np.exp(np.clip(logs[1], np.log(0.01), np.log(MAX_CORRELATION_S))))
        noise = NoiseModel(white, white * float(np.exp(logs[0])), correlation_s, 0)
        # A weak prior, a factor of three either way, for stretches that show little.
        penalty = float(np.sum(((logs - start) / np.log(3.0)) ** 2))
        return sum(_restricted_likelihood(noise, layout, means) for layout, means in stacks) + penalty

    optimum = minimize(misfit, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01})
    ratio, correlation = np.exp(optimum.x)
    return white * float(ratio), float(np.clip(correlation, 0.01, MAX_CORRELATION_S))


@dataclass(frozen=True, eq=False)
class _AlikeRepeats:
    """Differences of repeats over the same blocks, whose noise has the same covariance."""

    repeats: Sequence[RepeatDifference]

    @classmethod
    def groups_of(cls, repeats: Iterable[RepeatDifference]) -> "tuple[_AlikeRepeats, ...]":
        """Put those of the same blocks together."""
        groups: dict[tuple[bytes, ...], list[RepeatDifference]] = {}
        for repeat in repeats:
            blocks = repeat.start_s, repeat.end_s, repeat.samples
            groups.setdefault(tuple(array.tobytes() for array in blocks), []).append(repeat)
        return tuple(cls(group) for group in groups.values())

    @cached_property
    def pairs(self) -> BlockPairs:
        """All pairs of the blocks."""
        return BlockPairs.all_of(self.repeats[0].start_s, self.repeats[0].end_s, self.repeats[0].samples)

    def likelihood(self, noise: NoiseModel) -> float:
        """−2 log restricted likelihood of the repeats' differences."""
        from scipy.linalg import cholesky

        covariance = np.zeros((self.pairs.samples.size,) * 2)
        covariance[self.pairs.late, self.pairs.early] = 2.0 * noise.covariances(self.pairs)
        root = cholesky(covariance, lower=True, check_finite=False)
        log_root = float(np.log(np.diag(root)).sum())
        whitened = (solve_lower(root, np.column_stack((each.signatures, each.difference))) for each in self.repeats)
        return sum(_beside_columns(columns.shape[1] - 1, columns, log_root) for columns in whitened)


@dataclass(frozen=True, eq=False)
class _SlowNoiseSearch:
    """Search for the slow noise that stretches and differences of repeats show."""

    noise: NoiseModel
    """As the rests show it without 1/f noise."""
    stacks: Sequence[tuple[_BlockLayout, FloatArray]]
    repeats: Sequence[_AlikeRepeats]

    @cached_property
    def step_s(self) -> float:
        """Time between samples."""
        return min(layout.width_s / layout.samples for layout, _ in self.stacks)

    @cached_property
    def start(self) -> FloatArray:
        """Logarithms of slow noise over white noise, its correlation time, and 1/f noise of a usual size; its power."""
        noise = self.noise
        return np.append(np.log([max(noise.slow / noise.white, 0.05), noise.correlation_s, 0.3]), 0.0)

    def noise_at(self, logs: FloatArray) -> NoiseModel:
        """Return the noise with these logarithms, and with the power of 1/f noise beyond 1; two are without it."""
        white = self.noise.white
        slow = white * float(np.exp(np.clip(logs[0], -6.0, 3.0)))
        flicker = white * float(np.exp(np.clip(logs[2], -6.0, 3.0))) if logs.size > 2 else 0.0
        power = 1.0 + float(np.clip(logs[3], -MAX_POWER_OFF, MAX_POWER_OFF)) if logs.size > 2 else 1.0
        correlation_s = float(np.exp(np.clip(logs[1], np.log(0.01), np.log(MAX_CORRELATION_S))))
        noise = replace(self.noise, hum=0.0, step_s=self.step_s, slow=slow, correlation_s=correlation_s)
        noise = replace(noise, flicker=flicker, flicker_power=power)
        # What neighbouring samples differ by is white noise, and the fast part of the others.
        fast = -float(noise.flicker_variances @ np.expm1(-self.step_s / np.array(noise.flicker_times_s)))
        fast -= slow**2 * float(np.expm1(-self.step_s / correlation_s))
        return replace(noise, white=float(np.sqrt(max(white**2 - fast, (MIN_WHITE_PART * white) ** 2))))

    @property
    def rivals(self) -> Iterator[NoiseModel]:
        """Yield the alternatives to 1/f noise: longer correlation, and the mains where sampling shows it as a drift."""
        yield self.optimum(self.start[:2] + np.array([0.2, 0.7]), np.array([-0.4, 0.6]), 80)
        turns = np.array(MAINS_HZ) * self.step_s
        if self.noise.hum == 0 and np.any(np.abs(turns - np.round(turns)) < MAX_SLOW_ALIAS_HZ * self.step_s):
            at_rest = self.noise_at(self.start[:2])
            yield from (replace(at_rest, hum=share * self.noise.white, hum_hz=0.0) for share in MAINS_AMPLITUDES)

    def at_rest(self, noise: NoiseModel) -> float:
        """−2 log likelihood of the stretches."""
        return _dense_likelihood(noise, self.stacks)

    def likelihood(self, noise: NoiseModel) -> float:
        """−2 log likelihood of the stretches and of the differences of repeats."""
        with_line = noise if noise.hum > 0 else replace(noise, hum=self.noise.hum)
        return self.at_rest(noise) + sum(alike.likelihood(with_line) for alike in self.repeats)

    def optimum(self, first: FloatArray, steps: FloatArray, evaluations: int) -> NoiseModel:
        """Return the likeliest noise, searched from some logarithms on."""
        from scipy.optimize import minimize

        def misfit(logs: FloatArray) -> float:
            # A weak prior for stretches that show little.
            prior = ((logs - self.start[: logs.size]) / PRIOR_SDS[: logs.size]) ** 2
            return self.likelihood(self.noise_at(logs)) + float(prior.sum())

        simplex = np.asarray(first + np.vstack((np.zeros(first.size), np.diag(steps))), dtype=np.float64)
        found = minimize(
            misfit,
            first,
            method="Nelder-Mead",
            options={"xatol": 0.05, "fatol": 0.1, "maxfev": evaluations, "initial_simplex": simplex},
        )
        return self.noise_at(found.x)


def _with_flicker(
    noise: NoiseModel, groups: dict[_BlockLayout, list[FloatArray]], repeats: Sequence[RepeatDifference]
) -> NoiseModel:
    """Return the noise with 1/f noise in it where stretches, and differences of repeats, are likelier with it."""
    stacks = [_coarser(layout, np.array(means)) for layout, means in groups.items()]
    search = _SlowNoiseSearch(noise, stacks, _AlikeRepeats.groups_of(repeats))
    at_rest = search.noise_at(search.start[:2])
    without = search.likelihood(at_rest)
    tried = [search.start + np.log((*factors, 1.0)) for factors in FIRST_FLICKER_FACTORS]
    likelihoods = [search.likelihood(search.noise_at(logs)) for logs in tried]
    if min(likelihoods) > without + (0.0 if repeats else MAX_FIRST_LOSS):
        return noise
    found = search.optimum(tried[int(np.argmin(likelihoods))], np.array([-0.4, 0.6, 0.6, 0.15]), 200)
    if repeats:
        # Noise without 1/f noise is ahead where both are as likely.
        found = min(
            (found, *search.rivals),
            key=lambda rival: search.likelihood(rival) - MIN_FLICKER_GAIN * (rival.flicker == 0),
        )
        # What repeats differ by may be what they do, as a specimen that ages; the rests know no such noise.
        if search.at_rest(found) - search.at_rest(at_rest) > MAX_POOLING_LOSS:
            return _with_flicker(noise, groups, ())
    if without - search.likelihood(found) < MIN_FLICKER_GAIN:
        return noise
    return found if found.hum > 0 else replace(found, hum=noise.hum)


def _coarser(layout: _BlockLayout, means: FloatArray) -> tuple[_BlockLayout, FloatArray]:
    """Join neighbouring blocks of stretches, shape `(R, blocks)`, so that there are not too many."""
    joined = -(-layout.blocks // MAX_FLICKER_BLOCKS)
    blocks = layout.blocks // joined
    coarse = means[:, : blocks * joined].reshape(len(means), blocks, joined).mean(axis=2)
    return _BlockLayout(blocks, joined * layout.width_s, joined * layout.samples, layout.degree), coarse


def solve_lower(root: FloatArray, values: FloatArray) -> FloatArray:
    """Solve a lower triangular system with a root of shape `(B, B)`, for values of shape `(B,)` or `(B, m)`."""
    from scipy.linalg.blas import dtrsm

    # The transposed system, for which BLAS needs no copy of values that are stored row by row.
    return np.asarray(dtrsm(1.0, root, np.atleast_2d(values.T), side=1, lower=1, trans_a=1).T).reshape(values.shape)


def _dense_likelihood(noise: NoiseModel, stacks: Sequence[tuple[_BlockLayout, FloatArray]]) -> float:
    """−2 log restricted likelihood of stretches of block means under any covariance."""
    from scipy.linalg import cholesky, toeplitz

    total = 0.0
    for layout, means in stacks:
        root = cholesky(toeplitz(noise.covariances(layout.pairs)), lower=True, check_finite=False)
        whitened = solve_lower(root, np.hstack((layout.polynomials, means.T)))
        total += _beside_columns(layout.degree + 1, whitened, float(np.log(np.diag(root)).sum()))
    return total


def _restricted_likelihood(noise: NoiseModel, layout: _BlockLayout, means: FloatArray) -> float:
    """−2 log restricted likelihood of stretches of block means, shape `(R, blocks)`.

    The innovation of a block, its mean less the prediction of the correlation from the block before, is correlated with
    its neighbours alone: the covariance of innovations is a band, with the same determinant.
    """
    from scipy.linalg import cholesky_banded
    from scipy.linalg.lapack import dtbtrs

    variance, next_covariance = noise.covariances(layout.pairs)[:2].tolist()
    memory = float(np.exp(-layout.width_s / noise.correlation_s))
    band = np.empty((2, layout.blocks))
    band[0] = variance * (1 + memory**2) - 2 * memory * next_covariance
    band[0, 0] = variance
    band[1] = next_covariance - memory * variance
    root = cholesky_banded(band, lower=True, check_finite=False)
    signals = np.hstack((layout.polynomials, means.T))
    signals[1:] -= memory * signals[:-1].copy()
    whitened, _ = dtbtrs(root, signals, uplo="L")
    return _beside_columns(layout.degree + 1, whitened, float(np.log(root[0]).sum()))


def _beside_columns(count: int, whitened: FloatArray, log_root: float) -> float:
    """−2 log restricted likelihood of block means, whitened columns of shape `(blocks, R)`, beside `count` before them.

    `log_root` is half the log determinant of the covariance of a column of block means.
    """
    basis, triangle = np.linalg.qr(whitened[:, :count])
    beside = whitened[:, count:] - basis @ (basis.T @ whitened[:, count:])
    logs = log_root + float(np.log(np.abs(np.diag(triangle))).sum())
    return float(np.sum(beside**2) + 2 * beside.shape[1] * logs)


BLOCK_GROWTH = 0.1
"""Width of a block relative to the time since the last event."""
MAX_BLOCK_S = 0.25
MAX_BLOCK_SHARE = 0.01
"""In records of minutes a block may be longer: this share of the time since the last event."""

MAX_BLOCKS = 800
"""Work grows with the cube of the number of blocks. A motion of so many bends that there would be more has coarser
blocks after bends at which the stage does not start, stop or turn."""
COARSENING_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)


@dataclass(frozen=True, slots=True, eq=False)
class BlockMeans:
    """Means of a channel over `B` blocks."""

    start_s: FloatArray
    end_s: FloatArray
    """`start_s`, `end_s`: start and end of each block, half a sample beyond its first and last valid sample."""
    samples: FloatArray
    """Valid samples of each block."""
    mean: FloatArray
    """Their mean."""
    nodes_s: FloatArray
    """Times at which a prediction is to be evaluated, two in each block, rising, shape `(2 B,)`. They have the mean and
    the standard deviation of the times that the block covers.
    """

    @property
    def middle_s(self) -> FloatArray:
        """Middle of each block."""
        return 0.5 * (self.start_s + self.end_s)

    def of(self, predicted: FloatArray) -> FloatArray:
        """Return block means of a prediction at `nodes_s`, shape `(…, 2 B)` to `(…, B)`."""
        return np.asarray(0.5 * (predicted[..., ::2] + predicted[..., 1::2]))


def average_in_blocks(
    experiment: Experiment, channel: str, events_s: FloatArray, *, jumps: bool, longest_mm: float = np.inf
) -> BlockMeans:
    """Average a channel over blocks of one sample after each event, which grow with the time since.

    Parameters
    ----------
    jumps
        Whether parameters move a jump of the prediction in time. Each sample then covers the time up to its
        neighbours, so that the mean follows such a parameter gradually. Otherwise it is an instant, which preserves
        the sharp peak of a relaxation.
    longest_mm
        Longest travel within a block, so that periodic functions of position show.
    """
    values = np.asarray(experiment.run.trace.channels[channel], dtype=np.float64)
    usable = np.flatnonzero(experiment.valid & np.isfinite(values))
    time, values = experiment.time_s[usable], values[usable]
    step = 1.0 / experiment.run.trace.sample_rate_hz
    edges = _block_edges(experiment, events_s, longest_mm, step) - 0.5 * step
    starts = np.unique(np.searchsorted(time, edges))
    starts = starts[starts < time.size]
    samples = np.diff(np.append(starts, time.size))
    first, last = time[starts], time[starts + samples - 1]
    covered = step if jumps else 0.0
    mean_s = np.add.reduceat(time, starts) / samples
    square = np.add.reduceat((time - np.repeat(mean_s, samples)) ** 2, starts) / samples
    scatter = np.sqrt(square + covered**2 / 12)
    early = np.maximum(mean_s - scatter, np.maximum(first - 0.5 * covered, 0.0))
    late = np.minimum(mean_s + scatter, last + 0.5 * covered)
    return BlockMeans(
        start_s=np.maximum(first - 0.5 * step, 0.0),
        end_s=np.minimum(last + 0.5 * step, float(experiment.time_s[-1])),
        samples=samples.astype(np.float64),
        mean=np.add.reduceat(values, starts) / samples,
        nodes_s=np.stack((early, late), axis=1).ravel(),
    )


def _block_edges(experiment: Experiment, events_s: FloatArray, longest_mm: float, step_s: float) -> FloatArray:
    """Edges of the blocks, coarser after mere bends of the motion if there would be too many."""
    end_s = float(experiment.time_s[-1])
    inside = events_s[(events_s > 0) & (events_s < end_s)]
    # The motion is known to a sample or so; a block must not reach across its event.
    starts = np.unique(np.concatenate(([0.0], np.maximum(inside - step_s, 0.0), [end_s])))
    longest_s = np.full(len(starts) - 1, np.inf)
    if np.isfinite(longest_mm):
        speed = np.abs(np.diff(experiment.position(starts))) / np.diff(starts)
        longest_s = longest_mm / np.maximum(speed, 1e-9)
    motion = experiment.motion
    turns = np.append(motion.breaks_s[1:-1][np.diff(motion.signs) != 0], starts[0])
    is_turn = np.abs(starts[:-1, None] - turns).min(axis=1) <= 1.5 * step_s
    edges = np.zeros(0)
    for factor in COARSENING_FACTORS:
        coarsening = np.where(is_turn, 1.0, factor)
        stretches = zip(starts[:-1].tolist(), starts[1:].tolist(), longest_s.tolist(), coarsening.tolist(), strict=True)
        edges = np.unique(np.concatenate([_graded_edges(*stretch, step_s) for stretch in stretches]))
        if len(edges) <= MAX_BLOCKS:
            break
    return edges


def _graded_edges(start_s: float, end_s: float, longest_s: float, coarsening: float, step_s: float) -> FloatArray:
    edges = [start_s]
    while edges[-1] < end_s:
        since = edges[-1] - start_s
        width = min(coarsening * max(BLOCK_GROWTH * since, step_s), max(MAX_BLOCK_S, MAX_BLOCK_SHARE * since))
        edges.append(edges[-1] + max(min(width, longest_s), step_s))
    return np.array(edges[:-1])
