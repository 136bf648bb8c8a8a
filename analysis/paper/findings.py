"""All findings in the paper's order, those on friction and R² among them; Table 1 beside identified elements."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import sqrt

import numpy as np

from dragrig.analysis.estimates import EstimatedQuantity
from dragrig.analysis.identification.identification import RelaxationResult
from dragrig.analysis.identification.relaxation_elements import ELEMENT_NAMES, ELEMENT_UNITS
from dragrig.analysis.paper import published as printed
from dragrig.analysis.paper.published import (
    BOUNDARY_MM_S,
    HIGHEST_MM_S,
    LOWEST_MM_S,
    PAPER_CAPSULE,
    PAPER_MODEL,
    R2_ABOVE,
    R2_BELOW,
    SENSOR_ACCURACY_MN,
    SPEEDS_MM_S,
    WALL_THICKNESS_MM,
    FindingNumber,
    PaperFinding,
    percent,
    rounded,
)
from dragrig.analysis.paper.wall_findings import HIGH_SPEED_FINDINGS, WALL_FINDINGS
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import (
    ParameterSetDifference,
    SteadyFriction,
    parameter_set_differences,
    steady_forces,
)
from dragrig.sim_backend.friction.friction_force import GRAVITY_M_S2, viscous_force
from dragrig.sim_backend.friction.wall import HemisphereContact, model_wall

ENDS_MM_S = (LOWEST_MM_S, HIGHEST_MM_S)
SPEED_MM_S = 20.0


def _steady_forces(*speeds_mm_s: float, viscous: str = PAPER_MODEL.viscous) -> SteadyFriction:
    model = PAPER_MODEL.model_copy(update={"viscous": viscous})
    return steady_forces(speeds_mm_s, model, PAPER_CAPSULE, WALL_THICKNESS_MM)


def _dimension() -> PaperFinding:
    published, newtonian = (_steady_forces(*ENDS_MM_S, viscous=reading) for reading in ("published", "newtonian"))
    numbers = [
        FindingNumber(f"f_v read as {name}, {speed:g} mm/s", float(value), "mN")
        for name, forces in (("δ v", published), ("δ (v/d) S", newtonian))
        for speed, value in zip(ENDS_MM_S, forces.f_v, strict=True)
    ]
    share = [float(forces.f_v[-1] / forces.total[-1]) for forces in (published, newtonian)]
    return PaperFinding(
        "viscous-dimension",
        "Eq. 10 is no force if δ is a viscosity",
        "Eqs. 10 and 11",
        "f_v = δ v, with the apparent viscosity δ of mucus against its shear rate v / d.",
        (
            *numbers,
            FindingNumber(f"share of the total at {HIGHEST_MM_S:g} mm/s, δ v", 100 * share[0], "%", 2),
            FindingNumber(f"share of the total at {HIGHEST_MM_S:g} mm/s, δ (v/d) S", 100 * share[1], "%", 2),
        ),
        f"Read with v in mm/s and δ in mN·s/mm it gives {rounded(published.f_v[0], 2)} to "
        f"{rounded(published.f_v[1], 2)} mN, the small share that the text speaks of. With δ in Pa·s the shear "
        f"stress δ v / d on S gives {rounded(newtonian.f_v[0], 2)} to {rounded(newtonian.f_v[1], 2)} mN, "
        f"{rounded(100 * share[1], 2)} % of the total at {HIGHEST_MM_S:g} mm/s.",
        "viscous = published is the default, newtonian the dimensionally consistent reading.",
    )


def _lubrication() -> PaperFinding:
    forces = _steady_forces(SPEED_MM_S)
    normal = PAPER_CAPSULE.mass_g * GRAVITY_M_S2 + float(forces.side_pressure_force[0])
    film = float(forces.f_v[0]) / normal
    return PaperFinding(
        "lubrication",
        "Full lubrication and dry friction at once",
        "Sections 2.2 and 2.3",
        "The capsule is said to be nearly completely lubricated, by a film of 30 µm; Coulomb friction of the villi "
        "is added in full.",
        (
            FindingNumber(f"friction coefficient of the film alone, {SPEED_MM_S:g} mm/s", film, "", 2),
            FindingNumber("friction coefficient used", PAPER_MODEL.friction_coefficient, "", 2),
        ),
        f"The film alone would make a coefficient of {rounded(film, 2)} at {SPEED_MM_S:g} mm/s; the model adds "
        f"{rounded(PAPER_MODEL.friction_coefficient / film, 2)} times as much for the contact that a film excludes.",
        "Both are added, as printed; the joint fit gives each its own scale and says whether the runs separate them.",
    )


def _weight() -> PaperFinding:
    forces = _steady_forces(SPEED_MM_S)
    side, weight = float(forces.side_pressure_force[0]), PAPER_CAPSULE.mass_g * GRAVITY_M_S2
    without = PAPER_MODEL.friction_coefficient * side
    return PaperFinding(
        "weight",
        "The weight is in the text and not in the equation",
        "Section 2.3, Eqs. 12 and 13",
        "N is called a local contact pressure that consists of the weight's normal force and the radial pressure; "
        "Eq. 13 holds the latter alone.",
        (
            FindingNumber("m g", weight, "mN", 4),
            FindingNumber(f"P(L) S at {SPEED_MM_S:g} mm/s", side, "mN", 4),
            FindingNumber("f_c without the weight", without, "mN"),
            FindingNumber("f_c with the weight", float(forces.f_c[0]), "mN"),
        ),
        f"By Eq. 13 alone f_c at {SPEED_MM_S:g} mm/s is {rounded(without)} mN; with the weight it is "
        f"{rounded(forces.f_c[0])} mN. N is a force in both, not a pressure.",
        "N = m g + P(L) S.",
    )


def _coulomb_and_speed() -> PaperFinding:
    forces = _steady_forces(*ENDS_MM_S)
    rise = [float(part[1] - part[0]) for part in (forces.f_c, forces.f_v, forces.f_e)]
    return PaperFinding(
        "coulomb-speed",
        "Coulomb friction depends on speed nearly as much as viscous friction",
        "Section 3.3, Fig. 9, Eqs. 12 and 13",
        "Viscous friction is said to depend on the speed, Coulomb friction hardly.",
        tuple(
            FindingNumber(f"{name} rises from {LOWEST_MM_S:g} to {HIGHEST_MM_S:g} mm/s by", value, "mN")
            for name, value in zip(("f_c", "f_v", "f_e"), rise, strict=True)
        ),
        f"Through P(L) f_c rises by {rounded(rise[0])} mN, {percent(rise[0] / float(forces.f_c[0]))} of itself, from "
        f"{LOWEST_MM_S:g} to {HIGHEST_MM_S:g} mm/s, and f_v by {rounded(rise[1])} mN.",
        "f_c follows the side pressure at its age, at every sample.",
    )


def _major_share() -> PaperFinding:
    from scipy.optimize import brentq

    forces = _steady_forces(*ENDS_MM_S)
    shares = (forces.f_e / forces.total).tolist()

    def ahead(speed: float) -> float:
        there = _steady_forces(speed)
        return float(there.f_e[0] - there.f_c[0])

    equal = float(brentq(ahead, *ENDS_MM_S))
    return PaperFinding(
        "major-share",
        "The environmental resistance is not the largest part everywhere",
        "Section 3.3, Fig. 9",
        "Environmental resistance is said to hold the major share of the friction.",
        (
            FindingNumber(f"share of f_e at {LOWEST_MM_S:g} mm/s", 100 * shares[0], "%", 2),
            FindingNumber(f"share of f_e at {HIGHEST_MM_S:g} mm/s", 100 * shares[1], "%", 2),
            FindingNumber("speed at which f_e = f_c", equal, "mm/s", 2),
        ),
        f"Its share is {rounded(100 * shares[0], 2)} % at {LOWEST_MM_S:g} mm/s and {rounded(100 * shares[1], 2)} % "
        f"at {HIGHEST_MM_S:g} mm/s; below {rounded(equal, 2)} mm/s Coulomb friction is larger.",
        "The parts are given for every speed.",
    )


def _logarithm() -> PaperFinding:
    total = _steady_forces(*SPEEDS_MM_S).total
    log_speed = np.log(SPEEDS_MM_S)
    slope, intercept = np.polyfit(log_speed, total, 1)
    miss = total - (intercept + slope * log_speed)
    r2 = 1 - float(miss @ miss) / float(((total - total.mean()) ** 2).sum())
    near = np.array([LOWEST_MM_S, 1.01 * LOWEST_MM_S, HIGHEST_MM_S / 1.01, HIGHEST_MM_S])
    local = _steady_forces(*near).total
    slopes = [float((local[i + 1] - local[i]) / np.log(1.01)) for i in (0, 2)]
    worst = float(np.abs(miss).max())
    return PaperFinding(
        "logarithm",
        "The sum does not grow as the logarithm of the speed",
        "Section 3.3, Fig. 9",
        "The frictional resistance is said to increase logarithmically with velocity.",
        (
            FindingNumber("slope of the best law a + b ln v", float(slope), "mN"),
            FindingNumber("a at 1 mm/s", float(intercept), "mN"),
            FindingNumber("R² of that law for the model's own curve", r2),
            FindingNumber("its largest miss", worst, "mN"),
            FindingNumber(f"the model's own slope at {LOWEST_MM_S:g} mm/s", slopes[0], "mN", 2),
            FindingNumber(f"the model's own slope at {HIGHEST_MM_S:g} mm/s", slopes[1], "mN", 2),
        ),
        f"The best law {rounded(intercept)} + {rounded(slope)} ln(v / 1 mm/s) mN misses the model's own curve, "
        f"without any noise, by up to {rounded(worst, 2)} mN, more than the sensor's {SENSOR_ACCURACY_MN:g} mN. The "
        f"model's slope against ln v grows from {rounded(slopes[0], 2)} to {rounded(slopes[1], 2)} mN; that of a "
        "logarithm would be constant.",
        "The law is fitted with the chance of its lack of fit beside it, and never taken for the model.",
    )


def coulomb_weight_mN() -> float:
    """Weight of the Coulomb test's capsule."""
    return printed.COULOMB_MASS_G * GRAVITY_M_S2


