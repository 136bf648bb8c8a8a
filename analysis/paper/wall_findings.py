"""Findings on the wall's parameters, the relaxation test, the contact, its pressure, and speeds above the boundary."""

from collections.abc import Callable
from typing import Final

import numpy as np

from dragrig.analysis.paper.published import (
    BOUNDARY_MM_S,
    COULOMB_DIAMETER_MM,
    HIGHEST_MM_S,
    LOWEST_MM_S,
    PAPER_CAPSULE,
    PAPER_MODEL,
    WALL_THICKNESS_MM,
    FindingNumber,
    PaperFinding,
    percent,
    rounded,
    rounded_list,
)
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import WallParameters, parameter_set_differences, steady_forces, wall_parameters
from dragrig.sim_backend.friction.friction_force import GRAVITY_M_S2
from dragrig.sim_backend.friction.wall import TABLE1, TABLE1_STRAIN, HemisphereContact, model_wall

ELEMENT_SYMBOLS = {"E1": "E1", "E2": "E2", "E3": "E3", "eta1": "η1", "eta2": "η2"}
"""Elements by their name in the model's settings."""
SPEED_MM_S = 20.0
"""Speed of the examples."""


def largest_misses(quadratic: bool = False) -> dict[str, float]:
    """Largest difference from Table 1 of each element, signed: of Eq. 14, or of the quadratic through Table 1."""
    largest: dict[str, float] = {}
    for row in parameter_set_differences():
        difference = row.quadratic_difference if quadratic else row.eq14_difference
        if abs(difference) > abs(largest.get(row.parameter, 0.0)):
            largest[row.parameter] = difference
    return largest


def _eq14_against_table1() -> PaperFinding:
    printed, fitted = largest_misses(), largest_misses(quadratic=True)
    numbers = [
        FindingNumber(f"Eq. 14, {ELEMENT_SYMBOLS[name]}: largest miss", 100 * value, "%", 2, signed=True)
        for name, value in printed.items()
    ]
    numbers += [
        FindingNumber(f"quadratic, {ELEMENT_SYMBOLS[name]}: largest miss", 100 * value, "%", 2, signed=True)
        for name, value in fitted.items()
    ]
    misses = ", ".join(f"{ELEMENT_SYMBOLS[name]} {percent(value)}" for name, value in printed.items())
    return PaperFinding(
        "eq14-table1",
        "Eq. 14 does not give Table 1",
        "Table 1, Eq. 14",
        "Eq. 14 is introduced as the relation between Table 1's parameters and strain.",
        tuple(numbers),
        f"Its largest misses are {misses}. A least-squares quadratic through the same four points, with as many "
        f"coefficients, stays within {rounded_list((100 * abs(miss) for miss in fitted.values()), 2)} %.",
        "Both sets can be chosen: wall eq14, which the paper's figures use, and wall table1, the quadratic.",
    )


def _damper_unit() -> PaperFinding:
    fast, slow = _time_constants()
    return PaperFinding(
        "eta-unit",
        "The dampers are given in the unit of a modulus",
        "Table 1, Eqs. 3 and 14",
        "η1 and η2 are printed in kPa.",
        (
            FindingNumber("shortest η1/E1", 1e3 * fast.min(), "ms"),
            FindingNumber("longest η1/E1", 1e3 * fast.max(), "ms"),
            FindingNumber("shortest η2/E2", 1e3 * slow.min(), "ms"),
            FindingNumber("longest η2/E2", 1e3 * slow.max(), "ms"),
        ),
        "With kPa the exponent E t/η of Eq. 3 would have the unit of a time. In kPa·s the time constants are "
        f"{rounded(1e3 * fast.min(), 2)} to {rounded(1e3 * fast.max(), 2)} ms and {rounded(1e3 * slow.min())} to "
        f"{rounded(1e3 * slow.max())} ms.",
        "η is taken in kPa·s everywhere.",
    )


def _time_constants() -> tuple[FloatArray, FloatArray]:
    table = np.array(TABLE1)
    return table[3] / table[0], table[4] / table[1]


