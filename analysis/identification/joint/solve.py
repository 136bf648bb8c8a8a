"""The most probable parameters of a joint fit."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.identification.joint.problem import Problem
from dragrig.rig.arrays import FloatArray

PASSES = 6
STILL = 0.02
"""A pass that moves no parameter by more than this, in units of its error, is the last."""
MOST_STEPS = 30
FURTHEST = 8.0
"""How far from what was known beforehand a parameter may go, in standard deviations of the prior."""


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
    converged
        Whether the optimiser and the passes did.
    steps
        How often derivatives were taken.
    """

    z: FloatArray
    covariance: FloatArray
    whitenings: tuple[Whitening, ...]
    converged: bool
    steps: int
    why: str = ""


def solve(problem: Problem) -> Solution:
    """Find the most probable parameters."""
    from scipy.optimize import least_squares

    z = np.zeros(len(problem.scales.nominal))
    steps, moved, why = 0, np.inf, ""
    for turn in range(PASSES):
        whitenings = problem.whitenings(problem.scales.values(z))
        found = least_squares(
            problem.residuals,
            z,
            problem.jacobian,
            bounds=(-FURTHEST, FURTHEST),
            args=(whitenings,),
            max_nfev=MOST_STEPS,
            # The first pass only has to come near: its covariance was laid out around the nominal values.
            ftol=1e-3 if turn == 0 else 1e-6,
            xtol=1e-6,
            gtol=1e-6,
        )
        steps += int(found.njev or 0)
        jacobian = np.asarray(found.jac)
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        moved = float(np.max(np.abs(found.x - z) / np.sqrt(np.diag(covariance))))
        z = found.x
        if not found.success:
            why = "the optimiser gave up after its most steps"
            break
        if turn and moved < STILL:
            break
    else:
        why = f"after {PASSES} passes a parameter still moves by {moved:.2g} of its error"
    return Solution(z, covariance, whitenings, not why, steps, why)
