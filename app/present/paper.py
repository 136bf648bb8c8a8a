"""The report on the paper's programme, simulated and identified."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import prod

import numpy as np

from dragrig import present
from dragrig.analysis import (
    CAPSULE_COMBINATIONS,
    MIN_LEARNT,
    RUN_VARIATIONS,
    CoulombRun,
    DragResult,
    DragSetup,
    Estimate,
    Identification,
    JointFit,
    ParameterEstimate,
    count_text,
    steady_force_parts,
    value_with_error,
)
from dragrig.analysis.paper import ELEMENT_SYMBOLS, ElementRow, PaperFinding, determination_examples, published
from dragrig.analysis.paper import findings as paper_findings
from dragrig.config import Capsule, FrictionModelSettings, RigSettings
from dragrig.present import (
    FOUR_DIGITS,
    PAPER_TABLES,
    Block,
    Cell,
    Code,
    Column,
    Document,
    Facts,
    Figure,
    FormattedNumber,
    Items,
    NumberFormat,
    Section,
    Table,
    Text,
    TextKind,
    decimals,
    joint_figure,
    percent,
    percent_difference,
    shortest,
    shortest_percent,
    significant,
)
from dragrig.present.friction_model import WALL_TEXTS
from dragrig.rig import FloatArray, Run, software_version
from dragrig.sim_backend.friction import skew_resistance, steady_forces

PAPER_TITLE = "The paper's programme, simulated and identified"
_VISCOUS_TEXTS = {"published": "δ v, as published", "newtonian": "δ (v/d) S, dimensionally consistent"}


@dataclass(frozen=True, slots=True, eq=False)
class PaperReportData:
    """The simulated programme, what was identified from it, and what was found in the paper."""

    model: FrictionModelSettings
    capsule: Capsule
    wall_thickness_mm: float
    """`model`, `capsule`, `wall_thickness_mm`: what was simulated: the model, the drag test's capsule, the wall."""
    rig: RigSettings
    runs: int
    """Number of runs, return strokes included."""
    run_models: Mapping[str, FrictionModelSettings]
    """The model that each run was simulated with, its own variation included, by the file's name."""
    identification: Identification
    elements: tuple[ElementRow, ...]
    findings: tuple[PaperFinding, ...]
    coulomb_trace: Run | None
    """The Coulomb test's run; None when there is none."""

    @property
    def coulomb(self) -> CoulombRun | None:
        """What was identified from the Coulomb test."""
        coulomb = self.identification.coulomb
        return coulomb.runs[0] if coulomb is not None and coulomb.runs else None


SKEW_POINTS = 120
MAX_IN_LEAD = 3
TWO_DECIMALS = decimals(2)


def paper_tables(results: PaperReportData) -> dict[str, Table]:
    """Return all tables by name, as `PAPER_TABLES`; those of the joint fit are empty where it did not converge."""
    joint = results.identification.joint
    fit = joint if joint is not None and joint.converged else None
    tables = (
        _element_table(results),
        *_model_tables(results),
        _coulomb_table(results),
        _joint_parameter_table(fit, results.model),
        _combination_table(fit, results.model),
        _joint_run_table(fit, results),
        _drag_table(results),
        *_small_tables(results),
    )
    by_name = {table.name: table for table in tables}
    return {name: replace(by_name[name], file=f"{name}.csv") for name in PAPER_TABLES}


def simulated_value(name: str, model: FrictionModelSettings) -> float:
    """Return what a parameter or a combination of the capsule model was simulated with."""
    powers = next((product.powers for product in CAPSULE_COMBINATIONS if product.name == name), {name: 1.0})
    return prod(float(float(getattr(model, factor)) ** power) for factor, power in powers.items())


def intervals_holding_truth(parameters: tuple[ParameterEstimate, ...], model: FrictionModelSettings) -> tuple[int, int]:
    """Return how many of the determined intervals contain the simulated value, and how many there are."""
    inside = [
        parameter.interval[0] <= simulated_value(parameter.name, model) <= parameter.interval[1]
        for parameter in parameters
        if parameter.determined
    ]
    return sum(inside), len(inside)