def _stress_falls() -> PaperFinding:
    table, strain = np.array(TABLE1), np.array(TABLE1_STRAIN)
    at_once, at_last = strain * table[:3].sum(axis=0), strain * table[2]
    numbers = [
        FindingNumber(f"{name} at {100 * eps:g} %", value, "kPa")
        for name, values in (("stress at once", at_once), ("relaxed stress", at_last))
        for eps, value in zip(strain, values, strict=True)
    ]
    return PaperFinding(
        "stress-falls",
        "At 200 % the wall bears less than at 150 %",
        "Table 1, Eq. 3",
        "Table 1 is the outcome of four relaxations on a dummy that does not slip.",
        tuple(numbers),
        f"Right after a step to 50, 100, 150 and 200 % Eq. 3 gives {rounded_list(at_once)} kPa, and "
        f"{rounded_list(at_last)} kPa once relaxed: the last step, larger by a third, meets "
        f"{percent(at_once[-1] / at_once[-2] - 1)} and {percent(at_last[-1] / at_last[-2] - 1)} of stress. Slip, "
        "damage or other pieces of gut would look like this; the text does not say which.",
        "The parameters are used as printed. On a campaign of one's own, the identification gives each strain its "
        "own elements and says whether the relaxation fits them.",
    )


def _shear_as_hoop() -> PaperFinding:
    f_e = float(steady_forces([SPEED_MM_S], PAPER_MODEL, PAPER_CAPSULE, WALL_THICKNESS_MM).f_e[0])
    return PaperFinding(
        "shear-as-hoop",
        "Shear moduli are used as hoop moduli",
        "Section 3.2, Eqs. 3, 4 and 7",
        "Table 1 holds shear stress over shear strain (elongation over wall thickness); Eqs. 3 to 7 use it for hoop "
        "stress over hoop strain. The wall is assumed incompressible and isotropic.",
        (
            FindingNumber(f"f_e at {SPEED_MM_S:g} mm/s as published", f_e, "mN"),
            FindingNumber(f"f_e at {SPEED_MM_S:g} mm/s with E = 3 G", 3 * f_e, "mN"),
        ),
        "For such a material a stretching modulus is three times the shear modulus (at small strains): f_e at "
        f"{SPEED_MM_S:g} mm/s would be {rounded(3 * f_e)} mN instead of {rounded(f_e)} mN.",
        "The moduli are used as published; what a specimen's own stiffness is, its drags say (stiffness_scale).",
    )


def _strain_range() -> PaperFinding:
    contact = HemisphereContact.of(PAPER_CAPSULE, WALL_THICKNESS_MM, PAPER_MODEL)
    radius, length = contact.radius_mm, contact.length_mm
    first = min(TABLE1_STRAIN)
    x_first = length - float(np.sqrt(radius**2 - ((1 + first) * radius * np.cos(contact.angle_rad)) ** 2))
    x = np.linspace(0.0, length, 20_001)
    load = contact.axial_load(x, x / SPEED_MM_S)
    below = x <= x_first
    share = float(np.trapezoid(load[below], x[below]) / np.trapezoid(load, x))
    angle = float(np.degrees(np.arccos(1 / (1 + max(TABLE1_STRAIN)))))
    at_rest = [float(wall_parameters(kind, 0.0).eta1) for kind in ("eq14", "table1")]
    return PaperFinding(
        "strain-range",
        "The strains that were tested are not the strains that are used",
        "Eqs. 5 and 6, Table 1",
        "The relaxations go from 50 to 200 %; the undisturbed diameter is 2 R cos α with α = 60°.",
        (
            FindingNumber("largest strain on the contact", 100 * contact.strain_at_equator, "%"),
            FindingNumber("largest strain of Table 1", 100 * max(TABLE1_STRAIN), "%"),
            FindingNumber("contact angle that would strain to it", angle, "°"),
            FindingNumber("x at which the strain reaches 50 %", x_first, "mm"),
            FindingNumber("that part of the contact's length", 100 * x_first / length, "%"),
            FindingNumber(f"its share of f_e at {SPEED_MM_S:g} mm/s", 100 * share, "%"),
            FindingNumber("η1 at no strain by Eq. 14", at_rest[0], "kPa·s"),
            FindingNumber("η1 at no strain by the quadratic", at_rest[1], "kPa·s"),
        ),
        f"For α = 60° the strain on the contact goes from 0 to {100 * contact.strain_at_equator:.0f} % and uses two "
        f"of the four strains; 200 % would need α = {rounded(angle)}°. The first {rounded(x_first)} mm, below the "
        f"smallest strain tested, are extrapolated, and make {rounded(100 * share, 2)} % of f_e at {SPEED_MM_S:g} "
        "mm/s.",
        "The polynomials are extrapolated as printed; a contact that leads them to a modulus of zero is refused.",
    )


