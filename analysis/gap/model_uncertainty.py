"""Directions in which a nominal model may be slightly wrong without any effect, with their priors.

No wall follows the published law exactly, and no two programmes integrate it alike. Each direction is the change of
the prediction when one detail of the model is off by one prior standard deviation. Where little is known of a model
beforehand, the priors of its parameters come from the runs themselves (`empirical_priors`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.inference.linear_gaussian import JointProblem, PriorScales, solve_joint
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.run_state import RunState, ShearedWall
from dragrig.sim_backend.friction.wall import stress_log_derivatives

LAW_SHAPE_SD = 0.02
"""Shape of the wall law, all elements alike: relative change over a strain of 1."""
ELEMENT_SHAPE_SD = 0.005
"""Shape of a single element's law, in addition."""
INTEGRATION_STEP_S = 0.004
"""Step of a simulation that applies the strain of a ramp at the begin or the end of a step."""
COARSE_STEP_S = 0.006
"""Step between whose ends a simulation may interpolate the force of a ramp linearly."""
CONTACT_INTEGRAL_SD = 0.01
"""Ratio of wall resistance to pressure at the equator, and its trend with speed over a factor of e²."""
ELEMENTS = 5
REFERENCE_STRAIN = 1.0
LAW_POWERS = (1, 2)
PANELS = 8
"""Coarsest plausible quadrature over the contact: midpoints of this many panels on newly touched and on other wall."""


@dataclass(frozen=True, slots=True)
class ModelErrorDirection:
    """A detail of the nominal model that may be off, with its prior standard deviation."""

    name: str
    sd: float


MODEL_ERROR_DIRECTIONS = (
    *(ModelErrorDirection(f"law_{power}", LAW_SHAPE_SD) for power in LAW_POWERS),
    *(ModelErrorDirection(f"law_of_{element}", ELEMENT_SHAPE_SD) for element in range(ELEMENTS)),
    ModelErrorDirection("ramp_step", INTEGRATION_STEP_S),
    ModelErrorDirection("contact_integral", CONTACT_INTEGRAL_SD),
    ModelErrorDirection("contact_integral_speed", CONTACT_INTEGRAL_SD),
    ModelErrorDirection("contact_sum", 1.0),
)


def model_error_columns(scene: RunState, speed_mm_s: float) -> FloatArray:
    """Return the change of the true force by one prior sd of each of `MODEL_ERROR_DIRECTIONS`, shape `(D, n)`.

    Parameters
    ----------
    scene
        State of the run.
    speed_mm_s
        Speed of the run.
    """
    rows = [*_wall_law_columns(scene)]
    rows.append(INTEGRATION_STEP_S * _ramp_step_error(scene))
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e)
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
    rows.append(_quadrature_error(scene))
    return np.stack(rows)


def _wall_law_columns(scene: RunState) -> Iterator[FloatArray]:
    by_power = {power: _strain_power_by_element(scene, power) for power in LAW_POWERS}
    for power in LAW_POWERS:
        yield LAW_SHAPE_SD * np.sum(by_power[power], axis=0)
    for column in by_power[1]:
        yield ELEMENT_SHAPE_SD * column


def _strain_power_by_element(scene: RunState, power: int) -> list[FloatArray]:
    """Return the force change when each element in turn is scaled by a power of strain minus the reference strain."""
    wall, sheared = scene.wall, scene.sheared
    if wall is not None:
        factor = (wall.strain - REFERENCE_STRAIN) ** power * wall.strain
        equator_factor = (wall.strain_at_equator - REFERENCE_STRAIN) ** power * wall.strain_at_equator
        stresses = stress_log_derivatives(wall.parameters, wall.age_s) * factor
        equator_stresses = stress_log_derivatives(wall.equator_parameters, wall.equator_age_s) * equator_factor
        friction, sign = scene.friction_coefficient * scene.coulomb_sign, np.sign(scene.f_e)
        pairs = zip(stresses, equator_stresses, strict=True)
        return [
            np.asarray(sign * wall.resistance(stress) + friction * wall.side_force(equator_stress))
            for stress, equator_stress in pairs
        ]
    if sheared is not None:
        scale = (sheared.target_strain - REFERENCE_STRAIN) ** power
        return [np.asarray(scale * force) for force in _sheared_force_by_element(sheared)]
    return [np.zeros_like(scene.time_s)] * ELEMENTS


def _sheared_force_by_element(sheared: ShearedWall) -> list[FloatArray]:
    forces = [np.asarray(stress * sheared.area_mm2) for stress in sheared.stresses]
    step = 1e-3
    for rate, modulus in zip(sheared.rates, sheared.moduli[:2], strict=True):
        changed = sheared.branch(rate * (1 - step)) - sheared.branch(rate * (1 + step))
        forces.append(np.asarray(sheared.area_mm2 * modulus * changed / (2 * step)))
    return forces


def _quadrature_error(scene: RunState) -> FloatArray:
    """Return the error of a coarse quadrature over the contact, which misses the fast branch at first touch."""
    if scene.wall is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(np.sign(scene.f_e) * (scene.wall.coarse_resistance(PANELS) - np.abs(scene.f_e)))


def _ramp_step_error(scene: RunState) -> FloatArray:
    """Return the error of the fast branch per second of step, all strain applied at its begin, not its middle."""
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(0.5 * sheared.rates[0] * sheared.stresses[0] * sheared.area_mm2)


def ramp_integration_sd(scene: RunState) -> FloatArray:
    """Return the standard deviation of a ramp's force that is integrated in coarse steps [mN].

    Linear interpolation between steps cuts off its curvature. The phase of the steps is unknown, hence noise.
    """
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    stiffness = sum(sheared.moduli) * sheared.area_mm2 / sheared.force.branches.thickness_mm
    return np.asarray(COARSE_STEP_S**2 / 8.0 * stiffness * np.abs(scene.acceleration_mm_s2))


MAX_PRIOR_SHARE = 0.2
"""One standard deviation of an empirical prior changes the channel by at most this share of its rms."""


def empirical_priors(problem: JointProblem) -> JointProblem:
    """Return a problem with priors around a fit of the model alone, no wider than effects can mislead that fit.

    A diagnosis linearises. With a prior as wide as all conceivable stages, a step beside a strong effect would end at
    impossible parameters, where the next linearisation does not hold.
    """
    values = problem.scales.values(solve_joint(problem).z)
    measured = np.concatenate([data.blocks.mean for data in problem.channels])
    by_value = np.concatenate([data.sensitivities(values) for data in problem.channels], axis=1)
    rms = np.sqrt(np.mean(measured**2))
    parameters = []
    for parameter, value, slope in zip(problem.nominal.parameters, values.tolist(), by_value, strict=True):
        rms_slope = float(np.sqrt(np.mean(slope**2))) * (value if parameter.positive else 1.0)
        sd = (
            min(parameter.prior_sd, MAX_PRIOR_SHARE * float(rms) / rms_slope)
            if rms_slope > 0 and rms > 0
            else parameter.prior_sd
        )
        parameters.append(replace(parameter, nominal=value, prior_sd=sd))
    return replace(problem, scales=PriorScales.of(tuple(parameters)))