def _columns(number_format: NumberFormat = FOUR_DIGITS, /, **headings: str) -> tuple[Column, ...]:
    """Return columns of one format, by their names in the CSV file."""
    return tuple(Column(name, heading, number_format) for name, heading in headings.items())


def _determined_cells(parameter: ParameterEstimate) -> tuple[Cell, Cell, Cell]:
    """Return value and interval; nothing of what the runs do not determine."""
    if not parameter.determined:
        return None, None, None
    value, low, high = (
        FormattedNumber.rounded(number, parameter.standard_error) for number in (parameter.value, *parameter.interval)
    )
    return value, low, high


def _cells_with_error(value: float | None, error: float | None) -> tuple[Cell, Cell]:
    """Return a value and its standard error, both to the error's second digit."""
    return FormattedNumber.rounded(value, error), FormattedNumber.rounded(error, error)


def _joint_parameter_table(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        *_columns(parameter="parameter", value="identified", low="95 % from", high="to", simulated="simulated"),
        *_columns(prior_low="before: from", prior_high="to"),
        *_columns(percent(), learnt="narrowed by"),
        *_columns(significant(2), meaning="meaning", standard_error="± standard error", unit="unit"),
    )
    rows = tuple(
        (
            *(parameter.name, *_determined_cells(parameter), simulated_value(parameter.name, model)),
            *(*parameter.prior, parameter.learnt, parameter.meaning),
            *(parameter.standard_error if parameter.determined else None, parameter.unit),
        )
        for parameter in (() if fit is None else fit.parameters)
    )
    return Table("parameters", "All parameters from all runs at once", columns, rows)


def _combination_table(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        *_columns(combination="combination", value="identified", low="95 % from", high="to", simulated="simulated"),
        *_columns(lambda value: f"{100 * value:.2g} %", half_width="± 95 %", meaning="meaning"),
    )
    meanings = {product.name: product.meaning for product in CAPSULE_COMBINATIONS}
    rows = tuple(
        (
            *(product.name, *_determined_cells(product), simulated_value(product.name, model)),
            *(product.half_width if product.determined else None, meanings[product.name]),
        )
        for product in (() if fit is None else fit.combinations)
    )
    return Table("combinations", "Combinations of the parameters", columns, rows)


def _joint_run_table(fit: JointFit | None, results: PaperReportData) -> Table:
    columns = (
        *_columns(TWO_DECIMALS, file="run", kind="kind", chi2_per_degree="χ² per degree", rms_mN="rms, mN"),
        *_columns(TWO_DECIMALS, zero_mN="zero, mN", zero_standard_error_mN="± standard error"),
        *_columns(decimals(3), stiffness_factor="stiffness ×", simulated_stiffness_factor="simulated"),
        *_columns(decimals(3), friction_factor="friction ×", simulated_friction_factor="simulated"),
    )
    model = results.model
    rows: list[tuple[Cell, ...]] = []
    for run in () if fit is None else fit.runs:
        own = results.run_models.get(run.file, model)
        simulated = {
            "stiffness": own.stiffness_scale / model.stiffness_scale,
            "friction": own.friction_coefficient / model.friction_coefficient,
        }
        factors: list[Cell] = []
        for variation in RUN_VARIATIONS:
            factor = run.factors.get(variation.name, Estimate())
            # A run that does not show a factor leaves it at its prior.
            known = factor.standard_error is not None and factor.standard_error < variation.sd * (1 - MIN_LEARNT)
            factors += [factor.value, simulated[variation.name]] if known else [None, None]
        zero = _cells_with_error(run.zero.value, run.zero.standard_error)
        rows.append((run.file, run.kind, run.chi2, run.rms_mN, *zero, *factors))
    caption = "What the joint fit leaves of each run, and the run’s own zero and factors"
    return Table("joint-runs", caption, columns, tuple(rows))


