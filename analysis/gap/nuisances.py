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
PEAK_SD = 0.02
"""Fast branch in a ramp, which quadratures take at the begin or the end of a step."""
INTEGRAL_SD = 0.01
"""Wall's resistance over its pressure at the equator, and its trend with speed over a factor of e²."""
ELEMENTS = 5
MIDDLE_STRAIN = 1.0
LAW_POWERS = (1, 2)


@dataclass(frozen=True, slots=True)
class Detail:
    """A detail of the nominal model that may be off."""

    name: str
    sd: float


DETAILS = (
    *(Detail(f"law_{power}", LAW_SD) for power in LAW_POWERS),
    *(Detail(f"law_of_{element}", ELEMENT_SD) for element in range(ELEMENTS)),
    Detail("ramp_peak", PEAK_SD),
    Detail("contact_integral", INTEGRAL_SD),
    Detail("contact_integral_speed", INTEGRAL_SD),
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
    rows.append(PEAK_SD * _fast_peak(scene))
    rows.append(INTEGRAL_SD * scene.f_e)
    rows.append(INTEGRAL_SD * scene.f_e * 0.5 * float(np.log(max(speed_mm_s, 0.1) / 5.0)))
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


def _fast_peak(scene: Scene) -> FloatArray:
    return np.zeros_like(scene.time_s) if scene.sheared is None else scene.sheared.stresses[0] * scene.sheared.area_mm2
