"""The report on the paper's programme, simulated and identified."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.estimates import Estimate, EstimatedQuantity
from dragrig.analysis.identification.identification import (
    MIN_LEARNT,
    CoulombRun,
    DragResult,
    Identification,
    JointFit,
    ParameterEstimate,
    RunResidual,
)
from dragrig.analysis.identification.identify import identified_settings
from dragrig.analysis.identification.steady_drag import DragSetup, steady_force_parts
from dragrig.analysis.models.capsule_model import CAPSULE_COMBINATIONS, RUN_VARIATIONS, CapsuleModel
from dragrig.analysis.models.nominal_model import Variation
from dragrig.analysis.paper import findings as coulomb_test
from dragrig.analysis.paper import published
from dragrig.analysis.paper.findings import ElementRow, determination_examples
from dragrig.analysis.paper.published import PaperFinding
from dragrig.analysis.paper.wall_findings import ELEMENT_SYMBOLS
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule
from dragrig.present.document import (
    Block,
    Cell,
    Code,
    Column,
    Document,
    Facts,
    Field,
    Figure,
    Items,
    Section,
    Table,
    Text,
    TextKind,
)
from dragrig.present.friction_model import SKEW_SPEEDS_MM_S, WALL_TEXTS
from dragrig.present.numbers import (
    decimals,
    percent,
    percent_difference,
    shortest,
    shortest_percent,
    significant,
    value_with_error,
)
from dragrig.rig.runfile.model import Run
from dragrig.rig.runfile.schema import software_version
from dragrig.sim_backend.friction import skew_resistance, steady_forces

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

PAPER_TITLE = "The paper's programme, simulated and identified"
_VISCOUS_TEXTS = {"published": "δ v, as published", "newtonian": "δ (v/d) S, dimensionally consistent"}
MAX_LOG_LAW_P = 0.05
"""Below this p-value of the lack of fit, the growth is not called logarithmic."""


@dataclass(frozen=True, slots=True, eq=False)
class PaperReportData:
    """The simulated programme, what was identified from it, and what was found in the paper.

    Attributes
    ----------
    model, capsule, wall_thickness_mm
        What was simulated: the model, the drag test's capsule, the wall.
    runs
        How many runs were made, ways back included.
    of_run
        The model that each run was simulated with, its own variation included, by the file's name.
    coulomb_trace
        The Coulomb test's run; None when there is none.
    """

    model: FrictionModelSettings
    capsule: Capsule
    wall_thickness_mm: float
    rig: RigSettings
    runs: int
    of_run: Mapping[str, FrictionModelSettings]
    identification: Identification
    elements: tuple[ElementRow, ...]
    findings: tuple[PaperFinding, ...]
    coulomb_trace: Run | None

    @property
    def coulomb(self) -> CoulombRun | None:
        """What was identified from the Coulomb test."""
        found = self.identification.coulomb
        return found.runs[0] if found is not None and found.runs else None

    @property
    def identified_model(self) -> FrictionModelSettings | None:
        """The model with what the joint fit determined in place; None without one that converged."""
        joint = self.identification.joint
        if joint is None or not joint.converged:
            return None
        return identified_settings(CapsuleModel(self.model), joint)


VALUE_COLUMN = Column("value", "identified")
INTERVAL_COLUMNS = (Column("low", "95 % from"), Column("high", "to"))
SIMULATED_COLUMN = Column("simulated", "simulated")
COMBINATION_MEANINGS = {one.name: one.meaning for one in CAPSULE_COMBINATIONS}
COMBINATION_POWERS: dict[str, Mapping[str, float]] = {one.name: one.powers for one in CAPSULE_COMBINATIONS}


def joint_tables(results: PaperReportData) -> tuple[Table, ...]:
    """Return parameters, their combinations, and how each run is left; empty without a joint fit that converged."""
    joint = results.identification.joint
    fit = joint if joint is not None and joint.converged else None
    return (
        _joint_parameter_table(fit, results.model),
        _combination_table(fit, results.model),
        _joint_run_table(fit, results),
    )


def simulated_value(name: str, model: FrictionModelSettings) -> float:
    """Return what a parameter or a combination of the capsule model was simulated with."""
    if name in COMBINATION_POWERS:
        return prod(float(float(getattr(model, factor)) ** power) for factor, power in COMBINATION_POWERS[name].items())
    return float(getattr(model, name))


def intervals_holding_truth(found: tuple[ParameterEstimate, ...], model: FrictionModelSettings) -> tuple[int, int]:
    """Return how many of the intervals that the runs determine hold what was simulated, and how many there are."""
    known = [one for one in found if one.determined]
    return sum(one.interval[0] <= simulated_value(one.name, model) <= one.interval[1] for one in known), len(known)


def _value_cells(one: ParameterEstimate) -> tuple[float | None, float | None, float | None]:
    """Return value and interval; nothing of what the runs do not determine."""
    return (one.value, *one.interval) if one.determined else (None, None, None)


def _joint_parameter_table(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        Column("parameter", "parameter"),
        VALUE_COLUMN,
        *INTERVAL_COLUMNS,
        SIMULATED_COLUMN,
        Column("prior_low", "before: from"),
        Column("prior_high", "to"),
        Column("learnt", "learnt", percent()),
        Column("meaning", "what it is"),
        Column("standard_error", "±", significant(2)),
        Column("unit", "unit"),
    )
    rows = () if fit is None else tuple(_joint_parameter_row(one, model) for one in fit.parameters)
    return Table("parameters", "All parameters from all runs at once", columns, rows)


def _joint_parameter_row(one: ParameterEstimate, model: FrictionModelSettings) -> tuple[Cell, ...]:
    error = one.standard_error if one.determined else None
    numbers = (*_value_cells(one), simulated_value(one.name, model), *one.prior, one.learnt)
    return one.name, *numbers, one.meaning, error, one.unit


def _combination_table(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        Column("combination", "combination"),
        VALUE_COLUMN,
        *INTERVAL_COLUMNS,
        SIMULATED_COLUMN,
        Column("half_width", "±", _two_digit_percent),
        Column("meaning", "what it is"),
    )
    rows = tuple(
        (
            *(one.name, *_value_cells(one), simulated_value(one.name, model)),
            *(one.half_width if one.determined else None, COMBINATION_MEANINGS[one.name]),
        )
        for one in (() if fit is None else fit.combinations)
    )
    return Table("combinations", "What the parameters combine to", columns, rows)


def _joint_run_table(fit: JointFit | None, results: PaperReportData) -> Table:
    columns = (
        Column("file", "run"),
        Column("kind", "kind"),
        Column("chi2_per_degree", "χ² per degree", decimals(2)),
        Column("rms_mN", "rms, mN", decimals(2)),
        Column("zero_mN", "zero, mN", decimals(2)),
        Column("zero_standard_error_mN", "±", decimals(2)),
        Column("stiffness_factor", "stiffness ×", decimals(3)),
        Column("simulated_stiffness_factor", "simulated", decimals(3)),
        Column("friction_factor", "friction ×", decimals(3)),
        Column("simulated_friction_factor", "simulated", decimals(3)),
    )
    rows = () if fit is None else tuple(_joint_run_row(one, results) for one in fit.runs)
    return Table(
        "joint-runs", "What the joint fit leaves of each run, and the run’s own zero and factors", columns, rows
    )


def _joint_run_row(one: RunResidual, results: PaperReportData) -> tuple[Cell, ...]:
    own, model = results.of_run.get(one.file, results.model), results.model
    put_in = {
        "stiffness": own.stiffness_scale / model.stiffness_scale,
        "friction": own.friction_coefficient / model.friction_coefficient,
    }
    factors = [cell for variation in RUN_VARIATIONS for cell in _factor_cells(one, variation, put_in[variation.name])]
    return one.file, one.kind, one.chi2, one.rms_mN, one.zero.value, one.zero.standard_error, *factors


def _factor_cells(one: RunResidual, variation: Variation, put_in: float) -> tuple[Cell, Cell]:
    """Return a run's factor and what it was simulated with; nothing of a factor that the run does not show."""
    found = one.factors.get(variation.name, Estimate())
    shown = found.standard_error is not None and found.standard_error < variation.sd * (1 - MIN_LEARNT)
    return (found.value, put_in) if shown else (None, None)