def coulomb_viscous_mN(reading: str = "published") -> float:
    """Viscous friction of the Coulomb test by Eqs. 10 and 11; `newtonian` is the other reading."""
    model = PAPER_MODEL.model_copy(update={"viscous": reading})
    wide = PAPER_CAPSULE.model_copy(update={"diameter_mm": printed.COULOMB_DIAMETER_MM})
    area = HemisphereContact.of(wide, WALL_THICKNESS_MM, model).area_mm2
    return float(viscous_force(np.array(printed.COULOMB_SPEED_MM_S), model, area))


def coulomb_coefficient(viscous_part_mN: float = 0.0) -> float:
    """Friction coefficient from the printed force with a viscous part taken off."""
    return (printed.COULOMB_FORCE_MN - viscous_part_mN) / coulomb_weight_mN()


def _coefficient_finding() -> PaperFinding:
    whole, published, newtonian = (
        coulomb_coefficient(),
        coulomb_coefficient(coulomb_viscous_mN()),
        coulomb_coefficient(coulomb_viscous_mN("newtonian")),
    )
    return PaperFinding(
        "coefficient",
        "0.082 is rounded, and holds the viscous friction too",
        "Section 3.3, Fig. 8",
        "40.07 mN at 0.5 mm/s with 50.1 g gives μ = 0.082, all of it taken for Coulomb friction.",
        (
            FindingNumber("weight", coulomb_weight_mN(), "mN", 4),
            FindingNumber("μ from the whole force", whole),
            FindingNumber("f_v at 0.5 mm/s", coulomb_viscous_mN(), "mN", 2),
            FindingNumber("μ without f_v", published),
            FindingNumber("μ without f_v read as δ (v/d) S", newtonian),
        ),
        f"The force over the weight is {rounded(whole)}; without the model's own viscous friction of "
        f"{rounded(coulomb_viscous_mN(), 2)} mN it is {rounded(published)} ({percent(published / whole - 1)}), and "
        f"{rounded(newtonian)} with the dimensionally consistent one. The model then adds f_v to f_c once more.",
        "The model's default is the printed 0.082; the identification gives μ with and without the viscous share.",
    )


