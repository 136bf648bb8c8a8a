"""Steady drag against speed: its logarithmic law, the speed at which it leaves the model, and R² by speed band.

For the boundary, the deviation of measurement from model is modelled as errors, the freedom that a specimen has, and
a steady trend in ln v; or besides a hinge, the trend changing at the boundary. Boundaries are searched along a grid.
A search finds something in any data, so that the improvement is judged by how often campaigns without a boundary, drawn
from the same errors, improve as much under the same search.

What sets in at a boundary may set in gradually, where a hinge bends at once. So the interval is never narrower than
the two speeds measured next to the boundary. On simulated specimens at 9 or 11 speeds a hinge of 6, 12 and 30 mN for
every factor e of speed is found in 55 to 80, 98 and 100 % of campaigns, and the interval covers it in 91 to 95, 95 to
99 and 97 to 100 % of these; of a hinge of 3 mN, found in 20 %, in 64 to 88 %. Contact lost gradually above 15 mm/s,
by 20 or 50 % of f_e in the end, is always found; the interval covers 15 mm/s in 77 to 83 and 96 to 99 %. Of campaigns
without a boundary, 4 to 6 % are reported to have one; fewer where the model was identified from the same runs.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.estimates import NORMAL_95, EstimatedQuantity
from dragrig.analysis.identification.identification import LogLaw, SpeedBandR2, SpeedBoundary, SpeedPoint
from dragrig.rig.arrays import FloatArray

MIN_SPEEDS_FOR_LAW = 3


def fit_log_law(points: Sequence[SpeedPoint]) -> LogLaw | None:
    """Fit intercept + slope · ln(v / 1 mm/s) by weighted least squares; None for fewer than three speeds.

    The intervals are those of the line through the points at these speeds, by the points' errors. Where
    `lack_of_fit_p` is small, no straight line describes them, and other speeds would give another one.
    """
    from scipy.special import chdtrc

    if len(points) < MIN_SPEEDS_FOR_LAW:
        return None
    force = np.array([point.force.value for point in points], dtype=float)
    error = np.array([point.force.standard_error for point in points], dtype=float)
    if not (error > 0).all():
        return None
    design = np.column_stack((np.ones(len(points)), np.log([abs(point.speed_mm_s) for point in points])))
    weighted = design / error[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    found = covariance @ weighted.T @ (force / error)
    stray = (force - design @ found) / error
    degrees, squares = len(points) - 2, float(stray @ stray)
    errors = np.sqrt(np.diag(covariance))
    weight = error**-2
    about_mean = force - float(weight @ force) / float(weight.sum())
    spread = float(weight @ about_mean**2)
    intercept, slope = (
        EstimatedQuantity(
            name, "mN", float(value), float(one), (float(value - NORMAL_95 * one), float(value + NORMAL_95 * one))
        )
        for name, value, one in zip(("intercept", "slope"), found, errors, strict=True)
    )
    return LogLaw(
        intercept=intercept,
        slope=slope,
        correlation=float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])),
        r2=1 - squares / spread if spread else float("nan"),
        lack_of_fit_p=float(chdtrc(degrees, squares)),
    )


MIN_SPEEDS_FOR_BOUNDARY = 5
BOUNDARY_GRID_POINTS = 200
"""Boundaries tried, evenly spaced in ln v between the second speed and the last but one."""
NULL_SIMULATIONS = 2000
NULL_SEED = 2012
SIGNIFICANCE = 0.05
CHI2_95 = 3.8415
"""How much worse the squares may be for a boundary inside the 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceDeviation:
    """Measured minus expected force at `n` rising speeds.

    Attributes
    ----------
    speed_mm_s, force_mN, error_mN
        Speed, deviation, and its standard error, shape `(n,)`.
    freedom_mN
        Deviations that need no boundary, each as large as one standard deviation of what is known of it
        beforehand, shape `(K, n)`.
    """

    speed_mm_s: FloatArray
    force_mN: FloatArray
    error_mN: FloatArray
    freedom_mN: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Of the deviations without any boundary or trend, shape `(n, n)`."""
        return np.asarray(np.diag(self.error_mN**2) + self.freedom_mN.T @ self.freedom_mN)


@dataclass(frozen=True, slots=True, eq=False)
class _HingeSearch:
    """Hinges tried, shape `(G, n)`, and `unit`, the same whitened, made free of level and trend, and of length 1."""

    at_mm_s: FloatArray
    hinge: FloatArray
    unit: FloatArray
    whiten: FloatArray

    @property
    def degrees(self) -> int:
        """Degrees of freedom that level, trend and hinge leave."""
        return int(self.unit.shape[1]) - 4

    def drops(self, whitened: FloatArray) -> FloatArray:
        """How much each hinge takes off the squares, shape `(…, G)`."""
        return np.asarray((whitened @ self.unit.T) ** 2)

    def left_over(self, squares: FloatArray, drop: FloatArray) -> FloatArray:
        """Squares per degree of freedom that a hinge leaves; 1 where the errors explain them."""
        return np.maximum(1.0, (squares - drop) / self.degrees)


def find_boundary(deviation: ForceDeviation, what: str = "measurement and model") -> SpeedBoundary:
    """Estimate the boundary with its interval by profile likelihood, and the chance of such a one by errors alone.

    Where the hinge leaves more than the errors explain, improvements count relative to what it leaves.

    Parameters
    ----------
    what
        The two that part ways, for the sentence.
    """
    speeds = len(deviation.speed_mm_s)
    if speeds < MIN_SPEEDS_FOR_BOUNDARY:
        given = f"{speeds} speed{'s' * (speeds != 1)}"
        return SpeedBoundary(
            None,
            None,
            None,
            f"With {given} a boundary cannot be estimated; it takes at least {MIN_SPEEDS_FOR_BOUNDARY}.",
        )
    search = _search_hinges(deviation)
    free = _trend_projection(search.whiten, deviation.speed_mm_s)
    seen = free @ search.whiten @ deviation.force_mN
    drop = search.drops(seen)
    best = int(drop.argmax())
    left = float(search.left_over(seen @ seen, drop[best]))
    chance = _null_probability(search, free, float(drop[best]) / left)
    if chance >= SIGNIFICANCE:
        return SpeedBoundary(None, None, chance, _no_boundary_sentence(deviation, what, chance))
    at = float(search.at_mm_s[best])
    inside = search.at_mm_s[drop[best] - drop <= CHI2_95 * left]
    interval = _widen_to_speeds(deviation.speed_mm_s, at, float(inside.min()), float(inside.max()))
    return SpeedBoundary(at, interval, chance, _boundary_sentence(deviation, search, best, interval, chance, what))


def _search_hinges(deviation: ForceDeviation) -> _HingeSearch:
    speed = deviation.speed_mm_s
    at = np.geomspace(speed[1], speed[-2], BOUNDARY_GRID_POINTS)
    hinge = np.maximum(np.log(speed / at[:, None]), 0.0)
    whiten = np.linalg.inv(np.linalg.cholesky(deviation.covariance))
    unit = hinge @ whiten.T @ _trend_projection(whiten, speed)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return _HingeSearch(at, hinge, unit, whiten)


def _widen_to_speeds(speed_mm_s: FloatArray, at_mm_s: float, low: float, high: float) -> tuple[float, float]:
    """Widen an interval to the speeds next to the boundary."""
    slower, faster = speed_mm_s[speed_mm_s <= at_mm_s], speed_mm_s[speed_mm_s >= at_mm_s]
    return min(low, float(slower[-1])), max(high, float(faster[0]))


def _trend_projection(whiten: FloatArray, speed_mm_s: FloatArray) -> FloatArray:
    """Return the projection that takes level and trend off whitened deviations."""
    basis, _ = np.linalg.qr(whiten @ _trend(speed_mm_s))
    return np.asarray(np.eye(len(speed_mm_s)) - basis @ basis.T)


def _trend(speed_mm_s: FloatArray) -> FloatArray:
    return np.column_stack((np.ones_like(speed_mm_s), np.log(speed_mm_s)))


def _null_probability(search: _HingeSearch, free: FloatArray, improvement: float) -> float:
    """Share of simulated campaigns without a boundary that improve as much."""
    drawn = np.random.default_rng(NULL_SEED).standard_normal((NULL_SIMULATIONS, len(free))) @ free
    drop = search.drops(drawn).max(axis=1)
    left = search.left_over((drawn**2).sum(axis=1), drop)
    return float((1 + np.count_nonzero(drop / left >= improvement)) / (1 + NULL_SIMULATIONS))


def _no_boundary_sentence(deviation: ForceDeviation, what: str, chance: float) -> str:
    from scipy.special import chdtrc

    squares = deviation.force_mN @ np.linalg.solve(deviation.covariance, deviation.force_mN)
    alike = float(chdtrc(len(deviation.force_mN), squares))
    besides = ""
    if alike < SIGNIFICANCE:
        besides = f" Yet {what} differ (p {_p_text(alike)}), with no speed at which that begins."
    return (
        f"No boundary is supported: the difference between {what} bends no more than errors allow "
        f"(p {_p_text(chance)} {_simulation_note()}); a boundary is reported for about 5 in 100 campaigns that have "
        f"none.{besides}"
    )


def _boundary_sentence(
    deviation: ForceDeviation, search: _HingeSearch, best: int, interval: tuple[float, float], chance: float, what: str
) -> str:
    speed, (low, high) = deviation.speed_mm_s, interval
    below, change = _hinge_slopes(deviation, search, best)
    above = abs(below) <= abs(below + change)
    far = float(speed[-1] if above else speed[0])
    size = change * abs(np.log(far / search.at_mm_s[best]))
    at_end = "" if speed[1] < low and high < speed[-2] else ", which the range of speeds cuts off"
    return (
        f"{what[:1].upper()}{what[1:]} part ways {'above' if above else 'below'} {search.at_mm_s[best]:.3g} mm/s "
        f"(95 %: {low:.3g} to {high:.3g} mm/s{at_end}; p {_p_text(chance)} {_simulation_note()}): at {far:.3g} mm/s "
        f"the force is {abs(size):.2g} mN {'higher' if size > 0 else 'lower'} than expected from the other speeds."
    )


def _hinge_slopes(deviation: ForceDeviation, search: _HingeSearch, best: int) -> tuple[float, float]:
    """Return the trend below the boundary and its change there [mN per unit of ln v]."""
    design = np.column_stack((_trend(deviation.speed_mm_s), search.hinge[best]))
    found, *_ = np.linalg.lstsq(search.whiten @ design, search.whiten @ deviation.force_mN)
    return float(found[1]), float(found[2])


def _simulation_note() -> str:
    return f"by {NULL_SIMULATIONS} simulated campaigns, seed {NULL_SEED}"


def _p_text(chance: float) -> str:
    least = 2 / NULL_SIMULATIONS
    return f"< {least:g}" if chance < least else f"= {chance:.2g}"


MIN_SPEEDS_FOR_R2 = 3
PAPER_BOUNDARY_MM_S = 20.0
SPEED_TOLERANCE = 0.01
"""A stage that is so much faster than the speed it was set to is still at that speed."""


def r2_eq15(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the paper's Eq. 15, Σ(f₁ − f̄₁)² / Σ(f₂ − f̄₁)²; None where the measured forces all equal f̄₁.

    f₁ is the model, f₂ the measurement, and f̄₁ the model's mean in both sums: no share of anything, and above 1
    where the model varies more than the measurement.
    """
    mean = float(model.mean())
    about_mean = float(((measured - mean) ** 2).sum())
    return float(((model - mean) ** 2).sum()) / about_mean if about_mean else None