SPEED_COLUMN = Column("speed_mm_s", "v, mm/s", shortest())
SKEW_POINTS = 120


def paper_tables(results: PaperReportData) -> dict[str, Table]:
    """Return all tables by name."""
    made = (
        _element_table(results),
        _skew_maximum_table(results),
        _skew_table(results),
        _coulomb_table(results),
        _force_table(results),
        *joint_tables(results),
        _drag_table(results),
        _determination_table(results),
        _eq15_example_table(),
        _findings_table(results),
    )
    return {table.name: table for table in made}


def _element_table(results: PaperReportData) -> Table:
    columns = (
        Column("element", "element"),
        Column("strain", "strain", shortest_percent),
        Column("unit", "unit"),
        Column("table1", "Table 1"),
        Column("eq14", "Eq. 14"),
        Column("eq14_relative_difference", "from Table 1", percent_difference),
        Column("quadratic", "quadratic"),
        Column("quadratic_relative_difference", "from Table 1", percent_difference),
        Column("simulated", "simulated"),
        Column("identified", "identified"),
        Column("identified_low", "95 % from"),
        Column("identified_high", "to"),
        Column("identified_relative_difference_from_simulated", "from simulated", percent_difference),
        Column("identified_relative_difference_from_table1", "from Table 1", percent_difference),
    )
    rows = []
    for row in results.elements:
        one, found = row.published, row.identified
        value, low, high = (None, None, None) if found is None else (found.value, *found.interval)
        rows.append(
            (
                *(ELEMENT_SYMBOLS[one.parameter], one.strain, row.unit, one.table1, one.eq14, one.eq14_difference),
                *(one.quadratic, one.quadratic_difference, row.simulated, value, low, high),
                *(row.difference, row.difference_from_table1),
            )
        )
    return Table("elements", "The wall's five elements: published, simulated, identified", columns, tuple(rows))


