"""The joint fit's errors are those that it makes, over several simulated specimens whose values are known."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

import dragrig
from dragrig.analysis.estimates import NORMAL_95, Estimate
from dragrig.analysis.identification.identification import JointFit
from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import select_loaded_runs
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import NoiseSettings, VariationSettings
from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.devices.variability import RandomStream, draw_run_model, draw_specimen_model, random_generator

SEEDS = (11, 12)
PLAN = Plan.model_validate(
    {
        "name": "short",
        "steps": [
            {"kind": "relaxation", "shear_strain": [0.5, 1.5], "hold_s": 8, "way_back": "by_hand"},
            {"kind": "coulomb", "speed_mm_s": [0.5, 20], "travel_mm": 20, "way_back": "by_hand"},
            {"kind": "drag", "speed_mm_s": [2, 10, 40], "travel_mm": 20, "way_back": "by_hand"},
        ],
    }
)


@dataclass(frozen=True, slots=True)
class Known:
    """A fit beside what was simulated."""

    seed: int
    specimen: FrictionModelSettings
    fit: JointFit


def simulated_and_fitted() -> tuple[Known, ...]:
    result = []
    for seed in SEEDS:
        drawn = [f"rig.simulated.seed={seed}", "rig.simulated.variation.specimen=true", "rig.sampling.rate_hz=100"]
        fit = fit_jointly(select_loaded_runs(dragrig.simulate(PLAN, assignments=drawn)), MODEL)
        result.append(Known(seed, draw_specimen_model(MODEL.settings, seed), fit))
    return tuple(result)


def spread(squares: Sequence[float], count: int) -> float:
    """Root mean square of deviations in standard errors: 1 where errors are right."""
    return float(np.sqrt(sum(squares) / count))


def distance(fit: JointFit, specimen: FrictionModelSettings) -> float:
    """Squared distance between fit and truth, in units of the fit's covariance."""

    def scaled(values: Iterable[float]) -> FloatArray:
        pairs = zip(values, MODEL.parameters, strict=True)
        return np.array([log(value) if entry.positive else value for value, entry in pairs])

    at, low, high = (
        scaled(ends)
        for ends in zip(*((parameter.value, *parameter.interval) for parameter in fit.parameters), strict=True)
    )
    true = scaled(float(getattr(specimen, parameter.name)) for parameter in fit.parameters)
    deviations = 2 * NORMAL_95 * (at - true) / (high - low)
    return float(deviations @ np.linalg.solve(fit.correlation, deviations))


def square(result: Estimate, true: float) -> float:
    assert result.value is not None
    assert result.standard_error is not None
    return ((result.value - true) / result.standard_error) ** 2


def test_parameters_and_what_is_each_runs_own_are_as_far_off_as_their_errors_say() -> None:
    campaigns = simulated_and_fitted()
    assert all(campaign.fit.converged for campaign in campaigns)
    result = [distance(campaign.fit, campaign.specimen) for campaign in campaigns]
    assert 0.6 < spread(result, len(result) * len(MODEL.parameters)) < 1.45
    zeros, factors = [], []
    for campaign in campaigns:
        for order, run in enumerate(campaign.fit.runs):
            normal = random_generator(campaign.seed, RandomStream.ZERO, order).standard_normal()
            zeros.append(square(run.zero, NoiseSettings().zero_mN * float(normal)))
            drawn = draw_run_model(campaign.specimen, VariationSettings(), campaign.seed, order)
            if run.kind == "relaxation":
                factors.append(
                    square(run.factors["stiffness"], drawn.stiffness_scale / campaign.specimen.stiffness_scale)
                )
            else:
                own = drawn.friction_coefficient / campaign.specimen.friction_coefficient
                factors.append(square(run.factors["friction"], own))
    assert 0.6 < spread(zeros, len(zeros)) < 1.45
    assert 0.6 < spread(factors, len(factors)) < 1.45
