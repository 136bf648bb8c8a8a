"""Priors about what the runs themselves say, where what is known of a model beforehand is next to nothing."""

from dataclasses import replace

import numpy as np

from dragrig.analysis.identification.joint.problem import Problem
from dragrig.analysis.identification.joint.scales import Scales
from dragrig.analysis.identification.joint.solve import solve

SHARE = 0.2
"""One standard deviation of a narrowed prior changes the channel by this share of what it is."""


def narrowed(problem: Problem) -> Problem:
    """Return a problem whose priors lie about a fit of the model alone, and are no wider than effects can mislead it.

    A diagnosis linearises. With a prior as wide as any stage there is, a step beside a strong effect would end at a
    stage that cannot be, where the next one no longer holds.
    """
    values = problem.scales.values(solve(problem).z)
    measured = np.concatenate([one.blocks.mean for one in problem.evidence])
    by_value = np.concatenate([one.sensitivities(values) for one in problem.evidence], axis=1)
    size = np.sqrt(np.mean(measured**2))
    parameters = []
    for parameter, value, slope in zip(problem.nominal.parameters, values.tolist(), by_value, strict=True):
        moved = float(np.sqrt(np.mean(slope**2))) * (value if parameter.positive else 1.0)
        sd = min(parameter.prior_sd, SHARE * float(size) / moved) if moved > 0 and size > 0 else parameter.prior_sd
        parameters.append(replace(parameter, nominal=value, prior_sd=sd))
    return replace(problem, scales=Scales.of(tuple(parameters)))
