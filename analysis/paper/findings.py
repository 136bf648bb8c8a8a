"""All findings about the paper: each of `findings.toml`, with the values that its function computes from the model.

The file holds the words for a reader; a function here returns the values that its sentences and numbers name.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import sqrt
from pathlib import Path

import numpy as np

from dragrig.analysis import (
    EstimatedQuantity,
    RelaxationResult,
    join_names,
    r2_eq15,
    significant_text,
    squared_correlation,
)
from dragrig.analysis.paper import published as printed
from dragrig.analysis.paper.published import FindingNumber, PaperFinding
from dragrig.config import Capsule, FrictionModelSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import (
    GRAVITY_M_S2,
    TABLE1,
    TABLE1_STRAIN,
    HemisphereContact,
    ParameterSetDifference,
    SteadyFriction,
    WallParameters,
    model_wall,
    parameter_set_differences,
    steady_forces,
    viscous_force,
    wall_parameters,
)

FINDINGS_FILE = Path(__file__).with_name("findings.toml")
ENDS_MM_S = (printed.LOWEST_MM_S, printed.HIGHEST_MM_S)
SPEED_MM_S = 20.0
"""Speed of the examples."""
RAMP_MM_S = 20.0
"""Speed of the ramp in the shipped plan; the paper prints none."""
MIN_STRESS_SHARE = 0.9
"""Share of the fast branch's stress that a good step keeps."""
CONTACT_POINTS = 20_001
DENSITY_G_MM3 = 1.0e-3
"""Of soft tissue, close to water's."""
SAME_STRAIN_TOLERANCE = 0.02
"""Largest difference of strains that count as equal."""

CONSTANTS = {
    "lowest": printed.LOWEST_MM_S,
    "highest": printed.HIGHEST_MM_S,
    "boundary": printed.BOUNDARY_MM_S,
    "speed": SPEED_MM_S,
    "ramp": RAMP_MM_S,
    "least": 100 * MIN_STRESS_SHARE,
    "accuracy": printed.SENSOR_ACCURACY_MN,
    "r2_below": printed.R2_BELOW,
    "r2_above": printed.R2_ABOVE,
}
"""What every finding may name besides its own values."""

Values = Mapping[str, float | str | Mapping[str, float]]
"""What a finding names: numbers, words, or numbers by label."""


class _Value(float):
    """A number in a sentence: rounded to three significant digits, or as the format says."""

    def __format__(self, spec: str) -> str:
        if spec[-1:].isalpha():
            return super().__format__(spec)
        sign = "+" if spec.startswith("+") and self > 0 else ""
        return sign + significant_text(self, int(spec.removeprefix("+") or 3))


@cache
def all_findings() -> tuple[PaperFinding, ...]:
    """Compute all findings, by the model as printed."""
    described = tomllib.loads(FINDINGS_FILE.read_text("utf-8"))["finding"]
    return tuple(_finding(FINDINGS[description["key"]](), **description) for description in described)


def _finding(values: Values, numbers: Sequence[Sequence[str]], key: str, **texts: str) -> PaperFinding:
    words = {
        name: _Value(value) if isinstance(value, float) else value for name, value in (CONSTANTS | {**values}).items()
    }
    computed = []
    for name, quantity, unit, *form in numbers:
        value, spec = values[name], form[0] if form else "3"
        digits, signed = int(spec.removeprefix("+")), spec.startswith("+")
        for label, number in value.items() if isinstance(value, Mapping) else [("", value)]:
            computed.append(FindingNumber(quantity.format(label, **words), float(number), unit, digits, signed))
    sentences = {name: text.format_map(words) for name, text in texts.items()}
    return PaperFinding(key=key, numbers=tuple(computed), **sentences)


def _steady_forces(
    *speeds_mm_s: float, viscous: str = printed.PAPER_MODEL.viscous, capsule: Capsule = printed.PAPER_CAPSULE
) -> SteadyFriction:
    model = printed.PAPER_MODEL.model_copy(update={"viscous": viscous})
    return steady_forces(speeds_mm_s, model, capsule, printed.WALL_THICKNESS_MM)