RAMP_MM_S = 20.0
"""Speed of the ramp in the shipped plan; the paper prints none."""
MIN_STRESS_SHARE = 0.9
"""Share of the fast branch's stress that a good step keeps."""


def _ramp_as_step() -> PaperFinding:
    from scipy.optimize import brentq

    strain, table = np.array(TABLE1_STRAIN), np.array(TABLE1)
    travel, time = strain * WALL_THICKNESS_MM, table[3] / table[0]
    lengths = travel / RAMP_MM_S / time
    left = -np.expm1(-lengths) / lengths
    short = float(brentq(lambda length: -np.expm1(-length) / length - MIN_STRESS_SHARE, 1e-6, 10.0))
    needed = travel / (short * time)
    return PaperFinding(
        "ramp",
        "The relaxation is fitted as an ideal step",
        "Section 3.2, Eq. 3",
        "The parameters come from curve fitting of Eq. 3, which holds for a strain that is there at once. Speed and "
        "duration of the ramp are not given.",
        (
            FindingNumber("travel to 50 %", float(travel[0]), "mm"),
            FindingNumber("travel to 200 %", float(travel[-1]), "mm"),
            FindingNumber(f"fast branch left after a ramp of {RAMP_MM_S:g} mm/s to 50 %", 100 * float(left[0]), "%"),
            FindingNumber(f"fast branch left after a ramp of {RAMP_MM_S:g} mm/s to 200 %", 100 * float(left[-1]), "%"),
            FindingNumber(
                f"slowest ramp that leaves {100 * MIN_STRESS_SHARE:.0f} % of it", float(needed.min()), "mm/s"
            ),
            FindingNumber(f"fastest ramp needed to leave {100 * MIN_STRESS_SHARE:.0f} %", float(needed.max()), "mm/s"),
        ),
        f"The fast branch relaxes within {rounded(1e3 * time.min(), 2)} to {rounded(1e3 * time.max(), 2)} ms. A ramp "
        f"of {RAMP_MM_S:g} mm/s would leave {rounded(100 * left[0], 2)} % of its stress at a strain of 50 % and "
        f"{rounded(100 * left[-1], 2)} % at 200 %; to keep {100 * MIN_STRESS_SHARE:.0f} % takes "
        f"{rounded(needed.min(), 2)} to {rounded(needed.max(), 2)} mm/s. What a step fitted to a ramp calls E1 "
        "depends on the ramp.",
        "The identification integrates each branch through the ramp that the encoder saw, not through a step.",
    )


