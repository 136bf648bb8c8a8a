"""The report on the paper's programme, simulated and identified: tables, figures, page."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

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
from dragrig.analysis.paper import friction_findings as coulomb_test
from dragrig.analysis.paper import published as printed
from dragrig.analysis.paper.friction_findings import determination_examples
from dragrig.analysis.paper.published import PaperFinding, percent, rounded
from dragrig.analysis.paper.reproduction import ElementRow
from dragrig.analysis.paper.wall_findings import ELEMENT_SYMBOLS
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Capsule
from dragrig.present.document import (
    Cell,
    Column,
    InlineFigure,
    Table,
    decimals,
    general_format,
    percent_difference,
    significant,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.friction_model import SKEW_SPEEDS_MM_S, forces_figure, skew_figure, wall_figure
from dragrig.present.html_page import render_template
from dragrig.present.identification_figures import coulomb_figure, drag_figure, joint_fit_figure
from dragrig.present.run_figures import value_with_error
from dragrig.rig.runfile.model import Run
from dragrig.rig.session import software_version
from dragrig.sim_backend.friction import skew_resistance, steady_forces


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
        Column("learnt", "learnt", lambda value: f"{100 * value:.0f} %"),
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
        Column("half_width", "±", lambda value: f"{100 * value:.2g} %"),
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


SPEED_COLUMN = Column("speed_mm_s", "v, mm/s", general_format)
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
        Column("strain", "strain", lambda value: f"{100 * value:g} %"),
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
    forces = steady_forces(printed.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
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
        ("the paper's force, as printed", printed.COULOMB_FORCE_MN, None, viscous, whole, None, without, None),
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
    forces = steady_forces(printed.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
    columns = (
        SPEED_COLUMN,
        *(Column(f"{name}_mN", f"{name}, mN", decimals(2)) for name in ("f_e", "f_v", "f_c", "total")),
        Column("f_e_share", "share of f_e", lambda value: f"{100 * value:.0f} %"),
    )
    values = (forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, forces.f_e / forces.total)
    return Table("forces", "The model's forces at steady speed", columns, _rows_of_columns(*values))


def _drag_table(results: PaperReportData) -> Table:
    columns = (
        SPEED_COLUMN,
        Column("runs", "runs", general_format),
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
    columns = (
        Column("band", "simulated runs, band"),
        Column("speeds", "speeds", general_format),
        Column("eq15_ratio", "ratio of Eq. 15", decimals(4)),
        Column("squared_correlation", "squared correlation", decimals(4)),
    )
    drag = results.identification.drag
    rows = tuple(
        (one.band, one.speeds, one.eq15, one.correlation) for one in (() if drag is None else drag.determination)
    )
    return Table("determination", "How the identified model explains the simulated runs", columns, rows)


def _eq15_example_table() -> Table:
    columns = (
        Column("made_up_measurement", "made-up measurement"),
        Column("eq15_ratio", "ratio of Eq. 15", decimals(4)),
        Column("squared_correlation", "squared correlation", decimals(4)),
    )
    rows = tuple((one.name, one.eq15, one.correlation) for one in determination_examples())
    return Table("eq15-examples", "Eq. 15 beside the squared correlation, above 20 mm/s", columns, rows)


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


def inline_paper_figures(results: PaperReportData) -> dict[str, InlineFigure]:
    """Draw all figures; what was not identified is missing."""
    model, capsule, thickness = results.model, results.capsule, results.wall_thickness_mm
    drawn = {
        "wall": inline_figure(
            wall_figure(_identified_elements(results)),
            "Five panels, one for each element against strain: Table 1's points, Eq. 14's curve, which misses them, "
            "the quadratic through them, and the identified values with their intervals.",
            "The wall's elements against strain.",
        ),
        "skew": inline_figure(
            skew_figure(model, capsule, thickness),
            "Skew resistance along the contact at six speeds; each curve rises to a maximum inside the hemisphere and "
            "falls towards the equator, beside the capsule it stays constant for 20 mm.",
            "After the paper's Fig. 7. A dot marks each curve's largest value.",
        ),
        "forces": inline_figure(
            forces_figure(model, capsule, thickness, printed.SPEEDS_MM_S),
            "Environmental resistance, viscous friction, Coulomb friction and their sum against speed.",
            "After the paper's Fig. 9, by the model that was simulated.",
        ),
    }
    if results.coulomb_trace is not None:
        drawn["coulomb"] = inline_figure(
            coulomb_figure(results.coulomb_trace, results.coulomb, printed.COULOMB_FORCE_MN),
            "Force of the simulated Coulomb test against time, raw and filtered, with its mean and the printed one.",
            "After the paper's Fig. 8: the simulated run, zero taken off. The orange line is the paper's mean.",
        )
    joint = results.identification.joint
    if joint is not None:
        drawn["joint"] = inline_figure(
            joint_fit_figure(joint),
            "Left, the 95 % interval of each parameter before and after the runs, and of what they combine to; right, "
            "χ² per degree of freedom of each run.",
            "The joint fit. Left, on a scale on which all parameters were known equally well before; right, 1 where "
            "nothing but noise and the variation between runs is left.",
        )
    drag = results.identification.drag
    if drag is not None:
        drawn["drag"] = _inline_drag_figure(drag, results)
    return drawn


def _inline_drag_figure(drag: DragResult, results: PaperReportData) -> InlineFigure:
    found = results.identified_model
    figure = drag_figure(
        drag,
        found or results.model,
        results.capsule,
        results.wall_thickness_mm,
        printed.BOUNDARY_MM_S,
        printed.SENSOR_ACCURACY_MN,
        "simulated",
        results.model if found is not None else None,
    )
    return inline_figure(
        figure,
        "Measured drag of the simulated runs with intervals against speed, the curves of the identified and of the "
        "simulated model, and the fitted logarithm; below, the differences from the identified model.",
        "After the paper's Fig. 11: simulated runs in place of the paper's measurements, which its text does not hold, "
        "the model as it was identified from all runs, and the model that was simulated. Bars are 95 % intervals.",
    )


def _identified_elements(results: PaperReportData) -> dict[str, list[tuple[float, EstimatedQuantity]]]:
    found: dict[str, list[tuple[float, EstimatedQuantity]]] = {}
    for row in results.elements:
        if row.identified is not None:
            found.setdefault(row.published.parameter, []).append((row.published.strain, row.identified))
    return found


PAPER_TITLE = "The paper's programme, simulated and identified"
_WALL_TEXTS = {"eq14": "Eq. 14, as printed", "table1": "the least-squares quadratic through Table 1"}
_VISCOUS_TEXTS = {"published": "δ v, as published", "newtonian": "δ (v/d) S, dimensionally consistent"}


def paper_page(
    results: PaperReportData,
    tables: Mapping[str, Table],
    pictures: Mapping[str, InlineFigure],
    model: str | None = None,
) -> str:
    """Return the whole report as one HTML page; `model` names the file of the identified model beside it."""
    return render_template(
        "paper.html",
        {
            "title": PAPER_TITLE,
            "settings": _simulation_settings(results),
            "wall": _WALL_TEXTS.get(results.model.wall, results.model.wall),
            "papers_own": results.model == printed.PAPER_MODEL,
            "elements": _element_agreement(results.elements),
            "joint": _joint_fit_summary(results),
            "model": model,
            "identification": results.identification,
            "findings": results.findings,
            "tables": tables,
            "printed": printed,
            "spelled": rounded,
            "percent": percent,
            "with_error": value_with_error,
            "pictures": pictures,
        },
    )


def _simulation_settings(results: PaperReportData) -> dict[str, str]:
    simulated, model = results.rig.simulated, results.model
    noise, variation = simulated.noise, simulated.variation
    return {
        "Software": f"{software_version()}, simulated rig",
        "Seed": str(simulated.seed),
        "Programme": f"plan paper: {results.runs} runs, ways back included, at {results.rig.sampling.rate_hz:g} Hz",
        "Wall": _WALL_TEXTS.get(model.wall, model.wall),
        "Viscous friction": _VISCOUS_TEXTS[model.viscous],
        "Coulomb friction": f"μ = {model.friction_coefficient:g}",
        "Sensor": f"noise {noise.white_mN:g} mN white and {noise.slow_mN:g} mN slow ({noise.slow_correlation_s:g} s), "
        f"zero off by {noise.zero_mN:g} mN (standard deviation) in each run",
        "Between runs": f"stiffness varies by {100 * variation.run_stiffness:g} %, "
        f"μ by {100 * variation.run_friction:g} % (standard deviations)",
    }


def _joint_fit_summary(results: PaperReportData) -> dict[str, object] | None:
    """Say what the joint fit gave back; None without one that converged."""
    fit = results.identification.joint
    if fit is None or not fit.converged:
        return None
    return {
        "fit": fit,
        "parameters": intervals_holding_truth(fit.parameters, results.model),
        "combinations": intervals_holding_truth(fit.combinations, results.model),
        "unknown": [one.name for one in fit.parameters if not one.determined],
    }


def _element_agreement(rows: tuple[ElementRow, ...]) -> dict[str, object]:
    """Say how the identified elements agree with what was simulated."""
    found = [row for row in rows if row.identified is not None]
    worst = max((abs(row.difference or 0.0) for row in found), default=0.0)
    return {
        "all": len(rows),
        "found": len(found),
        "inside": sum(bool(row.inside) for row in found),
        "worst": percent(worst).removeprefix("+"),
    }