def _element_table(results: PaperReportData) -> Table:
    columns = (
        *_columns(element="element"),
        *_columns(shortest_percent, strain="strain"),
        *_columns(unit="unit", table1="Table 1", eq14="Eq. 14"),
        *_columns(percent_difference, eq14_relative_difference="from Table 1"),
        *_columns(quadratic="quadratic"),
        *_columns(percent_difference, quadratic_relative_difference="from Table 1"),
        *_columns(simulated="simulated", identified="identified", identified_low="95 % from", identified_high="to"),
        *_columns(
            percent_difference,
            identified_relative_difference_from_simulated="from simulated",
            identified_relative_difference_from_table1="from Table 1",
        ),
    )
    rows = []
    for row in results.elements:
        wall, identified = row.published, row.identified
        value = (None, None, None) if identified is None else (identified.value, *identified.interval)
        rows.append(
            (
                *(ELEMENT_SYMBOLS[wall.parameter], wall.strain, row.unit, wall.table1, wall.eq14, wall.eq14_difference),
                *(wall.quadratic, wall.quadratic_difference, row.simulated, *value),
                *(row.difference, row.difference_from_table1),
            )
        )
    return Table("elements", "The wall's five elements: published, simulated, identified", columns, tuple(rows))


def _model_tables(results: PaperReportData) -> tuple[Table, Table, Table]:
    """Tabulate what the simulated model says: the largest skew resistance, its curves, the forces."""
    settings = results.model, results.capsule, results.wall_thickness_mm
    forces = steady_forces(published.SPEEDS_MM_S, *settings)
    speed = _columns(shortest(), speed_mm_s="v, mm/s")
    skew_columns = (
        *speed,
        *_columns(largest_skew_mN="largest P(x) S, mN"),
        *_columns(significant(3), x_of_largest_skew_mm="at x, mm"),
        *_columns(skew_at_equator_mN="P(L) S, mN"),
    )
    maxima = (forces.speed_mm_s, forces.max_skew, forces.x_of_max_skew, forces.side_pressure_force)
    length = 0.5 * results.capsule.diameter_mm * np.sin(np.radians(results.capsule.contact_angle_deg))
    x = np.append(np.linspace(0.0, length, SKEW_POINTS), length + results.model.side_contact_mm)
    curves = [skew_resistance(x, speed_mm_s, *settings) for speed_mm_s in published.SKEW_SPEEDS_MM_S]
    curve_columns = _columns(x_mm="x, mm", **{f"skew_mN_at_{v:g}_mm_s": f"{v:g}" for v in published.SKEW_SPEEDS_MM_S})
    force_columns = (
        *speed,
        *_columns(TWO_DECIMALS, f_e_mN="f_e, mN", f_v_mN="f_v, mN", f_c_mN="f_c, mN", total_mN="total, mN"),
        *_columns(percent(), f_e_share="share of f_e"),
    )
    parts = (forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, forces.f_e / forces.total)

    def rows(*values: FloatArray) -> tuple[tuple[Cell, ...], ...]:
        return tuple(tuple(map(float, row)) for row in zip(*values, strict=True))

    return (
        Table("skew-maximum", "Largest skew resistance, and where it lies", skew_columns, rows(*maxima)),
        Table("skew-resistance", "Skew resistance along the contact", curve_columns, rows(x, *curves)),
        Table("forces", "The model's forces at steady speed", force_columns, rows(*parts)),
    )