def _fixture_gap() -> PaperFinding:
    contact = HemisphereContact.of(PAPER_CAPSULE, WALL_THICKNESS_MM, PAPER_MODEL)
    undisturbed = 2 * contact.radius_mm * float(np.cos(contact.angle_rad))
    gap = 0.5 * (COULOMB_DIAMETER_MM - PAPER_CAPSULE.diameter_mm)
    stretch = COULOMB_DIAMETER_MM / undisturbed - 1
    return PaperFinding(
        "fixture-gap",
        "The dummy of the relaxation test is thinner than the fixture is wide",
        "Sections 3.2 and 3.3",
        "The gut is sucked open in the vacuum fixture, to 13 mm in the Coulomb test; a dummy of 12.9 mm with "
        "asperities then holds on to the wall without slip.",
        (
            FindingNumber("diameter of the opened gut", COULOMB_DIAMETER_MM, "mm"),
            FindingNumber("diameter of the relaxation dummy", PAPER_CAPSULE.diameter_mm, "mm"),
            FindingNumber("gap all round", 1e3 * gap, "µm"),
            FindingNumber("hoop strain of the opened gut", 100 * stretch, "%"),
        ),
        f"If the opening is the same in both tests, there is a gap of {rounded(1e3 * gap, 2)} µm all round that the "
        "asperities have to bridge; their height is not given. By Eq. 5 the wall is stretched by "
        f"{100 * stretch:.0f} % before it is sheared, while on the capsule that strain is reached only at the "
        "equator.",
        "The simulated dummy sticks, and its area is the cylinder π · 12.9 mm · 15.2 mm, as model and run files say.",
    )


def _paper_contact() -> HemisphereContact:
    return HemisphereContact.of(PAPER_CAPSULE, WALL_THICKNESS_MM, PAPER_MODEL)


def _inner_radius() -> float:
    contact = _paper_contact()
    return contact.radius_mm * float(np.cos(contact.angle_rad))


def _thick_wall() -> PaperFinding:
    undisturbed = WALL_THICKNESS_MM / _inner_radius()
    equator = WALL_THICKNESS_MM / _paper_contact().radius_mm
    return PaperFinding(
        "thick-wall",
        "The formula of a thin wall is used for a thick one",
        "Eqs. 2 and 7",
        "Hoop stress and pressure are related by P = 2 λ τ / D.",
        (
            FindingNumber("thickness over radius, undisturbed", undisturbed),
            FindingNumber("thickness over radius, at the equator", equator),
        ),
        "That holds for a wall much thinner than its radius, usually up to a tenth of it. Here the wall measures "
        f"{rounded(undisturbed, 2)} of the inner radius where the contact begins and {rounded(equator, 2)} at the "
        "equator.",
        "P is computed as printed.",
    )


def _constant_thickness() -> PaperFinding:
    inner, radius = _inner_radius(), _paper_contact().radius_mm
    section = (inner + WALL_THICKNESS_MM) ** 2 - inner**2
    thinned = float(np.sqrt(radius**2 + section)) - radius
    return PaperFinding(
        "constant-thickness",
        "An incompressible wall is stretched and does not get thinner",
        "Section 2.1.1, Eqs. 2 and 7",
        "The wall is assumed incompressible, and λ is the same 2.5 mm at every strain.",
        (
            FindingNumber("thickness used", WALL_THICKNESS_MM, "mm"),
            FindingNumber("thickness at the equator at constant cross-section", thinned, "mm"),
            FindingNumber("difference in P(L)", 100 * (thinned / WALL_THICKNESS_MM - 1), "%", 2),
        ),
        f"A gut that keeps its cross-section while it is stretched over the capsule is {rounded(thinned)} mm thick "
        f"at the equator, which changes the pressure there by {percent(thinned / WALL_THICKNESS_MM - 1)}.",
        "λ is the specimen's wall_thickness_mm, the same everywhere, as printed.",
    )


def _two_capsules() -> PaperFinding:
    wide = PAPER_CAPSULE.model_copy(update={"diameter_mm": COULOMB_DIAMETER_MM})
    capsules = (PAPER_CAPSULE, wide)
    narrow_mN, wide_mN = (
        float(steady_forces([SPEED_MM_S], PAPER_MODEL, capsule, WALL_THICKNESS_MM).total[0]) for capsule in capsules
    )
    inner = [2 * _inner_radius() * capsule.diameter_mm / PAPER_CAPSULE.diameter_mm for capsule in capsules]
    return PaperFinding(
        "two-capsules",
        "Two capsules, and a gut whose diameter follows them",
        "Sections 3.2 and 3.3, Eq. 5",
        "The dummy of the relaxation test measures 12.9 mm, that of the Coulomb test 13 mm; the gut's undisturbed "
        "diameter is 2 R cos α.",
        (
            FindingNumber("total at 20 mm/s with 12.9 mm", narrow_mN, "mN", 4),
            FindingNumber("total at 20 mm/s with 13 mm", wide_mN, "mN", 4),
            FindingNumber("undisturbed diameter for 12.9 mm", inner[0], "mm"),
            FindingNumber("undisturbed diameter for 13 mm", inner[1], "mm"),
        ),
        f"The size alone matters little ({percent(wide_mN / narrow_mN - 1)} at 20 mm/s). But with a fixed α the gut is "
        f"{inner[0]:.2f} mm wide for one capsule and {inner[1]:.2f} mm for the other: half of the capsule by "
        "definition, not a property of the gut.",
        "Each kind of run has its own capsule (drag and rough 12.9 mm, smooth 13 mm); α belongs to the capsule's file.",
    )