def _contact(
    capsule: Capsule = printed.PAPER_CAPSULE, model: FrictionModelSettings = printed.PAPER_MODEL
) -> HemisphereContact:
    return HemisphereContact.of(capsule, printed.WALL_THICKNESS_MM, model)


def _inner_radius() -> float:
    """Undisturbed radius of the gut for the dummy [mm], R cos α."""
    return _contact().radius_mm * float(np.cos(_contact().angle_rad))


# The wall's parameters and the relaxation test.


def _eq14_against_table1() -> Values:
    eq14, quadratic = dict[str, float](), dict[str, float]()
    for row in parameter_set_differences():
        name = printed.ELEMENT_SYMBOLS[row.parameter]
        for largest, miss in ((eq14, 100 * row.eq14_difference), (quadratic, 100 * row.quadratic_difference)):
            largest[name] = max(largest.get(name, 0.0), miss, key=abs)
    return {
        "eq14": eq14,
        "quadratic": quadratic,
        "misses": ", ".join(f"{name} {_Value(miss):+2} %" for name, miss in eq14.items()),
        "quadratic_sizes": join_names([significant_text(abs(miss), 2) for miss in quadratic.values()]),
    }


def _damper_unit() -> Values:
    table = np.array(TABLE1)
    fast, slow = 1e3 * table[3] / table[0], 1e3 * table[4] / table[1]
    return {"fast_min": fast.min(), "fast_max": fast.max(), "slow_min": slow.min(), "slow_max": slow.max()}


def _stress_falls() -> Values:
    table, strain = np.array(TABLE1), np.array(TABLE1_STRAIN)
    values: dict[str, float | str | Mapping[str, float]] = {}
    for name, stress in (("at_once", strain * table[:3].sum(axis=0)), ("at_last", strain * table[2])):
        values[name] = {f"{100 * eps:g}": value for eps, value in zip(strain, stress, strict=True)}
        values[f"{name}_list"] = join_names([significant_text(value) for value in stress])
        values[f"rise_{name}"] = 100 * (stress[-1] / stress[-2] - 1)
    return values


def _shear_as_hoop() -> Values:
    f_e = float(_steady_forces(SPEED_MM_S).f_e[0])
    return {"f_e": f_e, "tripled": 3 * f_e}


def _strain_range() -> Values:
    contact = _contact()
    radius, length = contact.radius_mm, contact.length_mm
    x_first = length - float(np.sqrt(radius**2 - ((1 + min(TABLE1_STRAIN)) * _inner_radius()) ** 2))
    x = np.linspace(0.0, length, CONTACT_POINTS)
    load = contact.axial_load(x, x / SPEED_MM_S)
    below = x <= x_first
    return {
        "at_equator": 100 * contact.strain_at_equator,
        "largest": 100 * max(TABLE1_STRAIN),
        "angle": np.degrees(np.arccos(1 / (1 + max(TABLE1_STRAIN)))),
        "x_first": x_first,
        "part": 100 * x_first / length,
        "share": 100 * np.trapezoid(load[below], x[below]) / np.trapezoid(load, x),
        "eta1_eq14": float(wall_parameters("eq14", 0.0).eta1),
        "eta1_quadratic": float(wall_parameters("table1", 0.0).eta1),
    }


def _ramp_as_step() -> Values:
    from scipy.optimize import brentq

    strain, table = np.array(TABLE1_STRAIN), np.array(TABLE1)
    travel, time = strain * printed.WALL_THICKNESS_MM, table[3] / table[0]
    lengths = travel / RAMP_MM_S / time
    left = -100 * np.expm1(-lengths) / lengths
    short = float(brentq(lambda length: -np.expm1(-length) / length - MIN_STRESS_SHARE, 1e-6, 10.0))
    needed = travel / (short * time)
    return {
        "travel_first": travel[0],
        "travel_last": travel[-1],
        "left_first": left[0],
        "left_last": left[-1],
        "slowest": needed.min(),
        "fastest": needed.max(),
        "time_min": 1e3 * time.min(),
        "time_max": 1e3 * time.max(),
    }


