"""Findings on the geometry of the contact."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, percent, spelled
from dragrig.analysis.paper.printed import (
    CAPSULE,
    COULOMB_DIAMETER_MM,
    HIGHEST_MM_S,
    LOWEST_MM_S,
    MODEL,
    WALL_THICKNESS_MM,
)
from dragrig.sim_backend.friction import steady_forces
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2

SPEED_MM_S = 20.0


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _thick_wall()
    yield _constant_thickness()
    yield _two_capsules()
    yield _side_area()
    yield _side_length()


def _contact() -> HemisphereContact:
    return HemisphereContact.of(CAPSULE, WALL_THICKNESS_MM, MODEL)


def _inner_radius() -> float:
    contact = _contact()
    return contact.radius_mm * float(np.cos(contact.angle_rad))


def _thick_wall() -> Finding:
    undisturbed = WALL_THICKNESS_MM / _inner_radius()
    equator = WALL_THICKNESS_MM / _contact().radius_mm
    return Finding(
        "thick-wall",
        "The formula of a thin wall is used for a thick one",
        "Eqs. 2 and 7",
        "Hoop stress and pressure are related by P = 2 λ τ / D.",
        (
            Number("thickness over radius, undisturbed", undisturbed),
            Number("thickness over radius, at the equator", equator),
        ),
        f"That holds for a wall much thinner than its radius, usually up to a tenth of it. Here the wall measures "
        f"{spelled(undisturbed, 2)} of the inner radius where the contact begins and {spelled(equator, 2)} at the "
        "equator.",
        "P is computed as printed.",
    )


def _constant_thickness() -> Finding:
    inner, radius = _inner_radius(), _contact().radius_mm
    section = (inner + WALL_THICKNESS_MM) ** 2 - inner**2
    thinned = float(np.sqrt(radius**2 + section)) - radius
    return Finding(
        "constant-thickness",
        "An incompressible wall is stretched and does not get thinner",
        "Section 2.1.1, Eqs. 2 and 7",
        "The wall is assumed incompressible, and λ is the same 2.5 mm at every strain.",
        (
            Number("thickness used", WALL_THICKNESS_MM, "mm"),
            Number("thickness at the equator at constant cross-section", thinned, "mm"),
            Number("difference in P(L)", 100 * (thinned / WALL_THICKNESS_MM - 1), "%", 2),
        ),
        f"A gut that keeps its cross-section while it is stretched over the capsule is {spelled(thinned)} mm thick at "
        f"the equator, which changes the pressure there by {percent(thinned / WALL_THICKNESS_MM - 1)}.",
        "λ is the specimen's wall_thickness_mm, the same everywhere, as printed.",
    )


def _two_capsules() -> Finding:
    wide = CAPSULE.model_copy(update={"diameter_mm": COULOMB_DIAMETER_MM})
    usual, other = (
        float(steady_forces([SPEED_MM_S], MODEL, one, WALL_THICKNESS_MM).total[0]) for one in (CAPSULE, wide)
    )
    inner = [2 * _inner_radius() * one.diameter_mm / CAPSULE.diameter_mm for one in (CAPSULE, wide)]
    return Finding(
        "two-capsules",
        "Two capsules, and a gut whose diameter follows them",
        "Sections 3.2 and 3.3, Eq. 5",
        "The dummy of the relaxation test measures 12.9 mm, that of the Coulomb test 13 mm; the gut's undisturbed "
        "diameter is 2 R cos α.",
        (
            Number("total at 20 mm/s with 12.9 mm", usual, "mN", 4),
            Number("total at 20 mm/s with 13 mm", other, "mN", 4),
            Number("undisturbed diameter for 12.9 mm", inner[0], "mm"),
            Number("undisturbed diameter for 13 mm", inner[1], "mm"),
        ),
        f"The size alone matters little ({percent(other / usual - 1)} at 20 mm/s). But with a fixed α the gut is "
        f"{inner[0]:.2f} mm wide for one capsule and {inner[1]:.2f} mm for the other: half of the capsule by "
        "definition, "
        "not a property of the gut.",
        "Each kind of run has its own capsule (drag and rough 12.9 mm, smooth 13 mm); α belongs to the capsule's file.",
    )


def _side_area() -> Finding:
    contact = _contact()
    strip = 2 * np.pi * contact.radius_mm * MODEL.side_contact_mm
    side = float(contact.side_pressure().force(np.array([contact.length_mm / SPEED_MM_S]))[0])
    weight, mu = CAPSULE.mass_g * GRAVITY_M_S2, MODEL.friction_coefficient
    f_c, f_c_strip = mu * (weight + side), mu * (weight + side * strip / contact.area_mm2)
    return Finding(
        "side-area",
        "The side's pressure acts on the hemisphere's area",
        "Eqs. 8, 12 and 13",
        "The normal force at the capsule's side is P S with the hemisphere's contact surface S; the side pressure acts "
        "on 20 mm behind the equator.",
        (
            Number("S, the hemisphere's contact", contact.area_mm2, "mm²", 4),
            Number("the strip of 20 mm beside the capsule", strip, "mm²", 4),
            Number("f_c at 20 mm/s with S", f_c, "mN"),
            Number("f_c at 20 mm/s with the strip", f_c_strip, "mN"),
        ),
        f"The strip measures {spelled(strip)} mm², {spelled(strip / contact.area_mm2, 2)} times S = "
        f"{spelled(contact.area_mm2, 4)} mm²; with it Coulomb friction at {SPEED_MM_S:g} mm/s would be "
        f"{spelled(f_c_strip)} mN instead of {spelled(f_c)} mN.",
        "N = m g + P(L) S, as printed.",
    )


def _side_length() -> Finding:
    contact = _contact()
    length, side = contact.length_mm, MODEL.side_contact_mm
    force = contact.side_pressure().force
    begin, end = (float(force(np.array([x / SPEED_MM_S]))[0]) for x in (length, length + side))
    slow, quick = side / LOWEST_MM_S, side / HIGHEST_MM_S
    return Finding(
        "side-length",
        "The contact beside the capsule is a length where a time is meant",
        "Section 3.3",
        "For 20 mm behind the equator the radial pressure is taken as at the equator; beyond, it is left out because "
        "the gut needs time to tighten again.",
        (
            Number("length of the dummy", CAPSULE.length_mm, "mm"),
            Number("contact from its beginning to its end", length + side, "mm"),
            Number(f"time in the strip at {LOWEST_MM_S:g} mm/s", slow, "s"),
            Number(f"time in the strip at {HIGHEST_MM_S:g} mm/s", quick, "s"),
            Number(f"P S where the strip begins, {SPEED_MM_S:g} mm/s", begin, "mN"),
            Number(f"P S by Eq. 3 where it ends, {SPEED_MM_S:g} mm/s", end, "mN"),
        ),
        f"The wall passes 20 mm in {spelled(slow)} s at {LOWEST_MM_S:g} mm/s and in {spelled(quick, 2)} s at "
        f"{HIGHEST_MM_S:g} mm/s, so that a fixed length is no time. By Eq. 3 it also goes on relaxing there: at "
        f"{SPEED_MM_S:g} mm/s P S falls from {spelled(begin)} to {spelled(end)} mN. And the dummy of the text is "
        f"{CAPSULE.length_mm:g} mm long, shorter than the {spelled(length + side)} mm of contact.",
        "The pressure beside the capsule stays as at the equator and ends after side_contact_mm, as printed; it is in "
        "the picture of the skew resistance and in no force.",
    )
