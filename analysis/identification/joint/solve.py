"""The most probable parameters of a joint fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.rig.arrays import FloatArray

PASSES = 12
STILL = 0.05
"""A pass that moves no parameter by more than this, in units of its error, is the last."""
MOST_STEPS = 12
FURTHEST = 8.0
"""How far from what was known beforehand a parameter may go, in standard deviations of the prior."""
NEAR = 0.02
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
    whitenings
        One for each piece of evidence.
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
    misfit: float
    converged: bool
    steps: int
    why: str = ""


class _Evaluations:
    """The model's latest residuals and derivatives, which passes and steps share. Belongs to one `solve`."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._residuals_at: FloatArray | None = None
        self._residuals: list[FloatArray] = []
        self._derivatives_at: FloatArray | None = None
        self._derivatives: list[FloatArray] = []
        self.steps = 0

    def residuals(self, z: FloatArray) -> list[FloatArray]:
        if self._residuals_at is None or not np.array_equal(z, self._residuals_at):
            self._residuals, self._residuals_at = self._problem.residuals(z), z.copy()
        return self._residuals

    def derivatives(self, z: FloatArray) -> list[FloatArray]:
        if self._derivatives_at is None or self._is_far(z, self._derivatives_at):
            self._derivatives, self._derivatives_at = self._problem.derivatives(z), z.copy()
            self.steps += 1
        return self._derivatives

    def _is_far(self, z: FloatArray, from_z: FloatArray) -> bool:
        return bool(np.max(np.abs(z - from_z) * np.minimum(self._problem.scales.sd, 1.0)) > NEAR)


def solve(problem: Problem) -> Solution:
    """Find the most probable parameters."""
    from scipy.optimize import least_squares

    found = _Evaluations(problem)
    z, misfit, why = np.zeros(len(problem.scales.nominal)), 0.0, ""
    for turn in range(PASSES):
        whitenings = problem.whitenings(problem.scales.values(z))
        # Far from the truth the runs would outshout the priors and lead astray: they gain weight as they are explained.
        misfit = misfit or _misfit(_whitened(whitenings, found.residuals(z)))

        def residuals(
            z: FloatArray, laid_out: tuple[Whitening, ...] = whitenings, weight: float = 1 / sqrt(misfit)
        ) -> FloatArray:
            return np.concatenate((weight * _whitened(laid_out, found.residuals(z)), z))

        def jacobian(
            z: FloatArray, laid_out: tuple[Whitening, ...] = whitenings, weight: float = 1 / sqrt(misfit)
        ) -> FloatArray:
            return np.concatenate((weight * _whitened(laid_out, found.derivatives(z)), np.eye(len(z))))

        fit = least_squares(
            residuals,
            z,
            jacobian,
            bounds=(-FURTHEST, FURTHEST),
            # The first pass only has to come near: its covariance was laid out around the nominal values.
            max_nfev=MOST_STEPS if turn else 3,
            ftol=1e-6,
            xtol=1e-4,
            gtol=1e-6,
        )
        slopes = np.asarray(fit.jac)
        covariance = np.linalg.inv(slopes.T @ slopes)
        moved = float(np.max(np.abs(fit.x - z) / np.sqrt(np.diag(covariance))))
        z, before = fit.x, misfit
        misfit = _misfit(_whitened(whitenings, found.residuals(z)))
        if turn and not fit.success:
            why = "the optimiser gave up after its most steps"
        elif turn and moved < STILL and abs(misfit / before - 1) < STILL:
            why = ""
            break
        else:
            why = f"after {turn + 1} passes a parameter still moves by {moved:.2g} of its error"
    return Solution(z, covariance, whitenings, misfit, not why, found.steps, why)


def _whitened(whitenings: Sequence[Whitening], each: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([white.whole(values) for white, values in zip(whitenings, each, strict=True)])


def _misfit(whitened: FloatArray) -> float:
    """Return the runs' squares per block where these exceed what noise explains, 1 where they do not."""
    share = float(whitened @ whitened) / max(len(whitened), 1)
    return share if share > MISFIT else 1.0