def _fixture_gap() -> Values:
    return {
        "opened": printed.COULOMB_DIAMETER_MM,
        "dummy": printed.PAPER_CAPSULE.diameter_mm,
        "gap": 1e3 * 0.5 * (printed.COULOMB_DIAMETER_MM - printed.PAPER_CAPSULE.diameter_mm),
        "stretch": 100 * (printed.COULOMB_DIAMETER_MM / (2 * _inner_radius()) - 1),
    }


# The contact and its pressure.


def _thick_wall() -> Values:
    return {
        "undisturbed": printed.WALL_THICKNESS_MM / _inner_radius(),
        "equator": printed.WALL_THICKNESS_MM / _contact().radius_mm,
    }


def _constant_thickness() -> Values:
    inner, radius = _inner_radius(), _contact().radius_mm
    section = (inner + printed.WALL_THICKNESS_MM) ** 2 - inner**2
    thinned = float(np.sqrt(radius**2 + section)) - radius
    difference = 100 * (thinned / printed.WALL_THICKNESS_MM - 1)
    return {"thickness": printed.WALL_THICKNESS_MM, "thinned": thinned, "difference": difference}


def _two_capsules() -> Values:
    capsules = (
        printed.PAPER_CAPSULE,
        printed.PAPER_CAPSULE.model_copy(update={"diameter_mm": printed.COULOMB_DIAMETER_MM}),
    )
    narrow, wide = (float(_steady_forces(SPEED_MM_S, capsule=capsule).total[0]) for capsule in capsules)
    gut = [2 * _inner_radius() * capsule.diameter_mm / printed.PAPER_CAPSULE.diameter_mm for capsule in capsules]
    difference = 100 * (wide / narrow - 1)
    return {"narrow": narrow, "wide": wide, "narrow_gut": gut[0], "wide_gut": gut[1], "difference": difference}


def _side_area() -> Values:
    contact = _contact()
    strip = 2 * np.pi * contact.radius_mm * printed.PAPER_MODEL.side_contact_mm
    side = float(_steady_forces(SPEED_MM_S).side_pressure_force[0])
    weight, mu = printed.PAPER_CAPSULE.mass_g * GRAVITY_M_S2, printed.PAPER_MODEL.friction_coefficient
    ratio = strip / contact.area_mm2
    return {
        "area": contact.area_mm2,
        "strip": strip,
        "ratio": ratio,
        "f_c": mu * (weight + side),
        "f_c_strip": mu * (weight + side * ratio),
    }


def _side_length() -> Values:
    contact = _contact()
    ends = np.array([contact.length_mm, contact.length_mm + printed.PAPER_MODEL.side_contact_mm])
    begin, end = contact.side_pressure().force(ends / SPEED_MM_S)
    return {
        "dummy": printed.PAPER_CAPSULE.length_mm,
        "contact": ends[1],
        "slow": printed.PAPER_MODEL.side_contact_mm / printed.LOWEST_MM_S,
        "quick": printed.PAPER_MODEL.side_contact_mm / printed.HIGHEST_MM_S,
        "begin": begin,
        "end": end,
    }


def _strain_along_contact() -> tuple[FloatArray, FloatArray]:
    """Return x on the contact and the hoop strain there, shape `(POINTS,)`."""
    x = np.linspace(0.0, _contact().length_mm, CONTACT_POINTS)
    return x, _contact().strain(x)


def _relaxing_stress(wall: WallParameters, strain: FloatArray, age_s: FloatArray) -> FloatArray:
    """Return the stress [kPa] of a strain that was there at once (Eq. 3)."""
    fast, slow = wall.rates
    return np.asarray(strain * (wall.E1 * np.exp(-age_s * fast) + wall.E2 * np.exp(-age_s * slow) + wall.E3))


