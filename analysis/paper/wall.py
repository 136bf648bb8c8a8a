"""Findings on the wall's parameters: Table 1, Eq. 14, and the strain they are used at."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, listed, percent, spelled
from dragrig.analysis.paper.printed import CAPSULE, MODEL, WALL_THICKNESS_MM
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import disagreement, steady_forces, wall_parameters
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.wall import TABLE1, TABLE1_STRAIN

SYMBOLS = {"E1": "E1", "E2": "E2", "E3": "E3", "eta1": "η1", "eta2": "η2"}
"""Elements by their name in the model's settings."""
SPEED_MM_S = 20.0
"""Speed of the examples."""


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _polynomial()
    yield _unit()
    yield _stress_falls()
    yield _shear_as_hoop()
    yield _strain_range()


def worst(quadratic: bool = False) -> dict[str, float]:
    """Largest difference from Table 1 of each element, signed: of Eq. 14, or of the quadratic through Table 1."""
    found: dict[str, float] = {}
    for one in disagreement():
        difference = one.quadratic_difference if quadratic else one.eq14_difference
        if abs(difference) > abs(found.get(one.parameter, 0.0)):
            found[one.parameter] = difference
    return found


def _polynomial() -> Finding:
    printed, fitted = worst(), worst(quadratic=True)
    numbers = [
        Number(f"Eq. 14, {SYMBOLS[name]}: largest miss", 100 * value, "%", 2, signed=True)
        for name, value in printed.items()
    ]
    numbers += [
        Number(f"quadratic, {SYMBOLS[name]}: largest miss", 100 * value, "%", 2, signed=True)
        for name, value in fitted.items()
    ]
    misses = ", ".join(f"{SYMBOLS[name]} {percent(value)}" for name, value in printed.items())
    return Finding(
        "eq14-table1",
        "Eq. 14 does not give Table 1",
        "Table 1, Eq. 14",
        "Eq. 14 is introduced as the relation between Table 1's parameters and strain.",
        tuple(numbers),
        f"Its largest misses are {misses}. A least-squares quadratic through the same four points, with as many "
        f"coefficients, stays within {listed((100 * abs(one) for one in fitted.values()), 2)} %.",
        "Both sets can be chosen: wall eq14, which the paper's figures use, and wall table1, the quadratic.",
    )


def _unit() -> Finding:
    fast, slow = _times()
    return Finding(
        "eta-unit",
        "The dampers are given in the unit of a modulus",
        "Table 1, Eqs. 3 and 14",
        "η1 and η2 are printed in kPa.",
        (
            Number("shortest η1/E1", 1e3 * fast.min(), "ms"),
            Number("longest η1/E1", 1e3 * fast.max(), "ms"),
            Number("shortest η2/E2", 1e3 * slow.min(), "ms"),
            Number("longest η2/E2", 1e3 * slow.max(), "ms"),
        ),
        f"With kPa the exponent E t/η of Eq. 3 would have the unit of a time. In kPa·s the time constants are "
        f"{spelled(1e3 * fast.min(), 2)} to {spelled(1e3 * fast.max(), 2)} ms and {spelled(1e3 * slow.min())} to "
        f"{spelled(1e3 * slow.max())} ms.",
        "η is taken in kPa·s everywhere.",
    )


def _times() -> tuple[FloatArray, FloatArray]:
    table = np.array(TABLE1)
    return table[3] / table[0], table[4] / table[1]