def _coulomb_table(results: PaperReportData) -> Table:
    columns = (
        *_columns(source="source", force_mN="mean force, mN"),
        *_columns(significant(2), force_standard_error_mN="± standard error", viscous_mN="of it viscous, mN"),
        *_columns(significant(3), mu="μ, all Coulomb"),
        *_columns(significant(2), mu_standard_error="± standard error"),
        *_columns(significant(3), mu_without_viscous="μ without f_v"),
        *_columns(significant(2), mu_without_viscous_standard_error="± standard error"),
    )
    viscous = paper_findings.coulomb_viscous_mN(results.model.viscous)
    weight = paper_findings.coulomb_weight_mN()

    def simulated(source: str, mu: float) -> tuple[Cell, ...]:
        force = mu * weight + viscous
        return source, force, None, viscous, force / weight, None, mu, None

    whole, without = paper_findings.coulomb_coefficient(), paper_findings.coulomb_coefficient(viscous)
    rows: list[tuple[Cell, ...]] = [
        ("the paper's force, as printed", published.COULOMB_FORCE_MN, None, viscous, whole, None, without, None),
        simulated("the model that was simulated", results.model.friction_coefficient),
    ]
    run = results.coulomb
    if run is not None:
        own = results.run_models.get(run.file, results.model).friction_coefficient
        rows.append(simulated("the same with this run’s own μ", own))
        force, mu, reduced = (
            _cells_with_error(estimate.value, estimate.standard_error)
            for estimate in (run.force, run.mu, run.mu_without_viscous)
        )
        rows.append(("identified from the simulated run", *force, run.viscous_mN, *mu, *reduced))
    return Table("coulomb", "The Coulomb test at 0.5 mm/s with 50.1 g", columns, tuple(rows))


def _drag_table(results: PaperReportData) -> Table:
    columns = (
        *_columns(shortest(), speed_mm_s="v, mm/s", runs="runs"),
        *_columns(TWO_DECIMALS, measured_mN="measured, mN", measured_low_mN="95 % from", measured_high_mN="to"),
        *_columns(TWO_DECIMALS, f_e_mN="f_e, mN", f_v_mN="f_v, mN", f_c_mN="f_c, mN", model_mN="model, mN"),
        *_columns(TWO_DECIMALS, difference_mN="measured − model", ln_law_mN="ln v law, mN"),
        *_columns(TWO_DECIMALS, simulated_model_mN="as simulated, mN"),
    )
    drag = results.identification.drag
    points = () if drag is None else drag.points
    law = None if drag is None else drag.log_law
    setup = DragSetup(results.capsule, results.wall_thickness_mm)
    speeds = np.array([point.speed_mm_s for point in points])
    rows = []
    for point, simulated in zip(points, steady_force_parts(setup, results.model, speeds).total.tolist(), strict=True):
        measured, error = point.force.value, point.force.standard_error
        fitted = None if law is None else law.intercept.value + law.slope.value * float(np.log(point.speed_mm_s))
        rows.append(
            (
                *(point.speed_mm_s, point.runs),
                *(
                    FormattedNumber.rounded(number, error)
                    for number in (measured, *(point.force.interval or (None, None)))
                ),
                *(point.f_e_mN, point.f_v_mN, point.f_c_mN, point.model_mN),
                *(None if measured is None else measured - point.model_mN, fitted, simulated),
            )
        )
    return Table("drag", "Steady drag of the simulated runs beside the identified model", columns, tuple(rows))


def _small_tables(results: PaperReportData) -> tuple[Table, Table, Table]:
    r2_columns = _columns(decimals(4), eq15_ratio="ratio of Eq. 15", squared_correlation="squared correlation")
    drag = results.identification.drag
    bands = tuple(
        (band.band, band.speeds, band.eq15, band.correlation) for band in (() if drag is None else drag.determination)
    )
    examples = tuple((example.name, example.eq15, example.correlation) for example in determination_examples())
    numbers = tuple(
        (finding.key, finding.title, finding.where, number.quantity, number.value, number.unit)
        for finding in results.findings
        for number in finding.numbers
    )
    return (
        Table(
            "determination",
            "How the identified model explains the simulated runs",
            (*_columns(shortest(), band="simulated runs, band", speeds="speeds"), *r2_columns),
            bands,
        ),
        Table(
            "eq15-examples",
            "Eq. 15 beside the squared correlation, above 20 mm/s",
            (*_columns(made_up_measurement="made-up measurement"), *r2_columns),
            examples,
        ),
        Table(
            "findings",
            "Inconsistencies of the paper, every number",
            _columns(finding="finding", title="title", where="where", quantity="quantity", value="value", unit="unit"),
            numbers,
        ),
    )