def _side_area() -> PaperFinding:
    contact = _paper_contact()
    strip = 2 * np.pi * contact.radius_mm * PAPER_MODEL.side_contact_mm
    side = float(contact.side_pressure().force(np.array([contact.length_mm / SPEED_MM_S]))[0])
    weight, mu = PAPER_CAPSULE.mass_g * GRAVITY_M_S2, PAPER_MODEL.friction_coefficient
    f_c, f_c_strip = mu * (weight + side), mu * (weight + side * strip / contact.area_mm2)
    return PaperFinding(
        "side-area",
        "The side's pressure acts on the hemisphere's area",
        "Eqs. 8, 12 and 13",
        "The normal force at the capsule's side is P S with the hemisphere's contact surface S; the side pressure "
        "acts on 20 mm behind the equator.",
        (
            FindingNumber("S, the hemisphere's contact", contact.area_mm2, "mm²", 4),
            FindingNumber("the strip of 20 mm beside the capsule", strip, "mm²", 4),
            FindingNumber("f_c at 20 mm/s with S", f_c, "mN"),
            FindingNumber("f_c at 20 mm/s with the strip", f_c_strip, "mN"),
        ),
        f"The strip measures {rounded(strip)} mm², {rounded(strip / contact.area_mm2, 2)} times S = "
        f"{rounded(contact.area_mm2, 4)} mm²; with it Coulomb friction at {SPEED_MM_S:g} mm/s would be "
        f"{rounded(f_c_strip)} mN instead of {rounded(f_c)} mN.",
        "N = m g + P(L) S, as printed.",
    )


def _side_length() -> PaperFinding:
    contact = _paper_contact()
    length, side = contact.length_mm, PAPER_MODEL.side_contact_mm
    force = contact.side_pressure().force
    begin, end = (float(force(np.array([x / SPEED_MM_S]))[0]) for x in (length, length + side))
    slow, quick = side / LOWEST_MM_S, side / HIGHEST_MM_S
    return PaperFinding(
        "side-length",
        "The contact beside the capsule is a length where a time is meant",
        "Section 3.3",
        "For 20 mm behind the equator the radial pressure is taken as at the equator; beyond, it is left out "
        "because the gut needs time to tighten again.",
        (
            FindingNumber("length of the dummy", PAPER_CAPSULE.length_mm, "mm"),
            FindingNumber("contact from its beginning to its end", length + side, "mm"),
            FindingNumber(f"time in the strip at {LOWEST_MM_S:g} mm/s", slow, "s"),
            FindingNumber(f"time in the strip at {HIGHEST_MM_S:g} mm/s", quick, "s"),
            FindingNumber(f"P S where the strip begins, {SPEED_MM_S:g} mm/s", begin, "mN"),
            FindingNumber(f"P S by Eq. 3 where it ends, {SPEED_MM_S:g} mm/s", end, "mN"),
        ),
        f"The wall passes 20 mm in {rounded(slow)} s at {LOWEST_MM_S:g} mm/s and in {rounded(quick, 2)} s at "
        f"{HIGHEST_MM_S:g} mm/s, so that a fixed length is no time. By Eq. 3 it also goes on relaxing there: at "
        f"{SPEED_MM_S:g} mm/s P S falls from {rounded(begin)} to {rounded(end)} mN. And the dummy of the text is "
        f"{PAPER_CAPSULE.length_mm:g} mm long, shorter than the {rounded(length + side)} mm of contact.",
        "The pressure beside the capsule stays as at the equator and ends after side_contact_mm, as printed; it is "
        "in the picture of the skew resistance and in no force.",
    )


