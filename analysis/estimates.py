"""Estimates: a value with its uncertainty, or the reason why there is none; the mean of correlated samples.

The mean's noise is taken to be white noise plus first-order autoregressive noise of unknown amplitude and
correlation time. The cosine transform of the samples makes their covariance nearly diagonal, so that
the likelihood of (correlation time, ratio of the variances) is a product over frequencies (Whittle,
Ark. Mat. 2, 1953); the overall variance is integrated out. The mean's error is averaged over all pairs
by their likelihood on a grid that is refined around the likely ones, so that an unknown correlation time widens
the interval, where a plug-in estimate would be too narrow.

Measured on simulated noise (white 1.5, slow 0.5 with 0.2 s correlation, 500 Hz, correlation times up to 2 s
allowed), the 95 % interval covers the true mean in 97 % of records of 2 s, 95 % of 8 s and 94 %
of 40 s. A record of fewer than five correlation times is too short: at 0.5 s the coverage is 92 %.
Without any slow noise the interval is about 1.7 times too wide: slow noise cannot be ruled out.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from math import exp
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.analysis.wording import value_with_error
from dragrig.rig import FloatArray

NORMAL_95 = 1.959964
"""Standard errors on either side that hold 95 % of a normal distribution."""

Progress: TypeAlias = Callable[[int, int], None]
"""Called with the numbers of pieces of work that are done, and in all."""


def no_progress(_done: int, _of: int) -> None:
    """Report nothing."""


def counted(progress: Progress, of: int) -> Callable[[int], None]:
    """Return a function that is told how much more of so much work is done, and reports the sum."""
    done = 0

    def advance(more: int) -> None:
        nonlocal done
        done += more
        progress(done, of)

    return advance


def parts_of(progress: Progress, *costs: float) -> tuple[Progress, ...]:
    """Return the progress of each part of the work, in order, where the parts take times in proportion to the costs."""

    def part(begin: float, cost: float) -> Progress:
        def report(done: int, of: int) -> None:
            progress(round(1000 * (begin + cost * done / max(of, 1)) / sum(costs)), 1000)

        return report

    return tuple(part(sum(costs[:place]), cost) for place, cost in enumerate(costs))


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measured value."""

    value: float | None = None
    """In the unit of the estimate's name; None where the data do not support any."""
    standard_error: float | None = None
    """In the same unit; None likewise."""
    effective_samples: float | None = None
    """Number of independent samples with the same standard error."""
    reason: str = ""
    """Why value or standard error is None; empty when neither is."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Interval that holds the true value with 95 % confidence."""
        if self.value is None or self.standard_error is None:
            return None
        half = NORMAL_95 * self.standard_error
        return self.value - half, self.value + half

    def scaled(self, factor: float) -> "Estimate":
        """Multiply by an exact factor."""
        if self.value is None:
            return self
        error = None if self.standard_error is None else abs(factor) * self.standard_error
        return replace(self, value=factor * self.value, standard_error=error)

    def __str__(self) -> str:
        if self.value is None:
            return f"- ({self.reason})"
        return value_with_error(self.value, self.standard_error)


def missing(reason: str) -> Estimate:
    """Return a missing estimate with the reason."""
    return Estimate(reason=reason)


MAX_REASONS = 3
"""So many reasons are told where no run is left."""


@dataclass(frozen=True, slots=True)
class EstimatedQuantity:
    """An identified number; `interval` holds the true one with 95 % confidence."""

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]

    @classmethod
    def normal(cls, name: str, unit: str, value: float, error: float) -> "EstimatedQuantity":
        """Take a normally distributed value."""
        return cls(name, unit, value, error, (value - NORMAL_95 * error, value + NORMAL_95 * error))

    @classmethod
    def lognormal(cls, name: str, unit: str, log_value: float, log_error: float) -> "EstimatedQuantity":
        """Take a value whose logarithm is normally distributed."""
        value, factor = exp(log_value), exp(NORMAL_95 * log_error)
        return cls(name, unit, value, value * log_error, (value / factor, value * factor))

    @property
    def half_width(self) -> float:
        """Half of the interval, relative to the value."""
        low, high = self.interval
        return 0.5 * (high - low) / abs(self.value) if self.value else float("inf")


@dataclass(frozen=True, slots=True)
class Exclusion:
    """A run, or a part of the result, that is not used, and why."""

    item: str
    reason: str


def summarise_exclusions(left_out: Iterable[Exclusion]) -> str:
    """Name each reason once, with its first run and the number of further ones."""
    reasons: dict[str, list[str]] = {}
    for exclusion in left_out:
        reasons.setdefault(exclusion.reason, []).append(exclusion.item)
    clauses = [
        f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}: {reason}"
        for reason, files in reasons.items()
    ]
    return "; ".join(clauses if len(clauses) <= MAX_REASONS else [*clauses[:MAX_REASONS], "and other reasons"])