def _not_returned() -> PaperFinding:
    f_c = printed.FRICTION_COEFFICIENT * coulomb_weight_mN()
    force = f_c + coulomb_viscous_mN()
    return PaperFinding(
        "not-returned",
        "The model does not return the force that its μ came from",
        "Section 3.3, Fig. 8, Eqs. 1, 10 and 12",
        "μ is taken from a mean force of 40.07 mN.",
        (
            FindingNumber("f_c with μ = 0.082", f_c, "mN", 4),
            FindingNumber("f_v at 0.5 mm/s", coulomb_viscous_mN(), "mN", 2),
            FindingNumber("the model's force", force, "mN", 4),
            FindingNumber("printed force", printed.COULOMB_FORCE_MN, "mN", 4),
        ),
        f"For the same run the model with μ = 0.082 says {rounded(force, 4)} mN, "
        f"{rounded(100 * force / printed.COULOMB_FORCE_MN - 100, 2)} % more than was measured: rounding and the "
        "viscous friction that is counted twice.",
        "The simulated run shows that force; what was put in comes back as μ without the viscous share.",
    )


def _accuracy() -> PaperFinding:
    from scipy.optimize import brentq

    accuracy = printed.SENSOR_ACCURACY_MN
    total = steady_forces(printed.SPEEDS_MM_S, PAPER_MODEL, PAPER_CAPSULE, WALL_THICKNESS_MM).total
    steps = np.diff(total)
    within = int(np.searchsorted(total - total[0], accuracy))
    slowest = " and ".join(f"{speed:g}" for speed in printed.SPEEDS_MM_S[:within])

    def lacking(speed: float) -> float:
        return float(viscous_force(np.array(speed), PAPER_MODEL, 1.0)) - accuracy

    enough = float(brentq(lacking, 1e-3, 1e3))
    return PaperFinding(
        "accuracy",
        "The sensor's accuracy is as large as the differences that are interpreted",
        "Sections 3.1 and 3.3, Figs. 8, 9 and 11",
        "The force sensor is accurate to 5 mN; forces are given to 0.01 mN, and the parts of the model are compared.",
        (
            FindingNumber("accuracy over the Coulomb force", 100 * accuracy / printed.COULOMB_FORCE_MN, "%", 2),
            FindingNumber("accuracy as a friction coefficient", accuracy / coulomb_weight_mN(), "", 2),
            FindingNumber("f_v at 0.5 mm/s", coulomb_viscous_mN(), "mN", 2),
            FindingNumber("speed at which f_v reaches the accuracy", enough, "mm/s", 2),
            *(
                FindingNumber(f"the model from {low:g} to {high:g} mm/s", float(step), "mN")
                for low, high, step in zip(printed.SPEEDS_MM_S, printed.SPEEDS_MM_S[1:], steps, strict=False)
            ),
        ),
        f"5 mN are {rounded(100 * accuracy / printed.COULOMB_FORCE_MN, 2)} % of 40.07 mN, or "
        f"±{rounded(accuracy / coulomb_weight_mN(), 2)} in μ. f_v stays below them up to {rounded(enough, 2)} mm/s, "
        f"and the model's whole rise over the slowest speeds ({slowest} mm/s) is smaller. A mean over many samples "
        "is more precise than that, but a zero that is off by 5 mN is not averaged out.",
        "Each run has a zero of its own in the joint fit, means carry errors that know of correlated noise, and a "
        "tare can be planned before each run.",
    )