def stress_by_superposition(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] when each branch is integrated along the growing strain, parameters of ε(L)."""
    x, strain = _strain_along_contact()
    age = (x[-1] - x) / speed_mm_s
    wall = model_wall(printed.PAPER_MODEL, float(strain[-1]))
    return float(_relaxing_stress(wall, np.diff(strain), 0.5 * (age[:-1] + age[1:])).sum())


def stress_by_eq4(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] by Eq. 4."""
    x, strain = _strain_along_contact()
    return float(_relaxing_stress(model_wall(printed.PAPER_MODEL, strain[-1]), strain[-1], x[-1] / speed_mm_s))


def _strain_history() -> Values:
    stress, raised = dict[str, float](), list[str]()
    for speed in (printed.LOWEST_MM_S, SPEED_MM_S, printed.HIGHEST_MM_S):
        published, integrated = stress_by_eq4(speed), stress_by_superposition(speed)
        stress[f"stress at the equator by Eq. 4, {speed:g}"] = published
        stress[f"the same elements along the strain's history, {speed:g}"] = integrated
        raised.append(f"{_Value(100 * (integrated / published - 1)):+2} % at {speed:g} mm/s")
    return {"stress": stress, "raised": ", ".join(raised)}


def _pointwise() -> Values:
    contact = _contact()
    x = np.linspace(0.0, contact.length_mm, CONTACT_POINTS)
    point = contact.pressure(x, x / SPEED_MM_S) * contact.area_mm2 * (contact.length_mm - x) / contact.radius_mm
    return {
        "largest": point.max(),
        "x": x[point.argmax()],
        "equator": point[-1],
        "mean": np.trapezoid(point, x) / x[-1],
        "f_e": float(_steady_forces(SPEED_MM_S).f_e[0]),
    }


def _pressure_maximum() -> Values:
    at = _steady_forces(*np.geomspace(printed.LOWEST_MM_S, printed.HIGHEST_MM_S, 200)).x_of_max_skew
    x, strain = _strain_along_contact()
    falling, constant = model_wall(printed.PAPER_MODEL, strain), model_wall(printed.PAPER_MODEL, 0.5)
    fresh, relaxed, aged = np.zeros_like(x), np.full_like(x, np.inf), x / SPEED_MM_S

    def position(wall: WallParameters, age_s: FloatArray) -> float:
        return float(x[(_relaxing_stress(wall, strain, age_s) / (1 + strain)).argmax()])

    return {
        "length": _contact().length_mm,
        "nearest": at.min(),
        "farthest": at.max(),
        "fresh": position(falling, fresh),
        "relaxed": position(falling, relaxed),
        "constant_fresh": position(constant, fresh),
        "constant_relaxed": position(constant, relaxed),
        "constant_aged": position(constant, aged),
    }


# Friction.


def _dimension() -> Values:
    published, newtonian = (_steady_forces(*ENDS_MM_S, viscous=reading) for reading in ("published", "newtonian"))
    return {
        "slow": published.f_v[0],
        "quick": published.f_v[1],
        "newtonian_slow": newtonian.f_v[0],
        "newtonian_quick": newtonian.f_v[1],
        "share": 100 * (published.f_v[1] / published.total[1]),
        "newtonian_share": 100 * (newtonian.f_v[1] / newtonian.total[1]),
    }


def _lubrication() -> Values:
    forces, mu = _steady_forces(SPEED_MM_S), printed.PAPER_MODEL.friction_coefficient
    film = float(forces.f_v[0]) / (printed.PAPER_CAPSULE.mass_g * GRAVITY_M_S2 + float(forces.side_pressure_force[0]))
    return {"film": film, "mu": mu, "ratio": mu / film}


def _weight() -> Values:
    forces = _steady_forces(SPEED_MM_S)
    side = float(forces.side_pressure_force[0])
    return {
        "weight": printed.PAPER_CAPSULE.mass_g * GRAVITY_M_S2,
        "side": side,
        "without": printed.PAPER_MODEL.friction_coefficient * side,
        "f_c": forces.f_c[0],
    }