def paper_document(results: PaperReportData, tables: Mapping[str, Table], model: str | None = None) -> Document:
    """Lay out the report; `tables` are from `paper_tables`, `model` names the file of the identified model."""
    return Document(
        title=PAPER_TITLE,
        source=PAPER_TITLE,
        badges=("simulated",),
        answer=_paper_answer(results),
        lead=(
            f"The first: {', '.join(f'“{finding.title}”' for finding in results.findings[:MAX_IN_LEAD])}.",
            "What the friction model of “Modeling of Velocity-dependent Frictional Resistance of a Capsule Robot "
            "Inside an Intestine” (2012) predicts, what comes back when its tests are simulated and identified, and "
            "where the paper is inconsistent. Nothing here was measured on a gut: every run is simulated, and the "
            "paper's own data are not in its text.",
        ),
        sections=(
            Section("conclusion", "What comes back", _joint_figure(results)),
            _settings_section(results),
            _wall_section(results, tables),
            _skew_section(results, tables),
            _coulomb_section(results, tables),
            Section(
                "forces",
                "5. The parts of the friction against speed (Fig. 9)",
                (
                    Figure(
                        "force-curves",
                        "Environmental resistance, viscous friction, Coulomb friction and their sum against speed.",
                        "After the paper's Fig. 9, by the model that was simulated.",
                        lambda: present.forces_figure(
                            results.model, results.capsule, results.wall_thickness_mm, published.SPEEDS_MM_S
                        ),
                    ),
                    tables["forces"],
                ),
            ),
            _joint_section(results, tables, model),
            _drag_section(results, tables),
            _findings_section(results, tables),
            _files_section(tables, model),
        ),
    )


def _paper_answer(results: PaperReportData) -> str:
    """Say how the identification does on runs whose parameters are known, and how much of the paper does not fit."""
    inconsistent = f"{count_text(len(results.findings), 'inconsistency')} of the paper".replace("ys of", "ies of")
    fit = results.identification.joint
    if fit is None or not fit.converged:
        return f"The simulated programme was not identified; {inconsistent} are listed."
    inside, known = intervals_holding_truth(fit.parameters, results.model)
    return (
        f"{inside} of the {known} parameters that the simulated programme determines have their true value in the 95 % "
        f"interval; {inconsistent} are listed."
    )


def _joint_figure(results: PaperReportData) -> tuple[Figure, ...]:
    fit = results.identification.joint
    if fit is None:
        return ()
    figure = joint_figure(fit)
    return (replace(figure, caption=f"The joint fit of all runs. {figure.caption}"),)


def _settings_section(results: PaperReportData) -> Section:
    simulated, model, identification = results.rig.simulated, results.model, results.identification
    noise, variation = simulated.noise, simulated.variation
    settings = {
        "Software": f"{software_version()}, simulated rig",
        "Seed": str(simulated.seed),
        "Programme": f"plan paper: {results.runs} runs, return strokes included, at "
        f"{results.rig.sampling.rate_hz:g} Hz",
        "Wall": WALL_TEXTS.get(model.wall, model.wall),
        "Viscous friction": _VISCOUS_TEXTS[model.viscous],
        "Coulomb friction": f"μ = {model.friction_coefficient:g}",
        "Sensor": f"noise {noise.white_mN:g} mN white and {noise.slow_mN:g} mN slow ({noise.slow_correlation_s:g} s), "
        f"zero off by {noise.zero_mN:g} mN (standard deviation) in each run",
        "Between runs": f"stiffness varies by {100 * variation.run_stiffness:g} %, "
        f"μ by {100 * variation.run_friction:g} % (standard deviations)",
    }
    left_out = identification.left_out
    reasons = ", or because ".join(dict.fromkeys(run.reason for run in left_out))
    used = f"{len(identification.used)} runs were used and {len(left_out)} left out, each because {reasons}."
    return Section(
        "what",
        "1. What was simulated",
        (
            Facts(settings),
            Text("The same seed makes the same runs. They lie beside this page and are a campaign like any other."),
            Items(identification.remarks, remarks=True),
            Text(used if left_out else ""),
        ),
    )