def _skew_maximum_table(results: PaperReportData) -> Table:
    forces = steady_forces(published.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
    columns = (
        SPEED_COLUMN,
        Column("largest_skew_mN", "largest P(x) S, mN"),
        Column("x_of_largest_skew_mm", "at x, mm", significant(3)),
        Column("skew_at_equator_mN", "P(L) S, mN"),
    )
    values = (forces.speed_mm_s, forces.max_skew, forces.x_of_max_skew, forces.side_pressure_force)
    return Table("skew-maximum", "Largest skew resistance, and where it lies", columns, _rows_of_columns(*values))


def _skew_table(results: PaperReportData) -> Table:
    length = 0.5 * results.capsule.diameter_mm * np.sin(np.radians(results.capsule.contact_angle_deg))
    x = np.append(np.linspace(0.0, length, SKEW_POINTS), length + results.model.side_contact_mm)
    curves = [
        skew_resistance(x, speed, results.model, results.capsule, results.wall_thickness_mm)
        for speed in SKEW_SPEEDS_MM_S
    ]
    columns = (
        Column("x_mm", "x, mm"),
        *(Column(f"skew_mN_at_{speed:g}_mm_s", f"{speed:g}") for speed in SKEW_SPEEDS_MM_S),
    )
    return Table("skew-resistance", "Skew resistance along the contact", columns, _rows_of_columns(x, *curves))


def _coulomb_table(results: PaperReportData) -> Table:
    columns = (
        Column("source", "source"),
        Column("force_mN", "mean force, mN"),
        Column("force_standard_error_mN", "±", significant(2)),
        Column("viscous_mN", "of it viscous, mN", significant(2)),
        Column("mu", "μ, all Coulomb", significant(3)),
        Column("mu_standard_error", "±", significant(2)),
        Column("mu_without_viscous", "μ without f_v", significant(3)),
        Column("mu_without_viscous_standard_error", "±", significant(2)),
    )
    viscous = coulomb_test.coulomb_viscous_mN(results.model.viscous)
    weight = coulomb_test.coulomb_weight_mN()
    whole, without = coulomb_test.coulomb_coefficient(), coulomb_test.coulomb_coefficient(viscous)
    rows: list[tuple[Cell, ...]] = [
        ("the paper's force, as printed", published.COULOMB_FORCE_MN, None, viscous, whole, None, without, None),
        _simulated_coulomb_row("the model that was simulated", results.model.friction_coefficient, viscous, weight),
    ]
    found = results.coulomb
    if found is not None:
        own = results.of_run.get(found.file, results.model).friction_coefficient
        rows.append(_simulated_coulomb_row("the same with this run’s own μ", own, viscous, weight))
        estimates = (found.force, found.mu, found.mu_without_viscous)
        force, mu_all, mu_less = (_value_and_error(one) for one in estimates)
        rows.append(("identified from the simulated run", *force, found.viscous_mN, *mu_all, *mu_less))
    return Table("coulomb", "The Coulomb test at 0.5 mm/s with 50.1 g", columns, tuple(rows))


def _simulated_coulomb_row(source: str, mu: float, viscous_mN: float, weight_mN: float) -> tuple[Cell, ...]:
    force = mu * weight_mN + viscous_mN
    return source, force, None, viscous_mN, force / weight_mN, None, mu, None


def _force_table(results: PaperReportData) -> Table:
    forces = steady_forces(published.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
    columns = (
        SPEED_COLUMN,
        *(Column(f"{name}_mN", f"{name}, mN", decimals(2)) for name in ("f_e", "f_v", "f_c", "total")),
        Column("f_e_share", "share of f_e", percent()),
    )
    values = (forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, forces.f_e / forces.total)
    return Table("forces", "The model's forces at steady speed", columns, _rows_of_columns(*values))


def _drag_table(results: PaperReportData) -> Table:
    columns = (
        SPEED_COLUMN,
        Column("runs", "runs", shortest()),
        Column("measured_mN", "measured, mN", decimals(2)),
        Column("measured_low_mN", "95 % from", decimals(2)),
        Column("measured_high_mN", "to", decimals(2)),
        *(Column(f"{name}_mN", f"{name}, mN", decimals(2)) for name in ("f_e", "f_v", "f_c", "model")),
        Column("difference_mN", "measured − model", decimals(2)),
        Column("ln_law_mN", "ln v law, mN", decimals(2)),
        Column("simulated_model_mN", "as simulated, mN", decimals(2)),
    )
    drag = results.identification.drag
    points = () if drag is None else drag.points
    setup = DragSetup(results.capsule, results.wall_thickness_mm)
    put_in = steady_force_parts(setup, results.model, np.array([one.speed_mm_s for one in points])).total.tolist()
    rows = []
    for one, simulated in zip(points, put_in, strict=True):
        law = None if drag is None or drag.log_law is None else drag.log_law
        fitted = None if law is None else law.intercept.value + law.slope.value * float(np.log(one.speed_mm_s))
        measured = one.force.value
        low, high = one.force.interval or (None, None)
        less = None if measured is None else measured - one.model_mN
        by_model = (one.f_e_mN, one.f_v_mN, one.f_c_mN, one.model_mN)
        rows.append((one.speed_mm_s, one.runs, measured, low, high, *by_model, less, fitted, simulated))
    return Table("drag", "Steady drag of the simulated runs beside the identified model", columns, tuple(rows))


def _determination_table(results: PaperReportData) -> Table:

    drag = results.identification.drag

    return Table.of(
        "determination",
        "How the identified model explains the simulated runs",
        () if drag is None else drag.determination,
        Field("band", "simulated runs, band", lambda one: one.band),
        Field("speeds", "speeds", lambda one: one.speeds, shortest()),
        Field("eq15_ratio", "ratio of Eq. 15", lambda one: one.eq15, decimals(4)),
        Field("squared_correlation", "squared correlation", lambda one: one.correlation, decimals(4)),
    )


def _eq15_example_table() -> Table:

    return Table.of(
        "eq15-examples",
        "Eq. 15 beside the squared correlation, above 20 mm/s",
        determination_examples(),
        Field("made_up_measurement", "made-up measurement", lambda one: one.name),
        Field("eq15_ratio", "ratio of Eq. 15", lambda one: one.eq15, decimals(4)),
        Field("squared_correlation", "squared correlation", lambda one: one.correlation, decimals(4)),
    )


def _findings_table(results: PaperReportData) -> Table:
    columns = (
        Column("finding", "finding"),
        Column("title", "title"),
        Column("where", "where"),
        Column("quantity", "quantity"),
        Column("value", "value"),
        Column("unit", "unit"),
    )
    rows = tuple(
        (one.key, one.title, one.where, number.quantity, number.value, number.unit)
        for one in results.findings
        for number in one.numbers
    )
    return Table("findings", "What does not fit together, every number", columns, rows)


def _rows_of_columns(*columns: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> tuple[tuple[Cell, ...], ...]:
    return tuple(tuple(map(float, row)) for row in zip(*columns, strict=True))


def _value_and_error(estimate: Estimate) -> tuple[float | None, float | None]:
    return estimate.value, estimate.standard_error


def paper_document(results: PaperReportData, tables: Mapping[str, Table], model: str | None = None) -> Document:
    """Lay out the report; `tables` are from `paper_tables`, `model` names the file of the identified model."""
    return Document(
        title=PAPER_TITLE,
        lead=(
            "What the friction model of “Modeling of Velocity-dependent Frictional Resistance of a Capsule Robot "
            "Inside an Intestine” (2012) predicts, what comes back when its tests are simulated and identified, and "
            "where the paper is inconsistent. Nothing here was measured on a gut: every run is simulated, and the "
            "paper's own data are not in its text.",
        ),
        sections=(
            _settings_section(results),
            _wall_section(results, tables),
            _skew_section(results, tables),
            _coulomb_section(results, tables),
            Section(
                "forces",
                "5. The parts of the friction against speed (Fig. 9)",
                (_forces_drawing(results), _with_file(tables["forces"])),
            ),
            _joint_section(results, tables, model),
            _drag_section(results, tables),
            _findings_section(results, tables),
            _files_section(tables, model),
        ),
    )


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
    def draw() -> "MatplotlibFigure":
        from dragrig.present.model_figures import wall_figure

        identified: dict[str, list[tuple[float, EstimatedQuantity]]] = {}
        for row in results.elements:
            if row.identified is not None:
                identified.setdefault(row.published.parameter, []).append((row.published.strain, row.identified))
        return wall_figure(identified)

    relaxation = results.identification.relaxation
    fits = () if relaxation is None else relaxation.fits
    elements = _with_file(tables["elements"])
    shown = ("element", "strain", "unit", "table1", "eq14", "eq14_relative_difference", "quadratic")
    names = (*shown[:3], "simulated", "identified", "identified_low", "identified_high")
    differences = ("identified_relative_difference_from_simulated", "table1")
    identified = elements.select(*names, *differences, "identified_relative_difference_from_table1")
    has_identified = any(row.identified is not None for row in results.elements)
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
                draw,
            ),
            elements.select(*shown, "quadratic_relative_difference"),
            Section(
                "identified-elements",
                "Identified from the simulated relaxations",
                (replace(identified, name="identified-elements-table"),) if has_identified else (),
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
    def draw() -> "MatplotlibFigure":
        from dragrig.present.model_figures import skew_figure

        return skew_figure(results.model, results.capsule, results.wall_thickness_mm)

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
                draw,
            ),
            _with_file(tables["skew-maximum"]),
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

        def draw() -> "MatplotlibFigure":
            from dragrig.present.identification_figures import coulomb_figure

            return coulomb_figure(trace, results.coulomb, published.COULOMB_FORCE_MN)

        blocks.append(
            Figure(
                "coulomb-run",
                "Force of the simulated Coulomb test against time, raw and filtered, its mean and the printed one.",
                "After the paper's Fig. 8: the simulated run, zero subtracted. The orange line is the paper's mean.",
                draw,
            )
        )
    coulomb = results.identification.coulomb
    remarks = Items(() if coulomb is None else coulomb.remarks, remarks=True)
    blocks += [_with_file(tables["coulomb"]), remarks]
    return Section("coulomb", "4. Coulomb friction at 0.5 mm/s (Fig. 8)", tuple(blocks))


def _forces_drawing(results: PaperReportData) -> Figure:
    def draw() -> "MatplotlibFigure":
        from dragrig.present.model_figures import forces_figure

        return forces_figure(results.model, results.capsule, results.wall_thickness_mm, published.SPEEDS_MM_S)

    return Figure(
        "force-curves",
        "Environmental resistance, viscous friction, Coulomb friction and their sum against speed.",
        "After the paper's Fig. 9, by the model that was simulated.",
        draw,
    )


def _joint_section(results: PaperReportData, tables: Mapping[str, Table], model: str | None) -> Section:
    fit = results.identification.joint
    heading = "6. Joint fit of all runs"
    if fit is None:
        return Section("joint", heading, (Text("There was no joint fit."),))

    def draw() -> "MatplotlibFigure":
        from dragrig.present.identification_figures import joint_fit_figure

        return joint_fit_figure(fit)

    drawing = Figure(
        "joint-fit",
        "Left, the 95 % interval of each parameter before and after the runs, and of their combinations; right, χ² per "
        "degree of freedom of each run.",
        "The joint fit. Left, on a scale on which all parameters were known equally well before; right, 1 where only "
        "noise and the variation between runs remain.",
        draw,
    )
    if not fit.converged:
        failed = Text("The joint fit did not converge, so that none of its numbers is reported.")
        return Section("joint", heading, (failed, drawing, Items(fit.remarks, remarks=True)))
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
            drawing,
            _with_file(tables["parameters"]).select(
                "parameter", "value", "low", "high", "simulated", "prior_low", "prior_high", "learnt", "meaning"
            ),
            Text(f"{learnt} The runs do not determine {unknown}." if unknown else learnt),
            Items(fit.remarks, remarks=True),
            _with_file(tables["combinations"]),
            Section("specimen-model", "This specimen on the simulated rig", dry_run if model else ()),
        ),
    )