def _coulomb_and_speed() -> Values:
    forces = _steady_forces(*ENDS_MM_S)
    f_c, f_v, f_e = (float(part[1] - part[0]) for part in (forces.f_c, forces.f_v, forces.f_e))
    return {"f_c": f_c, "f_v": f_v, "f_e": f_e, "relative": 100 * (f_c / float(forces.f_c[0]))}


def _major_share() -> Values:
    from scipy.optimize import brentq

    forces = _steady_forces(*ENDS_MM_S)
    slow, quick = 100 * (forces.f_e / forces.total)

    def ahead(speed: float) -> float:
        there = _steady_forces(speed)
        return float(there.f_e[0] - there.f_c[0])

    return {"slow": slow, "quick": quick, "equal": float(brentq(ahead, *ENDS_MM_S))}


def _logarithm() -> Values:
    total, log_speed = model_forces(np.array(printed.SPEEDS_MM_S)), np.log(printed.SPEEDS_MM_S)
    slope, intercept = np.polyfit(log_speed, total, 1)
    miss = total - (intercept + slope * log_speed)
    slow, above_slow, below_quick, quick = _steady_forces(
        printed.LOWEST_MM_S, 1.01 * printed.LOWEST_MM_S, printed.HIGHEST_MM_S / 1.01, printed.HIGHEST_MM_S
    ).total
    return {
        "slope": slope,
        "intercept": intercept,
        "r2": 1 - float(miss @ miss) / float(((total - total.mean()) ** 2).sum()),
        "worst": np.abs(miss).max(),
        "slope_slow": (above_slow - slow) / np.log(1.01),
        "slope_quick": (quick - below_quick) / np.log(1.01),
    }


def coulomb_weight_mN() -> float:
    """Weight of the Coulomb test's capsule."""
    return printed.COULOMB_MASS_G * GRAVITY_M_S2


def coulomb_viscous_mN(reading: str = "published") -> float:
    """Viscous friction of the Coulomb test by Eqs. 10 and 11; `newtonian` is the other reading."""
    model = printed.PAPER_MODEL.model_copy(update={"viscous": reading})
    area = _contact(
        printed.PAPER_CAPSULE.model_copy(update={"diameter_mm": printed.COULOMB_DIAMETER_MM}), model
    ).area_mm2
    return float(viscous_force(np.array(printed.COULOMB_SPEED_MM_S), model, area))


def coulomb_coefficient(viscous_part_mN: float = 0.0) -> float:
    """Friction coefficient from the printed force with a viscous part taken off."""
    return (printed.COULOMB_FORCE_MN - viscous_part_mN) / coulomb_weight_mN()


def _coefficient() -> Values:
    whole, published = coulomb_coefficient(), coulomb_coefficient(coulomb_viscous_mN())
    return {
        "weight": coulomb_weight_mN(),
        "whole": whole,
        "f_v": coulomb_viscous_mN(),
        "published": published,
        "newtonian": coulomb_coefficient(coulomb_viscous_mN("newtonian")),
        "difference": 100 * (published / whole - 1),
    }


def _not_returned() -> Values:
    f_c, f_v = printed.FRICTION_COEFFICIENT * coulomb_weight_mN(), coulomb_viscous_mN()
    excess = 100 * (f_c + f_v) / printed.COULOMB_FORCE_MN - 100
    return {"f_c": f_c, "f_v": f_v, "force": f_c + f_v, "printed": printed.COULOMB_FORCE_MN, "excess": excess}


def _accuracy() -> Values:
    from scipy.optimize import brentq

    total = model_forces(np.array(printed.SPEEDS_MM_S))
    within = int(np.searchsorted(total - total[0], printed.SENSOR_ACCURACY_MN))
    spans = (f"{low:g} to {high:g}" for low, high in pairwise(printed.SPEEDS_MM_S))

    def lacking(speed: float) -> float:
        return float(viscous_force(np.array(speed), printed.PAPER_MODEL, 1.0)) - printed.SENSOR_ACCURACY_MN

    return {
        "over_force": 100 * printed.SENSOR_ACCURACY_MN / printed.COULOMB_FORCE_MN,
        "as_mu": printed.SENSOR_ACCURACY_MN / coulomb_weight_mN(),
        "f_v": coulomb_viscous_mN(),
        "enough": float(brentq(lacking, 1e-3, 1e3)),
        "steps": dict(zip(spans, np.diff(total), strict=True)),
        "slowest": " and ".join(f"{speed:g}" for speed in printed.SPEEDS_MM_S[:within]),
    }


