"""A relaxation slower than both branches of the wall."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    ForceEffect,
    Location,
    RunState,
    Values,
    force_of_hoop_stress,
    shape,
    size,
)

MIN_SPREAD = 0.01
"""Below this spread one branch is used."""

N_BRANCHES = 8
"""Maxwell branches that approximate a distribution of rates."""


def maxwell_chain(time_s: float, spread: float) -> tuple[list[float], list[float]]:
    """Return rates [1/s] and weights of Maxwell branches for a gamma distribution of rates of mean 1 / `time_s`."""
    from scipy.special import roots_genlaguerre

    if spread < MIN_SPREAD:
        return [1 / time_s], [1.0]
    nodes, weights = roots_genlaguerre(N_BRANCHES, 1 / spread - 1)
    return (nodes * spread / time_s).tolist(), (weights / weights.sum()).tolist()


def _relaxed(age_s: FloatArray, rates: list[float], weights: list[float]) -> FloatArray:
    return np.asarray(sum(weight * np.exp(-rate * age_s) for rate, weight in zip(rates, weights, strict=True)))


class ExtraRelaxation(ForceEffect):
    """A third branch of modulus `share · E3` that relaxes as `(1 + spread · t / time)^(−1 / spread)`.

    Without a spread that is one Maxwell branch; with it a gamma distribution of rates around 1 / `time_s`, a power law
    at long times.
    """

    id = "extra_relaxation"
    location = Location.WALL
    coordinate = Coordinate.TIME
    summary = "The wall goes on relaxing, more slowly than both Maxwell branches."
    visible_in = "long holds: relaxations, and drag runs at low speed"
    source = (
        "Maxwell chain of Fung, Biomechanics (1993), chapter 7; modified power law of Williams, "
        "AIAA Journal 2 (1964) 785"
    )
    confused_with = ("force_drift", "hyperelastic_wall")
    parameters = (
        size("share", "1", 0.3, 0.0, 5.0, "modulus over E3"),
        shape("time_s", "s", 8.0, 1.0, 120.0, "relaxation time", grid=(2.0, 4.0, 8.0, 16.0, 32.0, 60.0)),
        shape("spread", "1", 0.0, 0.0, 2.0, "variance of the rates over their mean squared", grid=(0.0, 1.0)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        rates, weights = maxwell_chain(values["time_s"], values["spread"])
        if run.sheared is not None:
            branches = [weight * run.sheared.branch(rate) for rate, weight in zip(rates, weights, strict=True)]
            modulus = values["share"] * run.sheared.moduli[2]
            return np.asarray(run.sheared.area_mm2 * modulus * np.sum(branches, axis=0))
        wall = run.wall
        if wall is None:
            branches = [weight * run.relaxing_branch(rate) for rate, weight in zip(rates, weights, strict=True)]
            return np.asarray(values["share"] * np.sum(branches, axis=0))
        front = values["share"] * wall.parameters.E3 * wall.strain * _relaxed(wall.age_s, rates, weights)
        equator = values["share"] * wall.equator_parameters.E3 * wall.strain_at_equator
        return force_of_hoop_stress(run, wall, front, equator * _relaxed(wall.equator_age_s, rates, weights))
