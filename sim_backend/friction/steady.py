"""Friction at steady speed, and the skew resistance along the contact: the paper's Figs. 9 and 7."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dragrig.config.capsule import Capsule
from dragrig.config.errors import SettingsError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.environment import panel_ages
from dragrig.sim_backend.friction.quadrature import FINE, gauss_legendre
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2
from dragrig.sim_backend.friction.viscous import viscous_force

SKEW_POINTS = 2000
"""Points of the contact among which the largest skew resistance is sought before it is refined."""


@dataclass(frozen=True, slots=True, eq=False)
class SteadyForces:
    """Friction at steady speeds, arrays of shape `(n,)`.

    Attributes
    ----------
    f_e, f_v, f_c, total
        Environmental resistance, viscous and Coulomb friction, and their sum [mN].
    side_pressure_force
        Radial force P(L) S [mN], the part of N that the wall gives.
    max_skew, x_of_max_skew
        Largest skew resistance P(x) S [mN] on the contact, and where it is [mm].
    """

    speed_mm_s: FloatArray
    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    total: FloatArray
    side_pressure_force: FloatArray
    max_skew: FloatArray
    x_of_max_skew: FloatArray


def steady_forces(
    speeds_mm_s: npt.ArrayLike, model: FrictionModelSettings, capsule: Capsule, wall_thickness_mm: float
) -> SteadyForces:
    """Friction of a capsule that has moved at constant speed for longer than its contact.

    Raises
    ------
    SettingsError
        For a speed that is not positive, or a contact that the wall parameters do not reach.
    """
    speed = _positive(speeds_mm_s)
    contact = HemisphereContact.of(capsule, wall_thickness_mm, model)
    side = contact.side_pressure().force(contact.length_mm / speed)
    f_e = _environmental_resistance(contact, speed)
    f_v = viscous_force(speed, model, contact.area_mm2)
    normal = capsule.mass_g * GRAVITY_M_S2 + side
    f_c = model.friction_coefficient * normal * np.tanh(speed / model.regularisation_mm_s)
    max_skew, x_of_max_skew = _largest_skew(contact, speed)
    return SteadyForces(speed, f_e, f_v, f_c, f_e + f_v + f_c, side, max_skew, x_of_max_skew)


def skew_resistance(
    x_mm: npt.ArrayLike,
    speed_mm_s: npt.ArrayLike,
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
) -> FloatArray:
    """Skew resistance P(x) S [mN] at contact coordinates and speeds that broadcast against each other.

    Beyond the equator, where x = L, it keeps its value for the length of the side contact; beyond that
    and before the contact it is zero (section 3.3 of the paper). Raises as `steady_forces`.
    """
    contact = HemisphereContact.of(capsule, wall_thickness_mm, model)
    x, speed = np.broadcast_arrays(np.asarray(x_mm, dtype=float), _positive(speed_mm_s))
    on_contact = np.clip(x, 0.0, contact.length_mm)
    touching = (x >= 0) & (x < contact.length_mm + model.side_contact_mm)
    return np.where(touching, _skew(contact, on_contact, speed), 0.0)


def _positive(speeds_mm_s: npt.ArrayLike) -> FloatArray:
    speed = np.asarray(speeds_mm_s, dtype=float)
    if not (np.isfinite(speed) & (speed > 0)).all():
        raise SettingsError("Steady friction needs speeds above 0 mm/s")
    return speed


def _skew(contact: HemisphereContact, x_mm: FloatArray, speed_mm_s: FloatArray) -> FloatArray:
    return contact.pressure(x_mm, x_mm / speed_mm_s) * contact.area_mm2


def _environmental_resistance(contact: HemisphereContact, speed_mm_s: FloatArray) -> FloatArray:
    """Integrate Eq. 9 over the contact, in panels that are geometric in contact age."""
    nodes, weights = gauss_legendre(FINE.ages)
    ages = panel_ages(contact.fastest_rate, float(np.max(contact.length_mm / speed_mm_s, initial=1.0)))
    edges = np.minimum(ages * speed_mm_s[:, None], contact.length_mm)
    width = np.diff(edges, axis=1)[..., None]
    x = edges[:, :-1, None] + width * nodes
    load = contact.axial_load(x, x / speed_mm_s[:, None, None])
    return np.asarray((load * weights * width).sum(axis=(1, 2)))


def _largest_skew(contact: HemisphereContact, speed_mm_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest P(x) S and its x, sought twice: on the whole contact, then around the best point."""
    low, high = np.zeros_like(speed_mm_s), np.full_like(speed_mm_s, contact.length_mm)
    rows = np.arange(speed_mm_s.size)
    for _ in range(2):
        x = np.linspace(low, high, SKEW_POINTS, axis=1)
        skew = _skew(contact, x, speed_mm_s[:, None])
        best = skew.argmax(axis=1)
        low, high = x[rows, np.maximum(best - 1, 0)], x[rows, np.minimum(best + 1, SKEW_POINTS - 1)]
    return skew[rows, best], x[rows, best]