def _stress_falls() -> Finding:
    table, strain = np.array(TABLE1), np.array(TABLE1_STRAIN)
    at_once, at_last = strain * table[:3].sum(axis=0), strain * table[2]
    numbers = [
        Number(f"{name} at {100 * eps:g} %", value, "kPa")
        for name, values in (("stress at once", at_once), ("relaxed stress", at_last))
        for eps, value in zip(strain, values, strict=True)
    ]
    return Finding(
        "stress-falls",
        "At 200 % the wall bears less than at 150 %",
        "Table 1, Eq. 3",
        "Table 1 is the outcome of four relaxations on a dummy that does not slip.",
        tuple(numbers),
        f"Right after a step to 50, 100, 150 and 200 % Eq. 3 gives {listed(at_once)} kPa, and "
        f"{listed(at_last)} kPa once relaxed: the last step, larger by a third, meets "
        f"{percent(at_once[-1] / at_once[-2] - 1)} and {percent(at_last[-1] / at_last[-2] - 1)} of stress. Slip, "
        "damage or other pieces of gut would look like this; the text does not say which.",
        "The parameters are used as printed. On a campaign of one's own, the identification gives each strain its own "
        "elements and says whether the relaxation fits them.",
    )


def _shear_as_hoop() -> Finding:
    f_e = float(steady_forces([SPEED_MM_S], MODEL, CAPSULE, WALL_THICKNESS_MM).f_e[0])
    return Finding(
        "shear-as-hoop",
        "Shear moduli are used as hoop moduli",
        "Section 3.2, Eqs. 3, 4 and 7",
        "Table 1 holds shear stress over shear strain (elongation over wall thickness); Eqs. 3 to 7 use it for hoop "
        "stress over hoop strain. The wall is assumed incompressible and isotropic.",
        (
            Number(f"f_e at {SPEED_MM_S:g} mm/s as published", f_e, "mN"),
            Number(f"f_e at {SPEED_MM_S:g} mm/s with E = 3 G", 3 * f_e, "mN"),
        ),
        f"For such a material a stretching modulus is three times the shear modulus (at small strains): f_e at "
        f"{SPEED_MM_S:g} mm/s would be {spelled(3 * f_e)} mN instead of {spelled(f_e)} mN.",
        "The moduli are used as published; what a specimen's own stiffness is, its drags say (stiffness_scale).",
    )


def _strain_range() -> Finding:
    contact = HemisphereContact.of(CAPSULE, WALL_THICKNESS_MM, MODEL)
    radius, length = contact.radius_mm, contact.length_mm
    first = min(TABLE1_STRAIN)
    x_first = length - float(np.sqrt(radius**2 - ((1 + first) * radius * np.cos(contact.angle_rad)) ** 2))
    x = np.linspace(0.0, length, 20_001)
    load = contact.axial_load(x, x / SPEED_MM_S)
    below = x <= x_first
    share = float(np.trapezoid(load[below], x[below]) / np.trapezoid(load, x))
    angle = float(np.degrees(np.arccos(1 / (1 + max(TABLE1_STRAIN)))))
    at_rest = [float(wall_parameters(kind, 0.0).eta1) for kind in ("eq14", "table1")]
    return Finding(
        "strain-range",
        "The strains that were tested are not the strains that are used",
        "Eqs. 5 and 6, Table 1",
        "The relaxations go from 50 to 200 %; the undisturbed diameter is 2 R cos α with α = 60°.",
        (
            Number("largest strain on the contact", 100 * contact.strain_at_equator, "%"),
            Number("largest strain of Table 1", 100 * max(TABLE1_STRAIN), "%"),
            Number("contact angle that would strain to it", angle, "°"),
            Number("x at which the strain reaches 50 %", x_first, "mm"),
            Number("that part of the contact's length", 100 * x_first / length, "%"),
            Number(f"its share of f_e at {SPEED_MM_S:g} mm/s", 100 * share, "%"),
            Number("η1 at no strain by Eq. 14", at_rest[0], "kPa·s"),
            Number("η1 at no strain by the quadratic", at_rest[1], "kPa·s"),
        ),
        f"For α = 60° the strain on the contact goes from 0 to {100 * contact.strain_at_equator:.0f} % and uses two of "
        f"the four strains; 200 % would need α = {spelled(angle)}°. The first {spelled(x_first)} mm, below the "
        "smallest "
        f"strain tested, are extrapolated, and make {spelled(100 * share, 2)} % of f_e at {SPEED_MM_S:g} mm/s.",
        "The polynomials are extrapolated as printed; a contact that leads them to a modulus of zero is refused.",
    )