CONTACT_POINTS = 20_001


def _strain_along_contact() -> tuple[FloatArray, FloatArray]:
    """Return x on the contact and the hoop strain there, shape `(POINTS,)`."""
    contact = _paper_contact()
    x = np.linspace(0.0, contact.length_mm, CONTACT_POINTS)
    radius = np.sqrt(contact.radius_mm**2 - (contact.length_mm - x) ** 2)
    return x, radius / (contact.radius_mm * np.cos(contact.angle_rad)) - 1


def stress_by_superposition(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] when each branch is integrated along the growing strain, parameters of ε(L)."""
    x, strain = _strain_along_contact()
    wall = model_wall(PAPER_MODEL, float(strain[-1]))
    age = (x[-1] - x) / speed_mm_s
    growth, middle = np.diff(strain), 0.5 * (age[:-1] + age[1:])
    stress = float(wall.E3 * strain[-1])
    for modulus, rate in zip((wall.E1, wall.E2), wall.rates, strict=True):
        stress += float(modulus * (growth @ np.exp(-middle * rate)))
    return stress


def stress_by_eq4(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] by Eq. 4."""
    x, strain = _strain_along_contact()
    wall = model_wall(PAPER_MODEL, float(strain[-1]))
    age = float(x[-1]) / speed_mm_s
    fast, slow = wall.rates
    return float(strain[-1] * (wall.E1 * np.exp(-age * fast) + wall.E2 * np.exp(-age * slow) + wall.E3))


def _strain_history() -> PaperFinding:
    speeds = (LOWEST_MM_S, SPEED_MM_S, HIGHEST_MM_S)
    numbers, ratios = [], []
    for speed in speeds:
        published, integrated = stress_by_eq4(speed), stress_by_superposition(speed)
        ratios.append(integrated / published - 1)
        numbers += [
            FindingNumber(f"stress at the equator by Eq. 4, {speed:g} mm/s", published, "kPa"),
            FindingNumber(f"the same elements along the strain's history, {speed:g} mm/s", integrated, "kPa"),
        ]
    by_speed = ", ".join(f"{percent(ratio)} at {speed:g} mm/s" for ratio, speed in zip(ratios, speeds, strict=True))
    return PaperFinding(
        "strain-history",
        "A growing strain is treated as a step",
        "Eqs. 3 and 4",
        "Eq. 3 holds for a strain applied at once; Eq. 4 puts t = x / v into it for wall whose strain grows from 0 "
        "to ε(x) on its way.",
        tuple(numbers),
        "Eq. 4 lets all of the strain relax since the first touch, though part of it came later. Integrating the "
        f"same elements along the path raises the stress at the equator by {by_speed}.",
        "The simulator follows Eq. 4, with the contact age in place of x / v; relaxation runs are integrated "
        "through their ramp.",
    )


def _pointwise() -> PaperFinding:
    contact = _paper_contact()
    x, _ = _strain_along_contact()
    point = contact.pressure(x, x / SPEED_MM_S) * contact.area_mm2 * (contact.length_mm - x) / contact.radius_mm
    top = int(point.argmax())
    f_e = float(steady_forces([SPEED_MM_S], PAPER_MODEL, PAPER_CAPSULE, WALL_THICKNESS_MM).f_e[0])
    return PaperFinding(
        "pointwise",
        "Eq. 9 is a different force at every point",
        "Eq. 9",
        "The environmental resistance is P(x) S sin θ; which x is meant is not said.",
        (
            FindingNumber(f"largest P S sin θ, {SPEED_MM_S:g} mm/s", float(point[top]), "mN", 4),
            FindingNumber("where", float(x[top]), "mm"),
            FindingNumber("P S sin θ at the equator", float(point[-1]), "mN"),
            FindingNumber("mean of P S sin θ over the contact", float(np.trapezoid(point, x) / x[-1]), "mN"),
            FindingNumber("integral of P sin θ over the surface", f_e, "mN"),
        ),
        f"At {SPEED_MM_S:g} mm/s it is {rounded(point[top])} mN at x = {rounded(x[top], 2)} mm and 0 at the equator. "
        "Since S = 2 π R L, its mean over x is exactly the integral of the pressure's axial part over the contact, "
        f"{rounded(f_e)} mN.",
        "f_e is the integral; the pointwise curve P(x) S is drawn in Fig. 7.",
    )