def _drag_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    drag = results.identification.drag
    heading = "7. The model's curve with simulated measurements (Fig. 11)"
    if drag is None:
        return Section("drag", heading, (Text("No drag was identified."),))

    def draw() -> "MatplotlibFigure":
        return _drag_figure(drag, results)

    own = ", the paper's own" if results.model == published.PAPER_MODEL else ""
    beside = (
        "The zero of each run comes from the joint fit, and so does the model beside the runs; “as simulated” is the "
        f"curve of the simulated model{own}."
        if results.identified_model is not None
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
                draw,
            ),
            _with_file(tables["drag"]).select(
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
                    _with_file(tables["determination"]),
                ),
            ),
            Section("drag-log-law", "ln v", (Text(_log_law_text(drag)),)),
            Section("drag-boundary", "Boundary", (Text(boundary),)),
            Items(drag.remarks, remarks=True),
        ),
    )


def _drag_figure(drag: DragResult, results: PaperReportData) -> "MatplotlibFigure":
    from dragrig.present.identification_figures import drag_figure

    identified = results.identified_model
    return drag_figure(
        drag,
        identified or results.model,
        results.capsule,
        results.wall_thickness_mm,
        published.BOUNDARY_MM_S,
        published.SENSOR_ACCURACY_MN,
        "simulated",
        results.model if identified is not None else None,
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
    verdict = ": the growth is not logarithmic" if law.lack_of_fit_p < MAX_LOG_LAW_P else ""
    return f"{text} The probability that runs which follow it deviate as much as these is {chance} %{verdict}."


def _findings_section(results: PaperReportData, tables: Mapping[str, Table]) -> Section:
    examples = _with_file(tables["eq15-examples"])
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


def _with_file(table: Table) -> Table:
    return replace(table, file=f"{table.name}.csv")


def _two_digit_percent(value: float) -> str:
    return f"{100 * value:.2g} %"