def _wall_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    relaxation = results.identification.relaxation
    fits, laws = ((), ()) if relaxation is None else (relaxation.fits, relaxation.laws)
    elements = tables["elements"]
    shown = ("element", "strain", "unit", "table1", "eq14", "eq14_relative_difference", "quadratic")
    names = (*shown[:3], "simulated", "identified", "identified_low", "identified_high")
    differences = ("identified_relative_difference_from_simulated", "table1")
    identified = elements.select(*names, *differences, "identified_relative_difference_from_table1")
    return Section(
        "wall",
        "2. Table 1, Eq. 14, and the identified wall",
        (
            Text(
                "Eq. 14 is not a fit of Table 1; a least-squares quadratic through the same four points is closer. "
                f"Relaxations were simulated with {WALL_TEXTS.get(results.model.wall, results.model.wall)}. "
                f"{_element_agreement(results)}"
            ),
            Figure(
                "wall",
                "Five panels, one for each element against strain: Table 1's points, Eq. 14's curve, which misses "
                "them, the quadratic through them, and the identified values with their intervals.",
                "The wall's elements against strain.",
                lambda: present.wall_figure(fits, laws),
            ),
            elements.select(*shown, "quadratic_relative_difference"),
            Section(
                "identified-elements",
                "Identified from the simulated relaxations",
                (replace(identified, name="identified-elements-table"),) if any(fit.elements for fit in fits) else (),
            ),
            Items(() if relaxation is None else relaxation.remarks, remarks=True),
            Section(
                "five-elements",
                "Do five elements suffice?",
                (Items(tuple(f"{100 * fit.shear_strain:g} %: {fit.test.sentence}" for fit in fits if fit.test)),),
            ),
        ),
    )


def _element_agreement(results: PaperReportData) -> str:
    """Say how the identified elements agree with the simulated ones."""
    rows = [row for row in results.elements if row.identified is not None]
    if not rows:
        relaxation = results.identification.relaxation
        reasons = "" if relaxation is None else f": {'; '.join(relaxation.remarks)}"
        return f"No element was identified{reasons}."
    worst = max(abs(row.difference or 0.0) for row in rows)
    return (
        f"Of {len(results.elements)} elements {len(rows)} were identified; the 95 % intervals of "
        f"{sum(bool(row.inside) for row in rows)} contain the simulated value, and the largest difference is "
        f"{percent_difference(worst).removeprefix('+')}. The simulated values vary a little from run to run, as they "
        "do on one gut; the column “simulated” has each run's own value."
    )


def _skew_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    why = next(finding.title for finding in results.findings if finding.key == "maximum")
    return Section(
        "skew",
        "3. Skew resistance along the contact (Fig. 7)",
        (
            Text(
                f"The largest value lies inside the contact, not at the equator where the strain is largest: “{why}”."
            ),
            Figure(
                "skew-curves",
                "Skew resistance along the contact at six speeds; each curve rises to a maximum inside the hemisphere "
                "and falls towards the equator, beside the capsule it stays constant for 20 mm.",
                "After the paper's Fig. 7. A dot marks each curve's largest value.",
                lambda: present.skew_figure(results.model, results.capsule, results.wall_thickness_mm),
            ),
            tables["skew-maximum"],
        ),
    )


