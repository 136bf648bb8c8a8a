"""What a channel's noise is like, from where the force stands still: white, and slow with exponential correlation.

Stretches that stand still are the rests before a motion, the holds of capsules that nothing squeezes, and the ends of
relaxations' holds, from which a cubic is taken.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import Mask, at_rest, in_phase
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

BLOCK_S = 0.05
"""Stretches are averaged in blocks of this length; faster noise is told by the differences of samples."""
FEWEST_BLOCKS = 8
FEWEST_DIFFERENCES = 12
"""Fewer in all say nothing of the noise."""
LONGEST_S = 60.0
"""So much of a stretch is looked at."""
RELAXING = 3
"""Power of time up to which the end of a relaxation is taken off."""
FEWEST_MOVING = 100
"""Samples of steady motion that say what white noise is like where nothing rests."""
GAUSSIAN = 0.6745
"""Median over standard deviation of a normal distribution's magnitudes."""
RESOLUTION = 1e-5
"""Least white noise over the largest value of the channel, a step or so of a converter of 16 bit."""
USUAL_CORRELATION_S = 0.2
LONGEST_CORRELATION_S = 5.0
SLOW_SHARE = 1.0 / 3.0
"""Slow noise over white noise where no stretch is long enough to tell."""
USUAL_WHITE = 2.0
"""White noise where no run shows any [mN], at the upper end of what such sensors have."""
IN_STEP_S = 1.0
"""So long a line is taken to keep the frequency that is known of it."""
FITTED_S = 0.5
"""A line that is taken out of a stretch has an amplitude and a phase of its own in pieces of this length."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a channel, in its unit.

    Attributes
    ----------
    white
        Standard deviation of one sample's white noise.
    slow, correlation_s
        Standard deviation and correlation time of the slow noise.
    degrees
        Independent numbers that it was estimated from; 0 where it was assumed.
    hum, hum_hz
        Amplitude and frequency of a line that is known beforehand, 0 for none; its phase is not known.
    """

    white: float
    slow: float
    correlation_s: float
    degrees: int
    hum: float = 0.0
    hum_hz: float = 0.0

    def covariance(self, start_s: FloatArray, end_s: FloatArray, samples: FloatArray) -> FloatArray:
        """Return the covariance of means over successive stretches of time, shapes `(B,)` to `(B, B)`."""
        tau = self.correlation_s
        width = np.maximum(end_s - start_s, 1e-9)
        share = -np.expm1(-width / tau) * tau / width
        apart = np.maximum(start_s[None, :] - end_s[:, None], 0.0)
        slow = np.exp(-(apart + apart.T) / tau) * share[:, None] * share[None, :]
        np.fill_diagonal(slow, 2 * (tau / width) * (1 - share))
        covariance = self.slow**2 * slow
        covariance[np.diag_indices_from(covariance)] += self.white**2 / samples
        if self.hum > 0:
            covariance += self._hum(0.5 * (start_s + end_s), end_s - start_s)
        return np.asarray(covariance)

    def _hum(self, middle_s: FloatArray, width_s: FloatArray) -> FloatArray:
        apart = np.abs(middle_s[:, None] - middle_s[None, :])
        kept = np.sinc(self.hum_hz * width_s)
        wave = np.cos(2 * np.pi * self.hum_hz * apart) * np.exp(-apart / IN_STEP_S)
        return np.asarray(0.5 * self.hum**2 * wave * kept[:, None] * kept[None, :])