@dataclass(frozen=True, slots=True)
class DeterminationExample:
    """Made-up measurements beside the model's forces [mN] at the same speeds, and what both forms of R² say of them."""

    name: str
    measured_mN: tuple[float, ...]
    eq15: float
    correlation: float


def r2_by_eq15(model: FloatArray, measured: FloatArray) -> float:
    """R² as the paper computes it: sums of squares about the model's mean, model over measurement."""
    mean = model.mean()
    return float(((model - mean) ** 2).sum() / ((measured - mean) ** 2).sum())


def r2_by_correlation(model: FloatArray, measured: FloatArray) -> float:
    """Square of the correlation, as the paper describes it."""
    return float(np.corrcoef(model, measured)[0, 1] ** 2)


def band_speeds(above: bool) -> FloatArray:
    """Return the programme's speeds above the paper's boundary, or up to it [mm/s]."""
    speeds = np.array(printed.SPEEDS_MM_S)
    return np.asarray(speeds[(speeds > BOUNDARY_MM_S) == above])


def model_forces(speeds_mm_s: FloatArray) -> FloatArray:
    """Return the model's steady force [mN]."""
    return steady_forces(speeds_mm_s, PAPER_MODEL, PAPER_CAPSULE, WALL_THICKNESS_MM).total


def determination_examples() -> tuple[DeterminationExample, ...]:
    """Return measurements made up around the model's forces above the boundary."""
    model = model_forces(band_speeds(above=True))
    mean = model.mean()
    made_up = {
        "half as steep": mean + (model - mean) / 2,
        "mirrored: falls where the model rises": 2 * mean - model,
        "shifted by 5 mN": model + printed.SENSOR_ACCURACY_MN,
        f"shifted so far that Eq. 15 gives {R2_ABOVE:g}": model + offset_for_r2(R2_ABOVE, model),
    }
    return tuple(
        DeterminationExample(
            name, tuple(map(float, forces)), r2_by_eq15(model, forces), r2_by_correlation(model, forces)
        )
        for name, forces in made_up.items()
    )


