"""Steady drag against speed: its logarithmic law, the speed at which it leaves the model, and R² by speed band.

For the boundary, the deviation of measurement from model is modelled as errors, the freedom that a specimen has, and
a steady trend in ln v; or besides a hinge, the trend changing at the boundary. Boundaries are searched along a grid.
A search finds something in any data, so that the improvement is judged by how often campaigns without a boundary, drawn
from the same errors, improve as much under the same search.

A change at a boundary may set in gradually, where a hinge bends at once. So the interval is never narrower than
the two speeds measured next to the boundary. On simulated specimens at 9 or 11 speeds a hinge of 6, 12 and 30 mN for
every factor e of speed is found in 55 to 80, 98 and 100 % of campaigns, and the interval covers it in 91 to 95, 95 to
99 and 97 to 100 % of these; of a hinge of 3 mN, found in 20 %, in 64 to 88 %. Contact lost gradually above 15 mm/s,
by 20 or 50 % of f_e in the end, is always found; the interval covers 15 mm/s in 77 to 83 and 96 to 99 %. Of campaigns
without a boundary, 4 to 6 % are reported to have one; fewer where the model was identified from the same runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis import EstimatedQuantity
from dragrig.analysis.identification.identification import LogLaw, SpeedBandR2, SpeedBoundary, SpeedPoint
from dragrig.analysis.paper import BOUNDARY_MM_S
from dragrig.rig import FloatArray

MIN_SPEEDS_FOR_LAW = 3
MIN_SPEEDS_FOR_R2 = 3
MIN_SPEEDS_FOR_BOUNDARY = 5
BOUNDARY_GRID_POINTS = 200
"""Boundaries tried, evenly spaced in ln v between the second speed and the last but one."""
NULL_SIMULATIONS = 2000
NULL_SEED = 2012
SIMULATION_NOTE = f"by {NULL_SIMULATIONS} simulated campaigns, seed {NULL_SEED}"
SIGNIFICANCE = 0.05
CHI2_95 = 3.8415
"""95 % quantile of χ² with one degree of freedom: the rise of χ² at the ends of a profile interval."""
SPEED_TOLERANCE = 0.01
"""A stage faster than its set speed by up to this share counts as at that speed."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceDeviation:
    """Measured minus expected force at `n` rising speeds."""

    speed_mm_s: FloatArray
    force_mN: FloatArray
    error_mN: FloatArray
    """`speed_mm_s`, `force_mN`, `error_mN`: speed, deviation, and its standard error, shape `(n,)`."""
    freedom_mN: FloatArray
    """Deviations that need no boundary, each one prior standard deviation large, shape `(K, n)`."""

    @classmethod
    def of(
        cls, points: Sequence[SpeedPoint], expected_mN: FloatArray | float = 0.0, freedom_mN: FloatArray | None = None
    ) -> "ForceDeviation":
        """Take the points of one direction, less their expectation."""
        return cls(
            np.array([abs(point.speed_mm_s) for point in points]),
            np.array([point.force.value for point in points], dtype=float) - expected_mN,
            np.array([point.force.standard_error for point in points], dtype=float),
            np.empty((0, len(points))) if freedom_mN is None else freedom_mN,
        )

    @property
    def covariance(self) -> FloatArray:
        """Of the deviations without any boundary or trend, shape `(n, n)`."""
        return np.asarray(np.diag(self.error_mN**2) + self.freedom_mN.T @ self.freedom_mN)

    @property
    def trend(self) -> FloatArray:
        """Level and slope in ln v, shape `(n, 2)`."""
        return np.column_stack((np.ones_like(self.speed_mm_s), np.log(self.speed_mm_s)))


