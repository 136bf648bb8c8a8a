"""Whether five elements suffice: what a third Maxwell branch of any time constant would explain besides.

The gain of a branch is the squared projection of the whitened residuals on what it adds beyond all small changes of
the five elements. Its largest value over a grid of time constants has a distribution of its own, as the search
looks at many: it is drawn from the projections of white noise, which follow from the branches alone.
"""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.maxwell.fit import BranchFit, Whitened, refine
from dragrig.analysis.identification.results import ElementsTest
from dragrig.rig.arrays import FloatArray

DRAWS = 4000
SEED = 1912
SUFFICES_ABOVE = 0.01
"""Five elements suffice unless the p-value falls below this: one clean run in a hundred is called otherwise."""
FURTHER = 4.0
"""How far beyond the slowest branch that the fit looks for a third is looked for."""
MATTERS_MN = 5.0
"""Accuracy of the rig's sensor: a branch that never shows as much does not matter, however significant."""
POORLY = 2.0
"""Squared whitened residuals per degree of freedom beyond which something else than relaxation is in a run."""
TOO_LIKE = 1e-6
"""Branches of which no more than this share lies beyond the five elements add nothing."""


def five_or_more(whitened: Whitened, fit: BranchFit) -> ElementsTest:
    """Test a fit of two branches against three."""
    grid = np.append(whitened.grid_s, whitened.grid_s[-1] * np.array([FURTHER**0.5, FURTHER]))
    branches = whitened.rows(whitened.record.branches(grid))
    basis, _ = np.linalg.qr(fit.jacobian)
    beyond = branches - (branches @ basis) @ basis.T
    size = np.sqrt((beyond**2).sum(axis=1))
    new = size > TOO_LIKE * np.sqrt((branches**2).sum(axis=1))
    if not new.any():
        return ElementsTest(None, None, None, None, "The run cannot tell five elements from more.")
    grid, beyond = grid[new], beyond[new] / size[new, None]
    # The residual is prediction minus measurement: a branch that is lacking projects on it negatively.
    gains = np.maximum(-(beyond @ fit.residual), 0.0) ** 2
    best = int(gains.argmax())
    left = max(1.0, (fit.chi2 - float(gains[best])) / max(fit.degrees - 2, 1))
    p_value = _chance(beyond, float(gains[best]) / left)
    if p_value >= SUFFICES_ABOVE:
        return _enough(p_value, fit.chi2 / max(fit.degrees, 1))
    modulus = float(gains[best] ** 0.5 / size[new][best])
    third, left = _third(whitened, fit, float(grid[best]), modulus)
    return _not_enough(p_value, third, left)


def _enough(p_value: float, left: float) -> ElementsTest:
    if left > POORLY:
        told = f"Neither five elements nor a third branch describe the run (χ² per degree {left:.3g})."
        return ElementsTest(None, p_value, None, None, told)
    told = f"Five elements suffice: a third branch explains no more than noise would (p = {p_value:.2g})."
    return ElementsTest(True, p_value, None, None, told)


def _not_enough(p_value: float, third: "_Third", left: float) -> ElementsTest:
    chance = f"p < {1 / DRAWS:.2g}" if p_value < 2 / DRAWS else f"p = {p_value:.2g}"
    what = f"a third branch of {third.time_s:.3g} s and {abs(third.force_mN):.3g} mN explains more than noise would"
    if third.largest_mN < MATTERS_MN:
        told = f"Five elements suffice: {what} ({chance}), yet never shows {MATTERS_MN:g} mN, the sensor's accuracy."
        return ElementsTest(True, p_value, third.time_s, third.force_mN, told)
    told = f"Five elements do not suffice: {what} ({chance})"
    told += f", yet not all of it (χ² per degree {left:.3g})." if left > POORLY else "."
    return ElementsTest(False, p_value, third.time_s, third.force_mN, told)


def _chance(beyond: FloatArray, gain: float) -> float:
    """Chance that white noise gives at least this largest gain over all branches."""
    _, triangle = np.linalg.qr(beyond.T)
    draws = np.random.default_rng(SEED).standard_normal((DRAWS, len(triangle))) @ triangle
    largest = np.maximum(draws, 0.0).max(axis=1) ** 2
    return float((1 + np.count_nonzero(largest >= gain)) / (1 + DRAWS))


@dataclass(frozen=True, slots=True)
class _Third:
    """A third branch: its force when the hold begins, and the largest that it ever shows."""

    time_s: float
    force_mN: float
    largest_mN: float


def _third(whitened: Whitened, fit: BranchFit, time_s: float, modulus: float) -> tuple[_Third, float]:
    """Fit three branches from a first guess of the third; return it, and the chi² per degree that is left."""
    values, count = fit.values, fit.count
    start = np.concatenate((values[: 2 + count], [np.log(max(modulus, 1e-6))], values[2 + count :], [np.log(time_s)]))
    three = refine(whitened, start)
    if three.converged and three.chi2 <= fit.chi2:
        # Which of three is the third is a matter of words: the weakest.
        weakest = int(three.moduli.argmin())
        time_s, modulus = float(three.times_s[weakest]), float(three.moduli[weakest])
    record = whitened.record
    time = np.append(record.ramp_s[1], record.blocks.middle_s)
    shown = record.forces_at(np.array([time_s]), np.array([modulus]), 0.0, time)
    third = _Third(time_s, float(shown[0]), float(np.abs(shown).max()))
    return third, three.chi2 / max(three.degrees, 1)
