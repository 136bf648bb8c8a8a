"""Findings on viscous and Coulomb friction, and on how the parts add up over the speed."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, percent, spelled
from dragrig.analysis.paper.printed import (
    CAPSULE,
    HIGHEST_MM_S,
    LOWEST_MM_S,
    MODEL,
    SENSOR_ACCURACY_MN,
    SPEEDS_MM_S,
    WALL_THICKNESS_MM,
)
from dragrig.sim_backend.friction import SteadyForces, steady_forces
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2

ENDS_MM_S = (LOWEST_MM_S, HIGHEST_MM_S)
SPEED_MM_S = 20.0


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _dimension()
    yield _lubricated()
    yield _weight()
    yield _coulomb_and_speed()
    yield _major_share()
    yield _logarithm()


def _forces(*speeds_mm_s: float, viscous: str = MODEL.viscous) -> SteadyForces:
    model = MODEL.model_copy(update={"viscous": viscous})
    return steady_forces(speeds_mm_s, model, CAPSULE, WALL_THICKNESS_MM)


def _dimension() -> Finding:
    published, newtonian = (_forces(*ENDS_MM_S, viscous=one) for one in ("published", "newtonian"))
    numbers = [
        Number(f"f_v read as {name}, {speed:g} mm/s", float(value), "mN")
        for name, forces in (("δ v", published), ("δ (v/d) S", newtonian))
        for speed, value in zip(ENDS_MM_S, forces.f_v, strict=True)
    ]
    share = [float(one.f_v[-1] / one.total[-1]) for one in (published, newtonian)]
    return Finding(
        "viscous-dimension",
        "Eq. 10 is no force if δ is a viscosity",
        "Eqs. 10 and 11",
        "f_v = δ v, with the apparent viscosity δ of mucus against its shear rate v / d.",
        (
            *numbers,
            Number(f"share of the total at {HIGHEST_MM_S:g} mm/s, δ v", 100 * share[0], "%", 2),
            Number(f"share of the total at {HIGHEST_MM_S:g} mm/s, δ (v/d) S", 100 * share[1], "%", 2),
        ),
        f"Read with v in mm/s and δ in mN·s/mm it gives {spelled(published.f_v[0], 2)} to "
        f"{spelled(published.f_v[1], 2)} mN, the small share that the text speaks of. With δ in Pa·s the shear stress "
        f"δ v / d on S gives {spelled(newtonian.f_v[0], 2)} to {spelled(newtonian.f_v[1], 2)} mN, "
        f"{spelled(100 * share[1], 2)} % of the total at {HIGHEST_MM_S:g} mm/s.",
        "viscous = published is the default, newtonian the dimensionally consistent reading.",
    )


def _lubricated() -> Finding:
    forces = _forces(SPEED_MM_S)
    normal = CAPSULE.mass_g * GRAVITY_M_S2 + float(forces.side_pressure_force[0])
    film = float(forces.f_v[0]) / normal
    return Finding(
        "lubrication",
        "Full lubrication and dry friction at once",
        "Sections 2.2 and 2.3",
        "The capsule is said to be nearly completely lubricated, by a film of 30 µm; Coulomb friction of the villi is "
        "added in full.",
        (
            Number(f"friction coefficient of the film alone, {SPEED_MM_S:g} mm/s", film, "", 2),
            Number("friction coefficient used", MODEL.friction_coefficient, "", 2),
        ),
        f"The film alone would make a coefficient of {spelled(film, 2)} at {SPEED_MM_S:g} mm/s; the model adds "
        f"{spelled(MODEL.friction_coefficient / film, 2)} times as much for the contact that a film excludes.",
        "Both are added, as printed; the joint fit gives each its own scale and says whether the runs tell them apart.",
    )


def _weight() -> Finding:
    forces = _forces(SPEED_MM_S)
    side, weight = float(forces.side_pressure_force[0]), CAPSULE.mass_g * GRAVITY_M_S2
    without = MODEL.friction_coefficient * side
    return Finding(
        "weight",
        "The weight is in the text and not in the equation",
        "Section 2.3, Eqs. 12 and 13",
        "N is called a local contact pressure that consists of the weight's normal force and the radial pressure; "
        "Eq. 13 holds the latter alone.",
        (
            Number("m g", weight, "mN", 4),
            Number(f"P(L) S at {SPEED_MM_S:g} mm/s", side, "mN", 4),
            Number("f_c without the weight", without, "mN"),
            Number("f_c with the weight", float(forces.f_c[0]), "mN"),
        ),
        f"By Eq. 13 alone f_c at {SPEED_MM_S:g} mm/s is {spelled(without)} mN; with the weight it is "
        f"{spelled(forces.f_c[0])} mN. N is a force in both, not a pressure.",
        "N = m g + P(L) S.",
    )


def _coulomb_and_speed() -> Finding:
    forces = _forces(*ENDS_MM_S)
    rise = [float(part[1] - part[0]) for part in (forces.f_c, forces.f_v, forces.f_e)]
    return Finding(
        "coulomb-speed",
        "Coulomb friction depends on speed nearly as much as viscous friction",
        "Section 3.3, Fig. 9, Eqs. 12 and 13",
        "Viscous friction is said to depend on the speed, Coulomb friction hardly.",
        tuple(
            Number(f"{name} rises from {LOWEST_MM_S:g} to {HIGHEST_MM_S:g} mm/s by", value, "mN")
            for name, value in zip(("f_c", "f_v", "f_e"), rise, strict=True)
        ),
        f"Through P(L) f_c rises by {spelled(rise[0])} mN, {percent(rise[0] / float(forces.f_c[0]))} of itself, from "
        f"{LOWEST_MM_S:g} to {HIGHEST_MM_S:g} mm/s, and f_v by {spelled(rise[1])} mN.",
        "f_c follows the side pressure at its age, at every sample.",
    )


def _major_share() -> Finding:
    from scipy.optimize import brentq

    forces = _forces(*ENDS_MM_S)
    shares = [float(one) for one in forces.f_e / forces.total]

    def ahead(speed: float) -> float:
        there = _forces(speed)
        return float(there.f_e[0] - there.f_c[0])

    equal = float(brentq(ahead, *ENDS_MM_S))
    return Finding(
        "major-share",
        "The environmental resistance is not the largest part everywhere",
        "Section 3.3, Fig. 9",
        "Environmental resistance is said to hold the major share of the friction.",
        (
            Number(f"share of f_e at {LOWEST_MM_S:g} mm/s", 100 * shares[0], "%", 2),
            Number(f"share of f_e at {HIGHEST_MM_S:g} mm/s", 100 * shares[1], "%", 2),
            Number("speed at which f_e = f_c", equal, "mm/s", 2),
        ),
        f"Its share is {spelled(100 * shares[0], 2)} % at {LOWEST_MM_S:g} mm/s and {spelled(100 * shares[1], 2)} % at "
        f"{HIGHEST_MM_S:g} mm/s; below {spelled(equal, 2)} mm/s Coulomb friction is larger.",
        "The parts are given for every speed.",
    )


def _logarithm() -> Finding:
    total = _forces(*SPEEDS_MM_S).total
    log_speed = np.log(SPEEDS_MM_S)
    slope, intercept = np.polyfit(log_speed, total, 1)
    miss = total - (intercept + slope * log_speed)
    r2 = 1 - float(miss @ miss) / float(((total - total.mean()) ** 2).sum())
    near = np.array([LOWEST_MM_S, 1.01 * LOWEST_MM_S, HIGHEST_MM_S / 1.01, HIGHEST_MM_S])
    local = _forces(*near).total
    slopes = [float((local[i + 1] - local[i]) / np.log(1.01)) for i in (0, 2)]
    worst = float(np.abs(miss).max())
    return Finding(
        "logarithm",
        "The sum does not grow as the logarithm of the speed",
        "Section 3.3, Fig. 9",
        "The frictional resistance is said to increase logarithmically with velocity.",
        (
            Number("slope of the best law a + b ln v", float(slope), "mN"),
            Number("a at 1 mm/s", float(intercept), "mN"),
            Number("R² of that law for the model's own curve", r2),
            Number("its largest miss", worst, "mN"),
            Number(f"the model's own slope at {LOWEST_MM_S:g} mm/s", slopes[0], "mN", 2),
            Number(f"the model's own slope at {HIGHEST_MM_S:g} mm/s", slopes[1], "mN", 2),
        ),
        f"The best law {spelled(intercept)} + {spelled(slope)} ln(v / 1 mm/s) mN misses the model's own curve, without "
        f"any noise, by up to {spelled(worst, 2)} mN, more than the sensor's {SENSOR_ACCURACY_MN:g} mN. The model's "
        f"slope against ln v grows from {spelled(slopes[0], 2)} to {spelled(slopes[1], 2)} mN; that of a logarithm "
        "would be constant.",
        "The law is fitted with the chance of its lack of fit beside it, and never taken for the model.",
    )
