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
"""Shape of the wall's law, all elements alike: relative change over a strain of 1."""
ELEMENT_SHAPE_SD = 0.005
"""That of a single element beside the others."""
INTEGRATION_STEP_S = 0.004
"""Step of a programme that integrates a ramp by strain that comes at the begin or the end of a step."""
COARSE_STEP_S = 0.006
"""Steps between which the force of a ramp may be a straight line."""
CONTACT_INTEGRAL_SD = 0.01
"""Wall's resistance over its pressure at the equator, and its trend with speed over a factor of e²."""
ELEMENTS = 5
REFERENCE_STRAIN = 1.0
LAW_POWERS = (1, 2)
PANELS = 8
"""Midpoints of so many panels, on what is newly touched and on the rest, are as coarse as a programme's sum may be."""


@dataclass(frozen=True, slots=True)
class ModelErrorDirection:
    """A detail of the nominal model that may be off."""

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
        The run.
    speed_mm_s
        Its speed.
    """
    rows = [*_wall_law_columns(scene)]
    rows.append(INTEGRATION_STEP_S * _ramp_step_error(scene))
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e)
    rows.append(CONTACT_INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
    rows.append(_quadrature_error(scene))
    return np.stack(rows)


def _wall_law_columns(scene: RunState) -> Iterator[FloatArray]:
    bent = {power: _strain_power_by_element(scene, power) for power in LAW_POWERS}
    for power in LAW_POWERS:
        yield LAW_SHAPE_SD * np.sum(bent[power], axis=0)
    for values in bent[1]:
        yield ELEMENT_SHAPE_SD * values


def _strain_power_by_element(scene: RunState, power: int) -> list[FloatArray]:
    """Return what changes if each element in turn grows by a power of the strain beyond its middle."""
    wall, sheared = scene.wall, scene.sheared
    if wall is not None:
        bend = (wall.strain - REFERENCE_STRAIN) ** power * wall.strain
        at_equator = (wall.strain_at_equator - REFERENCE_STRAIN) ** power * wall.strain_at_equator
        stresses = stress_log_derivatives(wall.parameters, wall.age_s) * bend
        pressed = stress_log_derivatives(wall.equator_parameters, wall.equator_age_s) * at_equator
        rubbing, sides = scene.friction_coefficient * scene.coulomb_sign, np.sign(scene.f_e)
        pairs = zip(stresses, pressed, strict=True)
        return [np.asarray(sides * wall.resistance(one) + rubbing * wall.side_force(other)) for one, other in pairs]
    if sheared is not None:
        factor = (sheared.target_strain - REFERENCE_STRAIN) ** power
        return [np.asarray(factor * values) for values in _sheared_force_by_element(sheared)]
    return [np.zeros_like(scene.time_s)] * ELEMENTS


def _sheared_force_by_element(sheared: ShearedWall) -> list[FloatArray]:
    result = [np.asarray(values * sheared.area_mm2) for values in sheared.stresses]
    step = 1e-3
    for rate, modulus in zip(sheared.rates, sheared.moduli[:2], strict=True):
        changed = sheared.branch(rate * (1 - step)) - sheared.branch(rate * (1 + step))
        result.append(np.asarray(sheared.area_mm2 * modulus * changed / (2 * step)))
    return result


def _quadrature_error(scene: RunState) -> FloatArray:
    """Return by how much a coarse sum over the contact differs: it misses what the fast branch does at first touch."""
    if scene.wall is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(np.sign(scene.f_e) * (scene.wall.coarse_resistance(PANELS) - np.abs(scene.f_e)))


def _ramp_step_error(scene: RunState) -> FloatArray:
    """Return by how much the fast branch differs per second of a step at whose begin, not middle, all strain comes."""
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(0.5 * sheared.rates[0] * sheared.stresses[0] * sheared.area_mm2)


def ramp_integration_sd(scene: RunState) -> FloatArray:
    """Return by how much a ramp's force differs that is known at coarse steps only [mN], one standard deviation.

    Between steps a line cuts off its bends. Where steps fall is not known, so that this is noise.
    """
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    by_way = sum(sheared.moduli) * sheared.area_mm2 / sheared.force.branches.thickness_mm
    return np.asarray(COARSE_STEP_S**2 / 8.0 * by_way * np.abs(scene.acceleration_mm_s2))


MAX_PRIOR_SHARE = 0.2
"""One standard deviation of a narrowed prior changes the channel by this share of what it is."""


def empirical_priors(problem: JointProblem) -> JointProblem:
    """Return a problem whose priors lie about a fit of the model alone, and are no wider than effects can mislead it.

    A diagnosis linearises. With a prior as wide as any stage there is, a step beside a strong effect would end at a
    stage that cannot be, where the next one no longer holds.
    """
    values = problem.scales.values(solve_joint(problem).z)
    measured = np.concatenate([data.blocks.mean for data in problem.channels])
    by_value = np.concatenate([data.sensitivities(values) for data in problem.channels], axis=1)
    size = np.sqrt(np.mean(measured**2))
    parameters = []
    for parameter, value, slope in zip(problem.nominal.parameters, values.tolist(), by_value, strict=True):
        moved = float(np.sqrt(np.mean(slope**2))) * (value if parameter.positive else 1.0)
        sd = (
            min(parameter.prior_sd, MAX_PRIOR_SHARE * float(size) / moved)
            if moved > 0 and size > 0
            else parameter.prior_sd
        )
        parameters.append(replace(parameter, nominal=value, prior_sd=sd))
    return replace(problem, scales=PriorScales.of(tuple(parameters)))