USUAL = Noise(USUAL_WHITE, SLOW_SHARE * USUAL_WHITE, USUAL_CORRELATION_S, 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """Samples that differ by noise, and by a polynomial of time of this degree."""

    values: FloatArray
    rate_hz: float
    degree: int


@dataclass(frozen=True, slots=True)
class _Layout:
    """What stretches of block means have in common: number, width and samples of the blocks, and the degree."""

    blocks: int
    width_s: float
    samples: int
    degree: int


def estimate_noise(experiments: Iterable[Experiment], channel: str, hum: float = 0.0, hum_hz: float = 0.0) -> Noise:
    """Estimate a channel's noise from all stretches at which it should stay the same, or merely relaxes.

    Restricted maximum likelihood of block means, each stretch with a polynomial of its own; where stretches are too
    short for slow noise, a third of the white noise with 0.2 s correlation is assumed. Where there are none, white
    noise is what neighbouring samples of steady motion differ by beyond a straight line, and `USUAL` where there is no
    steady motion either; both count as assumed.

    Parameters
    ----------
    hum, hum_hz
        Amplitude and frequency of a line that is known to be there: it is kept apart. 0 for none.
    """
    runs = tuple(experiments)
    if hum > 0:
        stretches = [_without_line(one, hum_hz) for one in _quiet(runs, channel)]
        return replace(_estimated(stretches, runs, channel), hum=hum, hum_hz=hum_hz)
    return _estimated(_quiet(runs, channel), runs, channel)


def _estimated(stretches: Iterable[_Stretch], runs: Sequence[Experiment], channel: str) -> Noise:
    squares, count, largest = 0.0, 0, 0.0
    groups: dict[_Layout, list[FloatArray]] = {}
    for stretch in stretches:
        squares += float(np.sum(np.diff(stretch.values) ** 2)) / 2
        count += len(stretch.values) - 1
        largest = max(largest, float(np.abs(stretch.values).max()))
        layout, means = _in_blocks(stretch)
        if layout.blocks >= FEWEST_BLOCKS:
            groups.setdefault(layout, []).append(means)
    if count < FEWEST_DIFFERENCES:
        return _in_motion(runs, channel)
    white = max(float(np.sqrt(squares / count)), RESOLUTION * largest, 1e-9)
    slow, correlation_s = _slow(groups, white) if groups else (SLOW_SHARE * white, USUAL_CORRELATION_S)
    # Differences of neighbours hold two independent numbers in three.
    return Noise(white, slow, correlation_s, count * 2 // 3)


def _in_motion(experiments: Sequence[Experiment], channel: str) -> Noise:
    """Return the noise that steady motion shows from sample to sample; what is slower cannot be told from a signal."""
    bends, largest = [np.zeros(0)], 0.0
    for experiment in experiments:
        trace = experiment.run.trace
        if channel not in trace.channels:
            continue
        values = np.asarray(trace.channels[channel], dtype=np.float64)
        for start, stop in _stretches(in_phase(trace, Phase.STEADY) & experiment.valid & np.isfinite(values)):
            bends.append(np.abs(np.diff(values[start:stop], 2)) / np.sqrt(6.0))
            largest = max(largest, float(np.abs(values[start:stop]).max()))
    whole = np.concatenate(bends)
    if whole.size < FEWEST_MOVING:
        return USUAL
    white = max(float(np.median(whole)) / GAUSSIAN, RESOLUTION * largest, 1e-9)
    return Noise(white, SLOW_SHARE * white, USUAL_CORRELATION_S, 0)


def _quiet(experiments: Iterable[Experiment], channel: str) -> Iterator[_Stretch]:
    for experiment in experiments:
        trace = experiment.run.trace
        if channel not in trace.channels:
            continue
        values = np.asarray(trace.channels[channel], dtype=np.float64)
        usable = experiment.valid & np.isfinite(values)
        still, relaxing = at_rest(trace), np.zeros_like(usable)
        if experiment.contact is Contact.NONE:
            still = still | in_phase(trace, Phase.HOLD)
        elif experiment.contact is Contact.STICKING:
            hold = np.flatnonzero(in_phase(trace, Phase.HOLD))
            relaxing[hold[hold.size - min(hold.size // 2, int(LONGEST_S * trace.sample_rate_hz)) :]] = True
        for part, degree in ((still, 0), (relaxing, RELAXING)):
            for start, stop in _stretches(part & usable):
                if stop - start > 2:
                    yield _Stretch(values[start:stop], trace.sample_rate_hz, degree)


def _without_line(stretch: _Stretch, hertz: float) -> _Stretch:
    """Take a line out of a stretch, piece by piece, beside a straight line in each."""
    size = max(round(FITTED_S * stretch.rate_hz), FEWEST_DIFFERENCES)
    pieces = np.array_split(stretch.values, max(stretch.values.size // size, 1))
    return replace(stretch, values=np.concatenate([one - _line(one, hertz / stretch.rate_hz) for one in pieces]))


def _line(values: FloatArray, turns: float) -> FloatArray:
    """Return the sine of so many turns per sample that fits best beside a straight line, shape `(n,)`."""
    sample = np.arange(values.size, dtype=np.float64)
    angle = 2 * np.pi * turns * sample
    columns = np.column_stack((np.cos(angle), np.sin(angle), np.ones_like(sample), sample))
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    return np.asarray(columns[:, :2] @ found[:2])


def _stretches(mask: Mask) -> list[tuple[int, int]]:
    """Return where each stretch of a mask begins and stops."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _in_blocks(stretch: _Stretch) -> tuple[_Layout, FloatArray]:
    size = max(1, round(BLOCK_S * stretch.rate_hz))
    blocks = min(len(stretch.values) // size, round(LONGEST_S * stretch.rate_hz / size))
    means = stretch.values[: blocks * size].reshape(blocks, size).mean(axis=1)
    return _Layout(blocks, size / stretch.rate_hz, size, stretch.degree), means


def _slow(groups: dict[_Layout, list[FloatArray]], white: float) -> tuple[float, float]:
    from scipy.optimize import minimize

    stacks = [(layout, np.array(means)) for layout, means in groups.items()]

    def misfit(logs: FloatArray) -> float:
        correlation_s = float(np.exp(np.clip(logs[1], np.log(0.01), np.log(LONGEST_CORRELATION_S))))
        noise = Noise(white, white * float(np.exp(logs[0])), correlation_s, 0)
        return sum(_restricted(noise, layout, means) for layout, means in stacks) + _unlikely(logs)

    found = minimize(
        misfit, np.log([SLOW_SHARE, USUAL_CORRELATION_S]), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01}
    )
    ratio, correlation = np.exp(found.x)
    return white * float(ratio), float(np.clip(correlation, 0.01, LONGEST_CORRELATION_S))


def _unlikely(logs: FloatArray) -> float:
    """Return a weak prior around the usual noise, a factor of three either way, for stretches that say little."""
    return float(np.sum(((logs - np.log([SLOW_SHARE, USUAL_CORRELATION_S])) / np.log(3.0)) ** 2))


def _restricted(noise: Noise, layout: _Layout, means: FloatArray) -> float:
    """Return −2 log restricted likelihood of stretches of block means, shape `(R, blocks)`.

    What a block adds to the one before, which the correlation makes it remember, is correlated with its neighbours
    alone: in these innovations the covariance is a band, and its determinant stays the same.
    """
    from scipy.linalg import cholesky_banded, solve_banded

    start = np.array([0.0, layout.width_s])
    two = noise.covariance(start, start + layout.width_s, np.full(2, float(layout.samples)))
    memory = float(np.exp(-layout.width_s / noise.correlation_s))
    band = np.empty((2, layout.blocks))
    band[0] = two[0, 0] * (1 + memory**2) - 2 * memory * two[0, 1]
    band[0, 0] = two[0, 0]
    band[1] = two[0, 1] - memory * two[0, 0]
    root = cholesky_banded(band, lower=True, check_finite=False)
    powers = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, layout.blocks), layout.degree)
    signals = np.hstack((powers, means.T))
    signals[1:] -= memory * signals[:-1].copy()
    whitened = solve_banded((1, 0), root, signals, check_finite=False)
    basis, triangle = np.linalg.qr(whitened[:, : layout.degree + 1])
    left = whitened[:, layout.degree + 1 :]
    misfit = float(np.sum(left**2) - np.sum((basis.T @ left) ** 2))
    logs = np.log(root[0]).sum() + np.log(np.abs(np.diag(triangle))).sum()
    return misfit + 2 * len(means) * float(logs)