def _coulomb_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    trace = results.coulomb_trace
    blocks: list[Block] = [
        Text(
            f"{published.COULOMB_FORCE_MN:.2f} mN over the weight of {published.COULOMB_MASS_G:g} g give the paper's "
            f"μ = {published.FRICTION_COEFFICIENT:g} when all of it counts as Coulomb friction. The model attributes a "
            "part of that force to viscous friction and counts it twice, so that it predicts more than the paper "
            "measured."
        )
    ]
    if trace is not None:
        blocks.append(
            Figure(
                "coulomb-run",
                "Force of the simulated Coulomb test against time, raw and filtered, its mean, position, speed.",
                "After the paper's Fig. 8: the simulated run as recorded, the sensor's zero included.",
                lambda: present.run_figure(trace),
            )
        )
    coulomb = results.identification.coulomb
    remarks = Items(() if coulomb is None else coulomb.remarks, remarks=True)
    blocks += [tables["coulomb"], remarks]
    return Section("coulomb", "4. Coulomb friction at 0.5 mm/s (Fig. 8)", tuple(blocks))


def _joint_section(results: PaperReportData, tables: Mapping[str, Table], model: str | None) -> Section:
    fit = results.identification.joint
    heading = "6. Joint fit of all runs"
    if fit is None:
        return Section("joint", heading, (Text("There was no joint fit."),))

    if not fit.converged:
        failed = Text("The joint fit did not converge, so that none of its numbers is reported.")
        return Section("joint", heading, (failed, Items(fit.remarks, remarks=True)))
    rest = "noise and the variation between runs"
    remainder = f"only {rest} remain (p = {fit.p_value:.2f})" if fit.holds else f"more than {rest} remains"
    parameters = intervals_holding_truth(fit.parameters, results.model)
    combinations = intervals_holding_truth(fit.combinations, results.model)
    unknown = " and ".join(parameter.name for parameter in fit.parameters if not parameter.determined)
    learnt = "“Learnt” is the share by which the runs narrowed a parameter's interval."
    dry_run = (
        Text(
            f"The identified friction model is like those that ship, and is in `{model}` beside this page. A dry run "
            "with it is a dry run of this specimen:"
        ),
        Code(f"dragrig run drag --model {model}"),
    )
    return Section(
        "joint",
        heading,
        (
            Text(
                f"One fit of the friction model to all {len(fit.runs)} runs together, in which each run has a zero and "
                "factors of its own, and each parameter has a prior for any specimen. χ² is "
                f"{fit.chi2 / fit.degrees:.3f} per degree of freedom ({fit.degrees}): {remainder}. The 95 % intervals "
                f"of {parameters[0]} of the {parameters[1]} parameters that the runs determine, and of "
                f"{combinations[0]} of {combinations[1]} combinations, contain the simulated value."
            ),
            tables["parameters"].select(
                "parameter", "value", "low", "high", "simulated", "prior_low", "prior_high", "learnt", "meaning"
            ),
            Text(f"{learnt} The runs do not determine {unknown}." if unknown else learnt),
            Items(fit.remarks, remarks=True),
            tables["combinations"],
            Section("specimen-model", "This specimen on the simulated rig", dry_run if model else ()),
        ),
    )