def fit_log_law(points: Sequence[SpeedPoint]) -> LogLaw | None:
    """Fit intercept + slope · ln(v / 1 mm/s) by weighted least squares; None for fewer than three speeds.

    The intervals are those of the line through the points at these speeds, by the points' errors. Where
    `lack_of_fit_p` is small, no straight line describes them, and other speeds would give another line.
    """
    from scipy.special import chdtrc

    measured = ForceDeviation.of(points)
    force, error = measured.force_mN, measured.error_mN
    if len(points) < MIN_SPEEDS_FOR_LAW or not (error > 0).all():
        return None
    log_speed = np.log(measured.speed_mm_s)
    (slope, intercept), covariance = np.polyfit(log_speed, force, 1, w=1 / error, cov="unscaled")
    residual = (force - intercept - slope * log_speed) / error
    degrees, chi2 = len(points) - 2, float(residual @ residual)
    errors = np.sqrt(np.diag(covariance))
    weight = error**-2
    about_mean = force - float(weight @ force) / float(weight.sum())
    total = float(weight @ about_mean**2)
    return LogLaw(
        intercept=EstimatedQuantity.normal("intercept", "mN", float(intercept), float(errors[1])),
        slope=EstimatedQuantity.normal("slope", "mN", float(slope), float(errors[0])),
        correlation=float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])),
        r2=1 - chi2 / total if total else float("nan"),
        lack_of_fit_p=float(chdtrc(degrees, chi2)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _HingeSearch:
    """Hinges at the boundaries of a grid."""

    at_mm_s: FloatArray
    hinge: FloatArray
    """Their deviations, shape `(G, n)`."""
    direction: FloatArray
    """The same, whitened, freed of level and trend, and of length 1."""
    whiten: FloatArray
    project: FloatArray
    """`whiten`, `project`: whiten deviations, and remove level and trend from whitened ones, shape `(n, n)`."""

    @classmethod
    def of(cls, deviation: ForceDeviation) -> "_HingeSearch":
        speed = deviation.speed_mm_s
        at_mm_s = np.geomspace(speed[1], speed[-2], BOUNDARY_GRID_POINTS)
        hinge = np.maximum(np.log(speed / at_mm_s[:, None]), 0.0)
        whiten = np.linalg.inv(np.linalg.cholesky(deviation.covariance))
        basis, _ = np.linalg.qr(whiten @ deviation.trend)
        project = np.asarray(np.eye(len(speed)) - basis @ basis.T)
        direction = hinge @ whiten.T @ project
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return cls(at_mm_s, hinge, direction, whiten, project)

    def chi2_drops(self, whitened: FloatArray) -> FloatArray:
        """By how much each hinge lowers χ², shape `(…, G)`."""
        return np.asarray((whitened @ self.direction.T) ** 2)

    def misfit(self, chi2: FloatArray, drop: FloatArray) -> FloatArray:
        """χ² per degree of freedom that level, trend, hinge and its place leave; 1 where the errors explain them."""
        return np.asarray(np.maximum(1.0, (chi2 - drop) / (self.direction.shape[1] - 4)))

    def null_probability(self, improvement: float) -> float:
        """Share of simulated campaigns without a boundary that improve as much."""
        draws = np.random.default_rng(NULL_SEED).standard_normal((NULL_SIMULATIONS, len(self.project))) @ self.project
        drop = self.chi2_drops(draws).max(axis=1)
        improvements = drop / self.misfit((draws**2).sum(axis=1), drop)
        return float((1 + np.count_nonzero(improvements >= improvement)) / (1 + NULL_SIMULATIONS))


def find_boundary(deviation: ForceDeviation, subject: str = "measurement and model") -> SpeedBoundary:
    """Estimate the boundary and its interval by profile likelihood, and the probability of such a bend by errors alone.

    Where the hinge leaves more than the errors explain, improvements count relative to its residual.

    Parameters
    ----------
    subject
        The two that are compared, for the sentence.
    """
    speeds = len(deviation.speed_mm_s)
    if speeds < MIN_SPEEDS_FOR_BOUNDARY:
        few = f"{speeds} speed{'s' * (speeds != 1)}"
        return SpeedBoundary(
            None,
            None,
            None,
            f"With {few} a boundary cannot be estimated; at least {MIN_SPEEDS_FOR_BOUNDARY} are needed.",
        )
    search = _HingeSearch.of(deviation)
    whitened = search.project @ search.whiten @ deviation.force_mN
    drop = search.chi2_drops(whitened)
    best = int(drop.argmax())
    misfit = float(search.misfit(whitened @ whitened, drop[best]))
    probability = search.null_probability(float(drop[best]) / misfit)
    if probability >= SIGNIFICANCE:
        return SpeedBoundary(None, None, probability, _no_boundary_sentence(deviation, subject, probability))
    at_mm_s = float(search.at_mm_s[best])
    inside = search.at_mm_s[drop[best] - drop <= CHI2_95 * misfit]
    # Never narrower than the two measured speeds next to the boundary.
    slower = deviation.speed_mm_s[deviation.speed_mm_s <= at_mm_s]
    faster = deviation.speed_mm_s[deviation.speed_mm_s >= at_mm_s]
    interval = min(float(inside.min()), float(slower[-1])), max(float(inside.max()), float(faster[0]))
    sentence = _boundary_sentence(deviation, search, best, interval, probability, subject)
    return SpeedBoundary(at_mm_s, interval, probability, sentence)


def _no_boundary_sentence(deviation: ForceDeviation, subject: str, probability: float) -> str:
    from scipy.special import chdtrc

    chi2 = deviation.force_mN @ np.linalg.solve(deviation.covariance, deviation.force_mN)
    equal_p = float(chdtrc(len(deviation.force_mN), chi2))
    besides = ""
    if equal_p < SIGNIFICANCE:
        besides = f" Yet {subject} differ (p {_p_text(equal_p)}), with no speed at which that begins."
    return (
        f"No boundary is supported: the difference between {subject} bends no more than errors allow "
        f"(p {_p_text(probability)} {SIMULATION_NOTE}); a boundary is reported for about 5 in 100 campaigns that have "
        f"none.{besides}"
    )


def _boundary_sentence(
    deviation: ForceDeviation,
    search: _HingeSearch,
    best: int,
    interval: tuple[float, float],
    probability: float,
    subject: str,
) -> str:
    speed, (low, high) = deviation.speed_mm_s, interval
    design = np.column_stack((deviation.trend, search.hinge[best]))
    coefficients, *_ = np.linalg.lstsq(search.whiten @ design, search.whiten @ deviation.force_mN)
    slope_below, change = float(coefficients[1]), float(coefficients[2])
    above = abs(slope_below) <= abs(slope_below + change)
    far = float(speed[-1] if above else speed[0])
    size = change * abs(np.log(far / search.at_mm_s[best]))
    at_end = "" if speed[1] < low and high < speed[-2] else ", limited by the range of speeds"
    return (
        f"{subject[:1].upper()}{subject[1:]} differ {'above' if above else 'below'} {search.at_mm_s[best]:.3g} mm/s "
        f"(95 %: {low:.3g} to {high:.3g} mm/s{at_end}; p {_p_text(probability)} {SIMULATION_NOTE}): at {far:.3g} mm/s "
        f"the force is {abs(size):.2g} mN {'higher' if size > 0 else 'lower'} than expected from the other speeds."
    )


def _p_text(probability: float) -> str:
    min_p = 2 / NULL_SIMULATIONS
    return f"< {min_p:g}" if probability < min_p else f"= {probability:.2g}"


def r2_eq15(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the paper's Eq. 15, Σ(f₁ − f̄₁)² / Σ(f₂ − f̄₁)²; None where the measured forces all equal f̄₁.

    f₁ is the model, f₂ the measurement, and f̄₁ the model's mean in both sums: no share of anything, and above 1
    where the model varies more than the measurement.
    """
    mean = float(model.mean())
    about_mean = float(((measured - mean) ** 2).sum())
    return float(((model - mean) ** 2).sum()) / about_mean if about_mean else None


def squared_correlation(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the square of the correlation, as which the paper introduces Eq. 15; None where either is constant."""
    if np.ptp(model) == 0 or np.ptp(measured) == 0:
        return None
    return float(np.corrcoef(model, measured)[0, 1] ** 2)


def r2_by_band(
    points: Sequence[SpeedPoint], boundary: SpeedBoundary | None, prefix: str = ""
) -> tuple[SpeedBandR2, ...]:
    """Compare model and measurement over all speeds, and below and above the paper's and the estimated boundary."""
    bands = {"all speeds": list(points)}
    limits = {"": BOUNDARY_MM_S}
    if boundary is not None and boundary.speed_mm_s is not None:
        limits[" (estimated boundary)"] = boundary.speed_mm_s
    for note, limit in limits.items():
        highest = limit * (1 + SPEED_TOLERANCE)
        bands[f"up to {limit:.3g} mm/s{note}"] = [point for point in points if abs(point.speed_mm_s) <= highest]
        bands[f"above {limit:.3g} mm/s{note}"] = [point for point in points if abs(point.speed_mm_s) > highest]
    results = []
    for name, band in bands.items():
        r2 = correlation = None
        if len(band) >= MIN_SPEEDS_FOR_R2:
            model, measured = np.array([point.model_mN for point in band]), ForceDeviation.of(band).force_mN
            r2, correlation = r2_eq15(model, measured), squared_correlation(model, measured)
        results.append(SpeedBandR2(prefix + name, len(band), r2, correlation))
    return tuple(results)
