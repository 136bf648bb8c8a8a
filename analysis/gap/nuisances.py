"""In what else a nominal model may be a little wrong without any effect: directions with priors.

No wall has exactly the published law, and no two programmes integrate it alike. Each direction is what a prediction
changes by when one such detail is off by one prior standard deviation.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.scene import Scene
from dragrig.sim_backend.effects.wall_view import ShearView
from dragrig.sim_backend.friction.contact import by_element

LAW_SD = 0.02
"""Shape of the wall's law, all elements alike: relative change over a strain of 1."""
ELEMENT_SD = 0.005
"""That of a single element beside the others."""
STEP_S = 0.004
"""Step of a programme that integrates a ramp by strain that comes at the begin or the end of a step."""
COARSE_S = 0.006
"""Steps between which the force of a ramp may be a straight line."""
INTEGRAL_SD = 0.01
"""Wall's resistance over its pressure at the equator, and its trend with speed over a factor of e²."""
ELEMENTS = 5
MIDDLE_STRAIN = 1.0
LAW_POWERS = (1, 2)
PANELS = 8
"""Midpoints of so many panels, on what is newly touched and on the rest, are as coarse as a programme's sum may be."""


@dataclass(frozen=True, slots=True)
class Detail:
    """A detail of the nominal model that may be off."""

    name: str
    sd: float


DETAILS = (
    *(Detail(f"law_{power}", LAW_SD) for power in LAW_POWERS),
    *(Detail(f"law_of_{element}", ELEMENT_SD) for element in range(ELEMENTS)),
    Detail("ramp_step", STEP_S),
    Detail("contact_integral", INTEGRAL_SD),
    Detail("contact_integral_speed", INTEGRAL_SD),
    Detail("contact_sum", 1.0),
)


def details(scene: Scene, speed_mm_s: float) -> FloatArray:
    """Return by how much one standard deviation of each of `DETAILS` changes the true force, shape `(D, n)`.

    Parameters
    ----------
    scene
        The run.
    speed_mm_s
        Its speed.
    """
    rows = [*_laws(scene)]
    rows.append(STEP_S * _early_or_late(scene))
    rows.append(INTEGRAL_SD * scene.f_e)
    rows.append(INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
    rows.append(_coarse_sum(scene))
    return np.stack(rows)


def _laws(scene: Scene) -> Iterator[FloatArray]:
    bent = {power: _bent(scene, power) for power in LAW_POWERS}
    for power in LAW_POWERS:
        yield LAW_SD * np.sum(bent[power], axis=0)
    for one in bent[1]:
        yield ELEMENT_SD * one


def _bent(scene: Scene, power: int) -> list[FloatArray]:
    """Return what changes if each element in turn grows by a power of the strain beyond its middle."""
    wall, sheared = scene.wall, scene.sheared
    if wall is not None:
        bend = (wall.strain - MIDDLE_STRAIN) ** power * wall.strain
        at_equator = (wall.strain_at_equator - MIDDLE_STRAIN) ** power * wall.strain_at_equator
        stresses = by_element(wall.parameters, wall.age_s) * bend
        pressed = by_element(wall.equator_parameters, wall.equator_age_s) * at_equator
        rubbing, sides = scene.friction_coefficient * scene.turning, np.sign(scene.f_e)
        pairs = zip(stresses, pressed, strict=True)
        return [np.asarray(sides * wall.resistance(one) + rubbing * wall.pressing(other)) for one, other in pairs]
    if sheared is not None:
        factor = (sheared.target_strain - MIDDLE_STRAIN) ** power
        return [np.asarray(factor * one) for one in _by_element(sheared)]
    return [np.zeros_like(scene.time_s)] * ELEMENTS


def _by_element(sheared: ShearView) -> list[FloatArray]:
    found = [np.asarray(one * sheared.area_mm2) for one in sheared.stresses]
    step = 1e-3
    for rate, modulus in zip(sheared.rates, sheared.moduli[:2], strict=True):
        changed = sheared.branch(rate * (1 - step)) - sheared.branch(rate * (1 + step))
        found.append(np.asarray(sheared.area_mm2 * modulus * changed / (2 * step)))
    return found


def _coarse_sum(scene: Scene) -> FloatArray:
    """Return by how much a coarse sum over the contact differs: it misses what the fast branch does at first touch."""
    if scene.wall is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(np.sign(scene.f_e) * (scene.wall.coarse_resistance(PANELS) - np.abs(scene.f_e)))


def _early_or_late(scene: Scene) -> FloatArray:
    """Return by how much the fast branch differs per second of a step at whose begin, not middle, all strain comes."""
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    return np.asarray(0.5 * sheared.rates[0] * sheared.stresses[0] * sheared.area_mm2)


def doubt(scene: Scene) -> FloatArray:
    """Return by how much a ramp's force differs that is known at coarse steps only [mN], one standard deviation.

    Between steps a line cuts off its bends. Where steps fall is not known, so that this is noise.
    """
    sheared = scene.sheared
    if sheared is None:
        return np.zeros_like(scene.time_s)
    by_way = sum(sheared.moduli) * sheared.area_mm2 / sheared.force.branches.thickness_mm
    return np.asarray(COARSE_S**2 / 8.0 * by_way * np.abs(scene.acceleration_mm_s2))