def _pressure_maximum() -> PaperFinding:
    speeds = np.geomspace(LOWEST_MM_S, HIGHEST_MM_S, 200)
    at = steady_forces(speeds, PAPER_MODEL, PAPER_CAPSULE, WALL_THICKNESS_MM).x_of_max_skew
    length = _paper_contact().length_mm
    constant = model_wall(PAPER_MODEL, 0.5)
    where = {
        "moduli that fall with strain, no relaxation": _position_of_maximum(
            lambda strain: model_wall(PAPER_MODEL, strain), np.inf
        ),
        "moduli that fall with strain, fully relaxed": _position_of_maximum(
            lambda strain: model_wall(PAPER_MODEL, strain), 0.0
        ),
        "constant moduli, no relaxation": _position_of_maximum(lambda _: constant, np.inf),
        "constant moduli, fully relaxed": _position_of_maximum(lambda _: constant, 0.0),
        f"constant moduli, relaxing at {SPEED_MM_S:g} mm/s": _position_of_maximum(lambda _: constant, SPEED_MM_S),
    }
    fresh, relaxed, *_, aged = where.values()
    return PaperFinding(
        "maximum",
        "The skew resistance peaks inside the contact, for another reason than given",
        "Section 3.3, Fig. 7, Eqs. 4 and 7",
        "The maximum lies before the point of largest strain; the strain rate's influence on the stress is named as "
        "the reason.",
        (
            FindingNumber("contact length L, where the strain is largest", length, "mm"),
            FindingNumber(f"nearest maximum, {LOWEST_MM_S:g} … {HIGHEST_MM_S:g} mm/s", float(at.min()), "mm"),
            FindingNumber(f"farthest maximum, {LOWEST_MM_S:g} … {HIGHEST_MM_S:g} mm/s", float(at.max()), "mm"),
            *(FindingNumber(f"x of the maximum: {case}", value, "mm") for case, value in where.items()),
        ),
        f"It lies at {rounded(at.min(), 2)} to {rounded(at.max(), 2)} mm of {rounded(length)} mm. No strain rate "
        "enters Eqs. 4 and 7; two other things bring the maximum forward. The moduli fall with strain: this alone "
        f"moves it to {rounded(relaxed)} mm in relaxed wall (in fresh wall it stays at {rounded(fresh)} mm). And "
        "wall further back has been relaxing for longer: with constant moduli this alone moves it to "
        f"{rounded(aged)} mm at {SPEED_MM_S:g} mm/s.",
        "The curve and its maximum are computed for any speed, and drawn.",
    )


def _position_of_maximum(wall: Callable[[FloatArray], WallParameters], speed_mm_s: float) -> float:
    """Return the x at which P is largest; a speed of 0 is relaxed wall, an infinite one fresh wall."""
    x, strain = _strain_along_contact()
    moduli = wall(strain)
    fast, slow = moduli.rates
    age = np.full_like(x, np.inf) if speed_mm_s == 0 else x / speed_mm_s
    stress = strain * (moduli.E1 * np.exp(-age * fast) + moduli.E2 * np.exp(-age * slow) + moduli.E3)
    return float(x[(stress / (1 + strain)).argmax()])


DENSITY_G_MM3 = 1.0e-3
"""Of soft tissue, close to water's."""