# R² (Eq. 15).


@dataclass(frozen=True, slots=True)
class DeterminationExample:
    """Both forms of R² of made-up measurements beside the model's forces at the same speeds."""

    name: str
    eq15: float
    correlation: float


def band_speeds(above: bool) -> FloatArray:
    """Return the programme's speeds above the paper's boundary, or up to it [mm/s]."""
    speeds = np.array(printed.SPEEDS_MM_S)
    return np.asarray(speeds[(speeds > printed.BOUNDARY_MM_S) == above])


def model_forces(speeds_mm_s: FloatArray) -> FloatArray:
    """Return the model's steady force [mN]."""
    return _steady_forces(*speeds_mm_s).total


def determination_examples() -> tuple[DeterminationExample, ...]:
    """Return measurements made up around the model's forces above the boundary."""
    model = model_forces(band_speeds(above=True))
    mean = model.mean()
    made_up = {
        "half as steep": mean + (model - mean) / 2,
        "mirrored: falls where the model rises": 2 * mean - model,
        "shifted by 5 mN": model + printed.SENSOR_ACCURACY_MN,
        f"shifted so far that Eq. 15 gives {printed.R2_ABOVE:g}": model + offset_for_r2(printed.R2_ABOVE, model),
    }
    return tuple(
        DeterminationExample(name, r2_eq15(model, forces) or 0.0, squared_correlation(model, forces) or 0.0)
        for name, forces in made_up.items()
    )


def offset_for_r2(r2: float, model: FloatArray) -> float:
    """Return the constant difference [mN] between model and measurement that alone makes Eq. 15 this R²."""
    return float(model.std()) * sqrt(1 / r2 - 1)


def _no_correlation() -> Values:
    examples = determination_examples()
    r2: dict[str, float] = {}
    for example in examples:
        r2[f"Eq. 15, {example.name}"] = example.eq15
        r2[f"squared correlation, {example.name}"] = example.correlation
    flat, mirrored = examples[:2]
    return {"r2": r2, "flat": flat.eq15, "mirrored": mirrored.eq15, "correlation": flat.correlation}


def _offset() -> Values:
    below, above = (model_forces(band_speeds(above=is_above)) for is_above in (False, True))
    low, high = offset_for_r2(printed.R2_BELOW, below), offset_for_r2(printed.R2_ABOVE, above)
    return {
        "spread_below": below.std(),
        "spread_above": above.std(),
        "low": low,
        "high": high,
        "same": 1 / (1 + (low / float(above.std())) ** 2),
        "relative": 100 * high / float(above.mean()),
    }


# Speeds above the boundary.


def inertial_pressure(x_mm: FloatArray, speed_mm_s: float) -> FloatArray:
    """Pressure [kPa] that the wall's inertia takes off the contact at x, at constant speed.

    The wall follows r(x), so that its acceleration is v² r″ with r″ = −R² / r³; all of its thickness is taken
    to move so.
    """
    contact = _contact()
    curvature = contact.radius_mm**2 / contact.local_radius(x_mm) ** 3
    # g/mm³ · mm · mm/s² is 1e-6 N/mm², and a kPa is 1e-3 N/mm².
    return np.asarray(1e-3 * DENSITY_G_MM3 * printed.WALL_THICKNESS_MM * speed_mm_s**2 * curvature)


