"""The most probable parameters of a joint fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.nominal.protocol import Prediction
from dragrig.rig.arrays import BoolArray, FloatArray

PASSES = 12
STILL = 0.05
"""A pass that moves no parameter by more than this, in units of its error, is the last."""
LAID_OUT = 4
"""So many passes lay the covariance out anew; a model that does not hold may go on for ever otherwise."""
CLOSE = 3.0
"""Less than this of its error from the minimum, the linearised problem is the problem."""
SHARES = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step of which none makes the squares smaller where it is the last: they jump where a bend of the motion
comes to the equator within a block, and a minimum at such a jump has no slope of 0 to be told by."""
FIRST_STEPS, MOST_STEPS = 2, 8
"""Evaluations within a pass."""
FURTHEST = 6.0
"""How far from what was known beforehand a parameter may go, in standard deviations of the prior."""
NEAR = 0.05
"""Derivatives are taken anew where a parameter has moved by more than this: its value's share, or prior widths."""
MISFIT = 1.1
"""Squares per degree of freedom above which the model is taken to leave more than noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the fit came to.

    Attributes
    ----------
    z
        Parameters in units of their priors, shape `(P,)`.
    covariance
        Of `z` given the runs, shape `(P, P)`.
    whitenings, slopes
        For each piece of evidence: what whitens it, and the derivatives of its block means by `z`, shape `(B, P)`.
    misfit
        By how much the runs' squares exceed what noise explains; the runs were given less weight by as much, so that
        what is known beforehand keeps its own. 1 where the model holds.
    converged
        Whether the optimiser and the passes did; `why` says why not.
    steps
        How often derivatives were taken.
    """

    z: FloatArray
    covariance: FloatArray
    whitenings: tuple[Whitening, ...]
    slopes: tuple[FloatArray, ...]
    misfit: float
    converged: bool
    steps: int
    why: str = ""


class _Evaluations:
    """The model's latest predictions and derivatives, which passes and steps share. Belongs to one `solve`."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._predicted_at: FloatArray | None = None
        self._predictions: list[Prediction] = []
        self._derivatives_at: FloatArray | None = None
        self._derivatives: list[FloatArray] = []
        self._uncertain_at: FloatArray | None = None
        self._uncertainties: list[FloatArray] = []
        self.steps = 0

    def predictions(self, z: FloatArray) -> list[Prediction]:
        if self._predicted_at is None or not np.array_equal(z, self._predicted_at):
            self._predictions, self._predicted_at = self._problem.predictions(z), z.copy()
        return self._predictions

    def residuals(self, z: FloatArray) -> list[FloatArray]:
        pairs = zip(self._problem.evidence, self.predictions(z), strict=True)
        return [predicted.total - one.blocks.mean for one, predicted in pairs]

    def derivatives(self, z: FloatArray) -> list[FloatArray]:
        if self._derivatives_at is None or self._is_far(z, self._derivatives_at):
            self._derivatives, self._derivatives_at = self._problem.derivatives(z), z.copy()
            self.steps += 1
        return self._derivatives

    def whitenings(self, z: FloatArray) -> tuple[Whitening, ...]:
        if self._uncertain_at is None or self._is_far(z, self._uncertain_at):
            self._uncertainties, self._uncertain_at = self._problem.uncertainties(z), z.copy()
        return self._problem.whitenings(self.predictions(z), self._uncertainties)

    def renew(self, z: FloatArray) -> None:
        """Take the derivatives right here."""
        if self._derivatives_at is None or not np.array_equal(z, self._derivatives_at):
            self._derivatives_at = None
            self.derivatives(z)

    def _is_far(self, z: FloatArray, from_z: FloatArray) -> bool:
        return bool(np.max(np.abs(z - from_z) * np.minimum(self._problem.scales.sd, 1.0)) > NEAR)


def is_at_bound(z: FloatArray) -> BoolArray:
    """Tell which parameters are as far from what was known beforehand as they may go."""
    return np.asarray(np.abs(z) >= FURTHEST - 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """Least squares under one covariance: residuals of the runs and of the priors, and their derivatives by `z`."""

    evaluations: _Evaluations
    whitenings: tuple[Whitening, ...]
    misfit: float

    def residuals(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.evaluations.residuals(z)), z))

    def squares(self, z: FloatArray) -> float:
        residuals = self.residuals(z)
        return float(residuals @ residuals)

    def jacobian(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.evaluations.derivatives(z)), np.eye(len(z))))

    def newton(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the step to the minimum of the linearised problem within the bounds, and the covariance there."""
        slopes = self.jacobian(z)
        gradient, curvature = slopes.T @ self.residuals(z), slopes.T @ slopes
        free = ~is_at_bound(z) | (z * gradient > 0)
        step = np.zeros_like(z)
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], gradient[free])
        return step, np.asarray(np.linalg.inv(curvature), dtype=np.float64)

    def lower(self, z: FloatArray, step: FloatArray) -> FloatArray | None:
        """Return the furthest place along a step, of some, where the squares are lower than at `z`."""
        here = self.squares(z)
        places = (np.clip(z + share * step, -FURTHEST, FURTHEST) for share in SHARES)
        return next((place for place in places if self.squares(place) < here), None)

    def _weighted(self, each: Sequence[FloatArray]) -> FloatArray:
        return _whitened(self.whitenings, each) / sqrt(self.misfit)


def solve(problem: Problem) -> Solution:
    """Find the most probable parameters."""
    from scipy.optimize import least_squares

    found = _Evaluations(problem)
    z, misfit, why = np.zeros(len(problem.scales.nominal)), np.inf, ""
    for turn in range(PASSES):
        if turn < LAID_OUT:
            whitenings = found.whitenings(z)
            # Far from the truth the runs would outshout the priors and lead astray: they gain weight as they are
            # explained.
            before, misfit = misfit, _misfit(_whitened(whitenings, found.residuals(z)))
        else:
            before = misfit
            found.renew(z)
        now = _Pass(found, whitenings, misfit)
        step, covariance = now.newton(z)
        moves = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        if moves < STILL and abs(misfit / before - 1) < STILL:
            z, why = z + step, ""
            break
        if turn >= LAID_OUT and moves < CLOSE:
            lower = now.lower(z, step)
            if lower is None:
                why = ""
                break
            step = lower - z
        why = f"after {turn + 1} passes a parameter still moves by {moves:.2g} of its error"
        if moves < CLOSE:
            z = np.clip(z + step, -FURTHEST, FURTHEST)
            continue
        # The first pass only has to come near: its covariance was laid out around the nominal values.
        most = MOST_STEPS if turn else FIRST_STEPS
        fit = least_squares(
            now.residuals, z, now.jacobian, bounds=(-FURTHEST, FURTHEST), max_nfev=most, ftol=1e-7, xtol=2e-3, gtol=1e-6
        )
        z = fit.x
    slopes = tuple(found.derivatives(z))
    return Solution(z, covariance, whitenings, slopes, misfit, converged=not why, steps=found.steps, why=why)


def _whitened(whitenings: Sequence[Whitening], each: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([white.whole(values) for white, values in zip(whitenings, each, strict=True)])


def _misfit(whitened: FloatArray) -> float:
    """Return the runs' squares per block where these exceed what noise explains, 1 where they do not."""
    share = float(whitened @ whitened) / max(len(whitened), 1)
    return share if share > MISFIT else 1.0
