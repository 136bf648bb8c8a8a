"""Findings on what the paper suspects above its boundary of 20 mm/s."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, spelled
from dragrig.analysis.paper.printed import BOUNDARY_MM_S, CAPSULE, HIGHEST_MM_S, MODEL, WALL_THICKNESS_MM
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.wall import model_wall

DENSITY_G_MM3 = 1.0e-3
"""Of soft tissue, close to water's."""


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _inertia()
    yield _boundary()


def inertial_pressure(x_mm: FloatArray, speed_mm_s: float) -> FloatArray:
    """Pressure [kPa] that the wall's inertia takes off the contact at x, at constant speed.

    The wall follows r(x), so that its acceleration is v² r″ with r″ = −R² / r³; all of its thickness is taken
    to move so.
    """
    contact = _contact()
    radius = np.sqrt(contact.radius_mm**2 - (contact.length_mm - x_mm) ** 2)
    # g/mm³ · mm · mm/s² is 1e-6 N/mm², and a kPa is 1e-3 N/mm².
    return np.asarray(1e-3 * DENSITY_G_MM3 * WALL_THICKNESS_MM * speed_mm_s**2 * contact.radius_mm**2 / radius**3)


def _contact() -> HemisphereContact:
    return HemisphereContact.of(CAPSULE, WALL_THICKNESS_MM, MODEL)


def _inertia() -> Finding:
    x = np.linspace(0.0, _contact().length_mm, 200_001)
    pressure = _contact().pressure(x, x / HIGHEST_MM_S)
    inertial = inertial_pressure(x, HIGHEST_MM_S)
    lifted = float(x[int((pressure > inertial).argmax())])
    most, contact = 1e3 * float(inertial.max()), 1e3 * float(pressure.max())
    slower = 1e3 * float(inertial_pressure(x, BOUNDARY_MM_S).max())
    return Finding(
        "inertia",
        "The wall's inertia is too small to let go of the capsule",
        "Section 4",
        "Above the boundary the wall is suspected not to follow the capsule's shape, because of a larger inertia.",
        (
            Number(f"most that inertia takes off at {BOUNDARY_MM_S:g} mm/s", slower, "Pa"),
            Number(f"most that inertia takes off at {HIGHEST_MM_S:g} mm/s", most, "Pa"),
            Number(f"largest contact pressure at {HIGHEST_MM_S:g} mm/s", contact, "Pa", 4),
            Number("their ratio", 100 * most / contact, "%", 2),
            Number(f"stretch of x in which inertia is larger, {HIGHEST_MM_S:g} mm/s", 1e3 * lifted, "µm", 2),
        ),
        f"Where 2.5 mm of tissue (1 g/cm³) follow the hemisphere at {HIGHEST_MM_S:g} mm/s, inertia takes at most "
        f"{spelled(most, 2)} Pa off a contact pressure of up to {spelled(contact)} Pa, and more than there is only in "
        f"the first {spelled(1e3 * lifted, 2)} µm. A wall that is slow because of its viscosity is another matter.",
        "The model has no inertia of the wall.",
    )


def _boundary() -> Finding:
    contact = _contact()
    wall = model_wall(MODEL, contact.strain_at_equator)
    fast, slow = (float(rate) * contact.length_mm for rate in wall.rates)
    return Finding(
        "boundary",
        "The model has speeds of its own, and 20 mm/s is none of them",
        "Section 4",
        f"Whether the boundary near {BOUNDARY_MM_S:g} mm/s is sharp, and whether it belongs to the material, is left "
        "open.",
        (
            Number("L E2/η2 at the equator", slow, "mm/s", 2),
            Number("L E1/η1 at the equator", fast, "mm/s", 2),
        ),
        f"The wall's branches stop relaxing under the hemisphere around {spelled(slow, 2)} and {spelled(fast, 2)} mm/s "
        "(contact length over time constant). Between them the model changes smoothly; a boundary near 20 mm/s would "
        "be "
        "something that it does not hold.",
        "A boundary is estimated from the runs with the speeds that they do not exclude, and only if they show one.",
    )