def _drag_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    drag = results.identification.drag
    heading = "7. The model's curve with simulated measurements (Fig. 11)"
    if drag is None:
        return Section("drag", heading, (Text("No drag was identified."),))

    own = ", the paper's own" if results.model == published.PAPER_MODEL else ""
    beside = (
        "The zero of each run comes from the joint fit, and so does the model beside the runs; “as simulated” is the "
        f"curve of the simulated model{own}."
        if drag.before_mN is not None
        else "The model beside the runs is the simulated one."
    )
    boundary = "The runs do not determine a boundary." if drag.boundary is None else drag.boundary.sentence
    return Section(
        "drag",
        heading,
        (
            Text(beside),
            Figure(
                "drag-figure",
                "Measured drag of the simulated runs with intervals against speed, the curves of the identified and of "
                "the simulated model, and the fitted logarithm; below, the differences from the identified model.",
                "After the paper's Fig. 11: simulated runs in place of the paper's measurements, which its text does "
                "not contain, the model identified from all runs, and the simulated model. Bars are 95 % intervals.",
                lambda: present.drag_figure(
                    drag,
                    before="as simulated",
                    boundary_mm_s=published.BOUNDARY_MM_S,
                    accuracy_mN=published.SENSOR_ACCURACY_MN,
                ),
            ),
            tables["drag"].select(
                *("speed_mm_s", "runs", "measured_mN", "measured_low_mN", "measured_high_mN", "model_mN"),
                *("difference_mN", "ln_law_mN", "simulated_model_mN"),
            ),
            Section(
                "drag-r2",
                "R²",
                (
                    Text(
                        f"The paper prints R² = {published.R2_BELOW:.4f} below {published.BOUNDARY_MM_S:g} mm/s and "
                        f"{published.R2_ABOVE:.4f} above. These are quoted: the measurements behind them are not in "
                        "its text, and no software can reproduce them.",
                        TextKind.QUOTATION,
                    ),
                    Text(
                        "The numbers below are about the simulated runs and the model identified from them. The runs "
                        "follow it by construction up to noise and the variation between runs, so that they show how "
                        "far R² can be trusted at that scatter, and nothing about a gut."
                    ),
                    tables["determination"],
                ),
            ),
            Section("drag-log-law", "ln v", (Text(_log_law_text(drag)),)),
            Section("drag-boundary", "Boundary", (Text(boundary),)),
            Items(drag.remarks, remarks=True),
        ),
    )


def _log_law_text(drag: DragResult) -> str:
    law = drag.log_law
    if law is None:
        return "The runs support no law of ln v."
    text = (
        f"The least-squares law is ({value_with_error(law.intercept.value, law.intercept.standard_error)}) mN + "
        f"({value_with_error(law.slope.value, law.slope.standard_error)}) mN · ln(v / 1 mm/s), with R² = {law.r2:.3f}."
    )
    if law.lack_of_fit_p is None:
        return text
    chance = "below 0.01" if law.lack_of_fit_p < 1e-4 else significant(2)(100 * law.lack_of_fit_p)
    verdict = ": the growth is not logarithmic" if law.deviates else ""
    return f"{text} The probability that runs which follow it deviate as much as these is {chance} %{verdict}."


def _findings_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    examples = tables["eq15-examples"]
    findings = tuple(
        Section(
            finding.key,
            f"8.{number} {finding.title}",
            (
                Text(f"{finding.where}: {finding.paper}", TextKind.QUOTATION),
                Text(finding.shown),
                Facts({quantity.quantity: str(quantity) for quantity in finding.numbers}),
                Text(f"dragrig: {finding.practice}"),
                *((examples,) if finding.key == "eq15" else ()),
            ),
        )
        for number, finding in enumerate(results.findings, 1)
    )
    return Section(
        "findings",
        "8. Where the paper is inconsistent",
        (
            Text(
                "Computed from the paper's own equations and numbers, as printed, whatever was simulated above: what "
                "the paper has (in grey), what the numbers show, and what dragrig does. All of them are in "
                "`findings.csv`."
            ),
            *findings,
        ),
    )


def _files_section(tables: Mapping[str, Table], model: str | None) -> Section:
    files = [f"`{name}.csv` {table.caption}" for name, table in tables.items()]
    if model is not None:
        files.append(
            f"`{model}` The identified friction model; `dragrig run` and `dragrig model` load it with `--model`."
        )
    files.append("`*.h5` The runs; `dragrig info`, `table`, `show` and `identify` read them.")
    return Section("files", "9. Files", (Text("Beside this page, with every digit:"), Items(tuple(files))))
