"""At which speed a measurement parts ways with what it is compared with, and whether it does so at all.

The deviation of one from the other is taken to be errors, the freedom that a specimen has, and a steady trend
in ln v; or besides a hinge, the trend changing at the boundary. Boundaries are searched along a grid. A search
finds something in any data, so that the improvement is judged by how often campaigns without a boundary, drawn
from the same errors, improve as much under the same search.

What sets in at a boundary may set in gradually, where a hinge bends at once. So the interval is never narrower than
the two speeds measured next to the boundary. On simulated specimens at 9 or 11 speeds a hinge of 6, 12 and 30 mN for
every factor e of speed is found in 55 to 80, 98 and 100 % of campaigns, and the interval holds it in 91 to 95, 95 to
99 and 97 to 100 % of these; of a hinge of 3 mN, found in 20 %, in 64 to 88 %. Contact lost gradually above 15 mm/s,
by 20 or 50 % of f_e in the end, is always found; the interval holds 15 mm/s in 77 to 83 and 96 to 99 %. Of campaigns
without a boundary, 4 to 6 % are said to have one; fewer where the model was identified from the same runs.
"""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.results import Boundary
from dragrig.rig.arrays import FloatArray

FEWEST_SPEEDS = 5
GRID = 200
"""Boundaries tried, evenly spaced in ln v between the second speed and the last but one."""
SIMULATIONS = 2000
SEED = 2012
SIGNIFICANT = 0.05
PROFILE_95 = 3.8415
"""How much worse the squares may be for a boundary inside the 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
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
class _Search:
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


def find_boundary(deviation: Deviation, what: str = "measurement and model") -> Boundary:
    """Estimate the boundary with its interval by profile likelihood, and the chance of such a one by errors alone.

    Where the hinge leaves more than the errors explain, improvements count relative to what it leaves.

    Parameters
    ----------
    what
        The two that part ways, for the sentence.
    """
    speeds = len(deviation.speed_mm_s)
    if speeds < FEWEST_SPEEDS:
        given = f"{speeds} speed{'s' * (speeds != 1)}"
        return Boundary(
            None, None, None, f"With {given} a boundary cannot be estimated; it takes at least {FEWEST_SPEEDS}."
        )
    search = _searched(deviation)
    free = _without_trend(search.whiten, deviation.speed_mm_s)
    seen = free @ search.whiten @ deviation.force_mN
    drop = search.drops(seen)
    best = int(drop.argmax())
    left = float(search.left_over(seen @ seen, drop[best]))
    chance = _chance(search, free, float(drop[best]) / left)
    if chance >= SIGNIFICANT:
        return Boundary(None, None, chance, _none_found(deviation, what, chance))
    at = float(search.at_mm_s[best])
    inside = search.at_mm_s[drop[best] - drop <= PROFILE_95 * left]
    interval = _no_finer_than(deviation.speed_mm_s, at, float(inside.min()), float(inside.max()))
    return Boundary(at, interval, chance, _found(deviation, search, best, interval, chance, what))


def _searched(deviation: Deviation) -> _Search:
    speed = deviation.speed_mm_s
    at = np.geomspace(speed[1], speed[-2], GRID)
    hinge = np.maximum(np.log(speed / at[:, None]), 0.0)
    whiten = np.linalg.inv(np.linalg.cholesky(deviation.covariance))
    unit = hinge @ whiten.T @ _without_trend(whiten, speed)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return _Search(at, hinge, unit, whiten)


def _no_finer_than(speed_mm_s: FloatArray, at_mm_s: float, low: float, high: float) -> tuple[float, float]:
    """Widen an interval to the speeds next to the boundary."""
    slower, faster = speed_mm_s[speed_mm_s <= at_mm_s], speed_mm_s[speed_mm_s >= at_mm_s]
    return min(low, float(slower[-1])), max(high, float(faster[0]))


def _without_trend(whiten: FloatArray, speed_mm_s: FloatArray) -> FloatArray:
    """Return the projection that takes level and trend off whitened deviations."""
    basis, _ = np.linalg.qr(whiten @ _trend(speed_mm_s))
    return np.asarray(np.eye(len(speed_mm_s)) - basis @ basis.T)


def _trend(speed_mm_s: FloatArray) -> FloatArray:
    return np.column_stack((np.ones_like(speed_mm_s), np.log(speed_mm_s)))


def _chance(search: _Search, free: FloatArray, improvement: float) -> float:
    """Share of simulated campaigns without a boundary that improve as much."""
    drawn = np.random.default_rng(SEED).standard_normal((SIMULATIONS, len(free))) @ free
    drop = search.drops(drawn).max(axis=1)
    left = search.left_over((drawn**2).sum(axis=1), drop)
    return float((1 + np.count_nonzero(drop / left >= improvement)) / (1 + SIMULATIONS))


def _none_found(deviation: Deviation, what: str, chance: float) -> str:
    from scipy.special import chdtrc

    squares = deviation.force_mN @ np.linalg.solve(deviation.covariance, deviation.force_mN)
    alike = float(chdtrc(len(deviation.force_mN), squares))
    besides = ""
    if alike < SIGNIFICANT:
        besides = f" Yet {what} differ (p {_spelt(alike)}), with no speed at which that begins."
    return (
        f"No boundary is supported: the difference between {what} bends no more than errors allow "
        f"(p {_spelt(chance)} {_how()}); of campaigns without a boundary, about 5 in 100 are said to have one.{besides}"
    )


def _found(
    deviation: Deviation, search: _Search, best: int, interval: tuple[float, float], chance: float, what: str
) -> str:
    speed, (low, high) = deviation.speed_mm_s, interval
    below, change = _slopes(deviation, search, best)
    above = abs(below) <= abs(below + change)
    far = float(speed[-1] if above else speed[0])
    size = change * abs(np.log(far / search.at_mm_s[best]))
    at_end = "" if speed[1] < low and high < speed[-2] else ", which the range of speeds cuts off"
    return (
        f"{what[:1].upper()}{what[1:]} part ways {'above' if above else 'below'} {search.at_mm_s[best]:.3g} mm/s "
        f"(95 %: {low:.3g} to {high:.3g} mm/s{at_end}; p {_spelt(chance)} {_how()}): at {far:.3g} mm/s the measured "
        f"force is {abs(size):.2g} mN {'higher' if size > 0 else 'lower'} than the other speeds let expect."
    )


def _slopes(deviation: Deviation, search: _Search, best: int) -> tuple[float, float]:
    """Return the trend below the boundary and its change there [mN per unit of ln v]."""
    design = np.column_stack((_trend(deviation.speed_mm_s), search.hinge[best]))
    found, *_ = np.linalg.lstsq(search.whiten @ design, search.whiten @ deviation.force_mN)
    return float(found[1]), float(found[2])


def _how() -> str:
    return f"by {SIMULATIONS} simulated campaigns, seed {SEED}"


def _spelt(chance: float) -> str:
    least = 2 / SIMULATIONS
    return f"< {least:g}" if chance < least else f"= {chance:.2g}"