def inertial_pressure(x_mm: FloatArray, speed_mm_s: float) -> FloatArray:
    """Pressure [kPa] that the wall's inertia takes off the contact at x, at constant speed.

    The wall follows r(x), so that its acceleration is v² r″ with r″ = −R² / r³; all of its thickness is taken
    to move so.
    """
    contact = _paper_contact()
    radius = np.sqrt(contact.radius_mm**2 - (contact.length_mm - x_mm) ** 2)
    # g/mm³ · mm · mm/s² is 1e-6 N/mm², and a kPa is 1e-3 N/mm².
    return np.asarray(1e-3 * DENSITY_G_MM3 * WALL_THICKNESS_MM * speed_mm_s**2 * contact.radius_mm**2 / radius**3)


def _inertia() -> PaperFinding:
    x = np.linspace(0.0, _paper_contact().length_mm, 200_001)
    pressure = _paper_contact().pressure(x, x / HIGHEST_MM_S)
    inertial = inertial_pressure(x, HIGHEST_MM_S)
    lifted = float(x[int((pressure > inertial).argmax())])
    most, contact = 1e3 * float(inertial.max()), 1e3 * float(pressure.max())
    slower = 1e3 * float(inertial_pressure(x, BOUNDARY_MM_S).max())
    return PaperFinding(
        "inertia",
        "The wall's inertia is too small to let go of the capsule",
        "Section 4",
        "Above the boundary the wall is suspected not to follow the capsule's shape, because of a larger inertia.",
        (
            FindingNumber(f"most that inertia takes off at {BOUNDARY_MM_S:g} mm/s", slower, "Pa"),
            FindingNumber(f"most that inertia takes off at {HIGHEST_MM_S:g} mm/s", most, "Pa"),
            FindingNumber(f"largest contact pressure at {HIGHEST_MM_S:g} mm/s", contact, "Pa", 4),
            FindingNumber("their ratio", 100 * most / contact, "%", 2),
            FindingNumber(f"stretch of x in which inertia is larger, {HIGHEST_MM_S:g} mm/s", 1e3 * lifted, "µm", 2),
        ),
        f"Where 2.5 mm of tissue (1 g/cm³) follow the hemisphere at {HIGHEST_MM_S:g} mm/s, inertia takes at most "
        f"{rounded(most, 2)} Pa off a contact pressure of up to {rounded(contact)} Pa, and more than there is only "
        f"in the first {rounded(1e3 * lifted, 2)} µm. A wall that is slow because of its viscosity is another matter.",
        "The model has no inertia of the wall.",
    )


def _model_speeds() -> PaperFinding:
    contact = _paper_contact()
    wall = model_wall(PAPER_MODEL, contact.strain_at_equator)
    fast, slow = (float(rate) * contact.length_mm for rate in wall.rates)
    return PaperFinding(
        "boundary",
        "The model has speeds of its own, and 20 mm/s is none of them",
        "Section 4",
        f"Whether the boundary near {BOUNDARY_MM_S:g} mm/s is sharp, and whether it belongs to the material, is left "
        "open.",
        (
            FindingNumber("L E2/η2 at the equator", slow, "mm/s", 2),
            FindingNumber("L E1/η1 at the equator", fast, "mm/s", 2),
        ),
        f"The wall's branches stop relaxing under the hemisphere around {rounded(slow, 2)} and {rounded(fast, 2)} "
        "mm/s (contact length over time constant). Between them the model changes smoothly; a boundary near 20 mm/s "
        "would be something that it does not hold.",
        "A boundary is estimated from the runs with the speeds that they do not exclude, and only if they show one.",
    )


WALL_FINDINGS: Final = (
    _eq14_against_table1,
    _damper_unit,
    _stress_falls,
    _shear_as_hoop,
    _strain_range,
    _ramp_as_step,
    _fixture_gap,
    _thick_wall,
    _constant_thickness,
    _two_capsules,
    _side_area,
    _side_length,
    _strain_history,
    _pointwise,
    _pressure_maximum,
)
HIGH_SPEED_FINDINGS: Final = (_inertia, _model_speeds)