def offset_for_r2(r2: float, model: FloatArray) -> float:
    """Return the constant difference [mN] between model and measurement that alone makes Eq. 15 this R²."""
    return float(model.std()) * sqrt(1 / r2 - 1)


def _no_correlation() -> PaperFinding:
    made_up = determination_examples()
    flat, mirrored = made_up[0], made_up[1]
    numbers = [
        number
        for example in made_up
        for number in (
            FindingNumber(f"Eq. 15, {example.name}", example.eq15, "", 4),
            FindingNumber(f"squared correlation, {example.name}", example.correlation, "", 4),
        )
    ]
    return PaperFinding(
        "eq15",
        "Eq. 15 is not the square of the correlation",
        "Section 4, Eq. 15",
        "R² is called the square of the correlation; its formula divides the model's sum of squares about the "
        "model's mean by the measurement's about the same mean.",
        tuple(numbers),
        "The ratio can exceed 1 and does not see the sign: a measurement half as steep as the model gets "
        f"{rounded(flat.eq15)}, one that falls where the model rises {rounded(mirrored.eq15)}; both have a squared "
        f"correlation of {rounded(flat.correlation)}.",
        "Both forms are reported, under names of their own.",
    )


def _offset_finding() -> PaperFinding:
    below, above = model_forces(band_speeds(above=False)), model_forces(band_speeds(above=True))
    low, high = offset_for_r2(R2_BELOW, below), offset_for_r2(R2_ABOVE, above)
    same = 1 / (1 + (low / float(above.std())) ** 2)
    return PaperFinding(
        "offset",
        "A constant offset and a narrow band lower Eq. 15 by themselves",
        "Section 4, Eq. 15, Fig. 11",
        f"R² is {R2_BELOW:g} below {BOUNDARY_MM_S:g} mm/s and {R2_ABOVE:g} above, from which the model is said to "
        "fail above.",
        (
            FindingNumber(f"spread of the model's forces up to {BOUNDARY_MM_S:g} mm/s", float(below.std()), "mN"),
            FindingNumber(f"spread of the model's forces above {BOUNDARY_MM_S:g} mm/s", float(above.std()), "mN"),
            FindingNumber(f"offset that alone gives {R2_BELOW:g} below", low, "mN", 2),
            FindingNumber(f"offset that alone gives {R2_ABOVE:g} above", high, "mN", 2),
            FindingNumber("Eq. 15 above with the offset that gives 0.8769 below", same, "", 2),
            FindingNumber("the larger offset over the model's mean above", 100 * high / float(above.mean()), "%", 2),
        ),
        f"On the speeds of our programme an offset of {rounded(low, 2)} mN, with everything else perfect, makes "
        f"{R2_BELOW:g} below; the same offset makes {rounded(same, 2)} above, where the model's forces spread less "
        f"({rounded(above.std())} against {rounded(below.std())} mN). {R2_ABOVE:g} needs {rounded(high, 2)} mN, "
        f"{rounded(100 * high / float(above.mean()), 2)} % of the model's mean there. How much of the paper's "
        "difference is of this kind is unknown without its data.",
        "R² stands beside the differences themselves, with their errors, and the boundary is estimated from these.",
    )