MAX_VALUE = 1e100
"""The square of a larger value, summed over a record, may exceed what a number holds."""
MIN_SAMPLES_FOR_MEAN = 8
MAX_SPECTRUM_SAMPLES = 100_000
"""Longer records are averaged in groups first: only slow noise matters to the mean."""
_HALF_WIDTH_TOLERANCE = 1e-9
GRID_POINTS = 24
GRID_REFINEMENTS = 3
LOG_LIKELIHOOD_RANGE = 10.0
"""Pairs with a log-likelihood this far below the best are outside the refined grid."""
MIN_CORRELATION_SAMPLES = 1.0
MIN_VARIANCE_RATIO, MAX_VARIANCE_RATIO = 1e-3, 1e4


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Power of `samples` samples in bins: number of frequencies, total power, mean angular frequency."""

    samples: int
    count: FloatArray
    power: FloatArray
    frequency: FloatArray


def correlated_mean(values: npt.ArrayLike, longest_correlation: float = 0.0) -> Estimate:
    """Mean of a stationary record.

    Parameters
    ----------
    values
        Consecutive samples, shape `(n,)`.
    longest_correlation
        Largest correlation time of slow noise that is allowed for, in samples, at least the length of the record.

    Returns
    -------
    Estimate
        `standard_error` is that of the normal distribution with the same 95 % interval.
    """
    record = np.asarray(values, dtype=np.float64)
    if len(record) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"only {len(record)} samples, fewer than {MIN_SAMPLES_FOR_MEAN}")
    if not np.isfinite(record).all():
        return missing("samples are missing (NaN)")
    if float(np.abs(record).max()) > MAX_VALUE:
        return missing(f"a sample is {np.abs(record).max():.1g}, which nothing measures")
    mean = float(record.mean())
    group = max(1, 2 * len(record) // MAX_SPECTRUM_SAMPLES)
    deviations = record[: len(record) // group * group].reshape(-1, group).mean(axis=1) - mean
    rounding = np.finfo(np.float64).eps * max(abs(mean), float(np.abs(record).max()))
    if float(np.abs(deviations).max()) <= 4 * rounding:
        return Estimate(mean, 0.0, float(len(record)))
    weights, errors = _mixture(_spectrum(deviations), max(longest_correlation / group, float(len(deviations))))
    error = _half_width(weights, errors) / NORMAL_95
    return Estimate(mean, error, float(min(len(record), record.var() / error**2)))


def _spectrum(deviations: FloatArray) -> _Spectrum:
    samples = len(deviations)
    # The power of the discrete cosine transform: that of the record followed by its mirror image.
    mirrored = np.fft.rfft(np.concatenate((deviations, deviations[::-1])))[1:samples]
    power = (mirrored.real**2 + mirrored.imag**2) / (2 * samples)
    edges = np.unique(np.concatenate((np.arange(1, 25), np.geomspace(24, samples, 60).astype(int))))
    starts = edges[edges < samples] - 1
    count = np.diff(np.append(starts, samples - 1)).astype(float)
    mean_index = np.add.reduceat(np.arange(1.0, samples), starts) / count
    return _Spectrum(samples, count, np.add.reduceat(power, starts), np.pi * mean_index / samples)


def _mixture(spectrum: _Spectrum, longest: float) -> tuple[FloatArray, FloatArray]:
    """Weights and standard errors of the mean over the grid of correlation times and variance ratios."""
    times = np.linspace(np.log(MIN_CORRELATION_SAMPLES), np.log(longest), GRID_POINTS)
    ratios = np.linspace(np.log(MIN_VARIANCE_RATIO), np.log(MAX_VARIANCE_RATIO), GRID_POINTS)
    likelihood, errors = _likelihood_grid(spectrum, times, ratios)
    for _ in range(GRID_REFINEMENTS - 1):
        likely = likelihood > likelihood.max() - LOG_LIKELIHOOD_RANGE
        times, ratios = _refine_axis(times, likely.any(axis=1)), _refine_axis(ratios, likely.any(axis=0))
        likelihood, errors = _likelihood_grid(spectrum, times, ratios)
    weights = np.exp(likelihood - likelihood.max())
    return (weights / weights.sum()).ravel(), errors.ravel()


def _refine_axis(axis: FloatArray, likely: npt.NDArray[np.bool_]) -> FloatArray:
    inside = np.flatnonzero(likely)
    low, high = axis[max(inside[0] - 1, 0)], axis[min(inside[-1] + 1, len(axis) - 1)]
    return np.linspace(low, high, GRID_POINTS)


def _likelihood_grid(
    spectrum: _Spectrum, log_times: FloatArray, log_ratios: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood and standard error of the mean, both of shape `(times, ratios)`."""
    n = spectrum.samples
    slow = np.exp(log_ratios) / (1 + np.exp(log_ratios))
    phi = np.exp(-np.exp(-log_times))[:, None]
    lorentz = (1 - phi**2) / (1 - 2 * phi * np.cos(spectrum.frequency) + phi**2)
    density = (1 - slow)[:, None] + slow[:, None] * lorentz[:, None, :]
    power = (spectrum.power / density).sum(axis=-1)
    likelihood = -0.5 * (spectrum.count * np.log(density)).sum(axis=-1) - 0.5 * (n - 1) * np.log(power)
    mean_of_slow = (1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2)
    variance = ((1 - slow) + slow * mean_of_slow) / n * power / (n - 1)
    return likelihood, np.sqrt(variance)


def _half_width(weights: FloatArray, errors: FloatArray) -> float:
    """Half the width of the mixture's 95 % interval.

    Newton's method from the narrowest component's interval: the content of an interval is a concave function of its
    width, so that every step ends short of the solution and none can overshoot.
    """
    from scipy.special import erf

    half = NORMAL_95 * float(errors.min())
    while True:
        scaled = half / errors
        lacking = 0.95 - float((weights * erf(scaled / np.sqrt(2))).sum())
        step = lacking / float((weights * np.exp(-0.5 * scaled**2) / errors).sum() * np.sqrt(2 / np.pi))
        half += step
        if step <= _HALF_WIDTH_TOLERANCE * half:
            return half