def squared_correlation(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the square of the correlation, which the paper introduces Eq. 15 as; None where either is constant."""
    if np.ptp(model) == 0 or np.ptp(measured) == 0:
        return None
    return float(np.corrcoef(model, measured)[0, 1] ** 2)


def r2_by_band(
    points: Sequence[SpeedPoint], boundary: SpeedBoundary | None, prefix: str = ""
) -> tuple[SpeedBandR2, ...]:
    """Compare model and measurement over all speeds, and below and above the paper's and the estimated boundary."""
    return tuple(_band_r2(prefix + name, band) for name, band in _speed_bands(points, boundary))


def _speed_bands(
    points: Sequence[SpeedPoint], boundary: SpeedBoundary | None
) -> Iterator[tuple[str, list[SpeedPoint]]]:
    yield "all speeds", list(points)
    limits = [(PAPER_BOUNDARY_MM_S, "")]
    if boundary is not None and boundary.speed_mm_s is not None:
        limits.append((boundary.speed_mm_s, " (estimated boundary)"))
    for limit, note in limits:
        highest = limit * (1 + SPEED_TOLERANCE)
        yield f"up to {limit:.3g} mm/s{note}", [point for point in points if abs(point.speed_mm_s) <= highest]
        yield f"above {limit:.3g} mm/s{note}", [point for point in points if abs(point.speed_mm_s) > highest]


def _band_r2(band: str, points: Sequence[SpeedPoint]) -> SpeedBandR2:
    if len(points) < MIN_SPEEDS_FOR_R2:
        return SpeedBandR2(band, len(points), None, None)
    model = np.array([point.model_mN for point in points])
    measured = np.array([point.force.value for point in points], dtype=float)
    return SpeedBandR2(band, len(points), r2_eq15(model, measured), squared_correlation(model, measured))