SAME_STRAIN_TOLERANCE = 0.02
"""Largest difference of strains that count as equal."""


@dataclass(frozen=True, slots=True)
class ElementRow:
    """One element at one of Table 1's strains.

    Attributes
    ----------
    published
        Table 1's entry, the values of Eq. 14 and of the quadratic, and their differences from the entry.
    identified
        From a relaxation; None where there is none at that strain, or it supports none.
    simulated
        The element that the run was simulated with, its own variation included.
    """

    published: ParameterSetDifference
    identified: EstimatedQuantity | None
    simulated: float

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return ELEMENT_UNITS[self.published.parameter]

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
    relaxation: RelaxationResult | None, model: FrictionModelSettings, of_run: Mapping[str, FrictionModelSettings]
) -> tuple[ElementRow, ...]:
    """Compare an identification of simulated relaxations with the published elements.

    Parameters
    ----------
    model
        The simulated model, before a run's own variation.
    of_run
        The model of each run, by its file's name.
    """
    fits = () if relaxation is None else [fit for fit in relaxation.fits if fit.elements]
    rows = []
    for published in parameter_set_differences():
        near = (fit for fit in fits if abs(fit.shear_strain - published.strain) <= SAME_STRAIN_TOLERANCE)
        fit = next(near, None)
        elements = {} if fit is None else {element.name: element for element in fit.elements}
        wall = model_wall(model if fit is None else of_run.get(fit.file, model), published.strain)
        simulated = float(getattr(wall, published.parameter))
        rows.append(ElementRow(published, elements.get(published.parameter), simulated))
    return tuple(sorted(rows, key=lambda row: (ELEMENT_NAMES.index(row.published.parameter), row.published.strain)))


FRICTION_FINDINGS = (
    _dimension,
    _lubrication,
    _weight,
    _coulomb_and_speed,
    _major_share,
    _logarithm,
    _coefficient_finding,
    _not_returned,
    _accuracy,
    _no_correlation,
    _offset_finding,
)


@cache
def all_findings() -> tuple[PaperFinding, ...]:
    """Compute all findings, by the model as printed."""
    return tuple(finding() for finding in (*WALL_FINDINGS, *FRICTION_FINDINGS, *HIGH_SPEED_FINDINGS))