def _inertia() -> Values:
    x = np.linspace(0.0, _contact().length_mm, 200_001)
    pressure, inertial = _contact().pressure(x, x / printed.HIGHEST_MM_S), inertial_pressure(x, printed.HIGHEST_MM_S)
    most, contact = 1e3 * float(inertial.max()), 1e3 * float(pressure.max())
    return {
        "slower": 1e3 * inertial_pressure(x, printed.BOUNDARY_MM_S).max(),
        "most": most,
        "contact": contact,
        "ratio": 100 * most / contact,
        "lifted": 1e3 * x[(pressure > inertial).argmax()],
    }


def _model_speeds() -> Values:
    contact = _contact()
    fast, slow = model_wall(printed.PAPER_MODEL, contact.strain_at_equator).rates
    return {"slow": float(slow) * contact.length_mm, "fast": float(fast) * contact.length_mm}


FINDINGS: Mapping[str, Callable[[], Values]] = {
    "eq14-table1": _eq14_against_table1,
    "eta-unit": _damper_unit,
    "stress-falls": _stress_falls,
    "shear-as-hoop": _shear_as_hoop,
    "strain-range": _strain_range,
    "ramp": _ramp_as_step,
    "fixture-gap": _fixture_gap,
    "thick-wall": _thick_wall,
    "constant-thickness": _constant_thickness,
    "two-capsules": _two_capsules,
    "side-area": _side_area,
    "side-length": _side_length,
    "strain-history": _strain_history,
    "pointwise": _pointwise,
    "maximum": _pressure_maximum,
    "viscous-dimension": _dimension,
    "lubrication": _lubrication,
    "weight": _weight,
    "coulomb-speed": _coulomb_and_speed,
    "major-share": _major_share,
    "logarithm": _logarithm,
    "coefficient": _coefficient,
    "not-returned": _not_returned,
    "accuracy": _accuracy,
    "eq15": _no_correlation,
    "offset": _offset,
    "inertia": _inertia,
    "boundary": _model_speeds,
}
"""What computes the values of each finding, by its key."""


# Table 1 beside identified elements.


@dataclass(frozen=True, slots=True)
class ElementRow:
    """One element at one of Table 1's strains."""

    published: ParameterSetDifference
    """Table 1's entry, the values of Eq. 14 and of the quadratic, and their differences from the entry."""
    identified: EstimatedQuantity | None
    """From a relaxation; None where there is none at that strain, or it supports none."""
    simulated: float
    """The element that the run was simulated with, its own variation included."""

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return printed.WALL_UNITS[self.published.parameter]

    @property
    def difference(self) -> float | None:
        """Relative difference of the identified from the simulated value."""
        return None if self.identified is None else self.identified.value / self.simulated - 1

    @property
    def difference_from_table1(self) -> float | None:
        """Relative difference of the identified value from Table 1's entry."""
        return None if self.identified is None else self.identified.value / self.published.table1 - 1

    @property
    def inside(self) -> bool | None:
        """Whether the interval holds the simulated value."""
        if self.identified is None:
            return None
        low, high = self.identified.interval
        return low <= self.simulated <= high


def element_rows(
    relaxation: RelaxationResult | None, model: FrictionModelSettings, run_models: Mapping[str, FrictionModelSettings]
) -> tuple[ElementRow, ...]:
    """Compare an identification of simulated relaxations with the published elements.

    Parameters
    ----------
    model
        The simulated model, before a run's own variation.
    run_models
        The model of each run, by its file's name.
    """
    fits = () if relaxation is None else [fit for fit in relaxation.fits if fit.elements]
    order, rows = list(printed.WALL_UNITS), []
    for published in parameter_set_differences():
        near = (fit for fit in fits if abs(fit.shear_strain - published.strain) <= SAME_STRAIN_TOLERANCE)
        fit = next(near, None)
        elements = {} if fit is None else {element.name: element for element in fit.elements}
        wall = model_wall(model if fit is None else run_models.get(fit.file, model), published.strain)
        simulated = float(getattr(wall, published.parameter))
        rows.append(ElementRow(published, elements.get(published.parameter), simulated))
    return tuple(sorted(rows, key=lambda row: (order.index(row.published.parameter), row.published.strain)))
