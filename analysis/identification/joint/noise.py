"""What the sensor's noise is like, from where the stage rests: white, and slow with exponential correlation."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import at_rest, in_phase
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

BLOCK_S = 0.05
"""Rests are averaged in blocks of this length; faster noise is told by the differences of samples."""
FEWEST_BLOCKS = 8
LONGEST_S = 10.0
"""So much of a rest is looked at."""
USUAL_CORRELATION_S = 0.2
LONGEST_CORRELATION_S = 5.0
SLOW_SHARE = 1.0 / 3.0
"""Slow noise over white noise where no rest is long enough to tell."""
ASSUMED_WHITE = 1.5


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
    """

    white: float
    slow: float
    correlation_s: float
    degrees: int

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
        return np.asarray(covariance)


def estimate_noise(experiments: Iterable[Experiment], channel: str) -> Noise:
    """Estimate a channel's noise from all stretches at which it should stay the same.

    These are the rests before the motion, and the holds of capsules that nothing squeezes. Restricted maximum
    likelihood of block means, each stretch with a mean of its own; where rests are too short for slow noise, a third
    of the white noise with 0.2 s correlation is assumed.
    """
    squares, count = 0.0, 0
    groups: dict[tuple[int, float, int], list[FloatArray]] = {}
    for values, rate in _quiet(experiments, channel):
        squares += float(np.sum(np.diff(values) ** 2)) / 2
        count += len(values) - 1
        size = max(1, round(BLOCK_S * rate))
        blocks = min(len(values) // size, round(LONGEST_S / BLOCK_S))
        if blocks >= FEWEST_BLOCKS:
            groups.setdefault((blocks, size / rate, size), []).append(
                values[: blocks * size].reshape(blocks, size).mean(axis=1)
            )
    if not count:
        return Noise(ASSUMED_WHITE, SLOW_SHARE * ASSUMED_WHITE, USUAL_CORRELATION_S, 0)
    white = max(float(np.sqrt(squares / count)), 1e-9)
    slow, correlation_s = _slow(groups, white) if groups else (SLOW_SHARE * white, USUAL_CORRELATION_S)
    # Differences of neighbours hold three independent numbers in four.
    return Noise(white, slow, correlation_s, count * 2 // 3)


def _quiet(experiments: Iterable[Experiment], channel: str) -> Iterator[tuple[FloatArray, float]]:
    for experiment in experiments:
        trace = experiment.run.trace
        if channel not in trace.channels:
            continue
        quiet = at_rest(trace)
        if experiment.contact is Contact.NONE:
            quiet = quiet | in_phase(trace, Phase.HOLD)
        values = np.asarray(trace.channels[channel], dtype=np.float64)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], quiet & experiment.valid, [False])).astype(np.int8)))
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if stop - start > 2:
                yield values[start:stop], trace.sample_rate_hz


def _slow(groups: dict[tuple[int, float, int], list[FloatArray]], white: float) -> tuple[float, float]:
    from scipy.optimize import minimize

    stacks = [(key, np.array(values)) for key, values in groups.items()]

    def misfit(logs: FloatArray) -> float:
        correlation_s = float(np.exp(np.clip(logs[1], np.log(0.01), np.log(LONGEST_CORRELATION_S))))
        noise = Noise(white, white * float(np.exp(logs[0])), correlation_s, 0)
        return sum(_restricted(noise, *key, values) for key, values in stacks) + _unlikely(logs)

    found = minimize(
        misfit, np.log([SLOW_SHARE, USUAL_CORRELATION_S]), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01}
    )
    ratio, correlation = np.exp(found.x)
    return white * float(ratio), float(np.clip(correlation, 0.01, LONGEST_CORRELATION_S))


def _unlikely(logs: FloatArray) -> float:
    """Return a weak prior around the usual noise, a factor of three either way, for rests that say little."""
    return float(np.sum(((logs - np.log([SLOW_SHARE, USUAL_CORRELATION_S])) / np.log(3.0)) ** 2))


def _restricted(noise: Noise, blocks: int, width_s: float, size: int, values: FloatArray) -> float:
    """Return −2 log restricted likelihood of stretches of block means, shape `(R, blocks)`."""
    from scipy.linalg import cho_factor, cho_solve

    start = np.arange(blocks, dtype=np.float64) * width_s
    factor = cho_factor(noise.covariance(start, start + width_s, np.full(blocks, float(size))), lower=True)
    ones = cho_solve(factor, np.ones(blocks))
    weight = float(ones.sum())
    mean = values @ ones / weight
    centred = values - mean[:, None]
    misfit = float(np.sum(centred * cho_solve(factor, centred.T).T))
    return misfit + len(values) * (2 * float(np.log(np.diag(factor[0])).sum()) + float(np.log(weight)))
