"""The report's tables."""

import numpy as np

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.nominal_drag import Setup, parts
from dragrig.analysis.paper import coulomb_test, printed
from dragrig.analysis.paper.determination import examples
from dragrig.analysis.paper.wall import SYMBOLS
from dragrig.figures.model import SKEW_SPEEDS
from dragrig.reports.paper.joint_tables import joint_tables
from dragrig.reports.paper.results import PaperResults
from dragrig.reports.tabular import Cell, Column, Table, digits, places, plainly, share
from dragrig.sim_backend.friction import skew_resistance, steady_forces

SPEED = Column("speed_mm_s", "v, mm/s", plainly)
SKEW_POINTS = 120


def tables(results: PaperResults) -> dict[str, Table]:
    """Return all tables by name."""
    made = (
        _elements(results),
        _skew_maximum(results),
        _skew(results),
        _coulomb(results),
        _forces(results),
        *joint_tables(results),
        _drag(results),
        _determination(results),
        _examples(),
        _findings(results),
    )
    return {table.name: table for table in made}


def _elements(results: PaperResults) -> Table:
    columns = (
        Column("element", "element"),
        Column("strain", "strain", lambda value: f"{100 * value:g} %"),
        Column("unit", "unit"),
        Column("table1", "Table 1"),
        Column("eq14", "Eq. 14"),
        Column("eq14_relative_difference", "from Table 1", share),
        Column("quadratic", "quadratic"),
        Column("quadratic_relative_difference", "from Table 1", share),
        Column("simulated", "simulated"),
        Column("identified", "identified"),
        Column("identified_low", "95 % from"),
        Column("identified_high", "to"),
        Column("identified_relative_difference_from_simulated", "from simulated", share),
        Column("identified_relative_difference_from_table1", "from Table 1", share),
    )
    rows = []
    for row in results.elements:
        one, found = row.published, row.identified
        value, low, high = (None, None, None) if found is None else (found.value, *found.interval)
        rows.append(
            (
                *(SYMBOLS[one.parameter], one.strain, row.unit, one.table1, one.eq14, one.eq14_difference),
                *(one.quadratic, one.quadratic_difference, row.simulated, value, low, high),
                *(row.difference, row.difference_from_table1),
            )
        )
    return Table("elements", "The wall's five elements: published, simulated, identified", columns, tuple(rows))


def _skew_maximum(results: PaperResults) -> Table:
    forces = steady_forces(printed.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
    columns = (
        SPEED,
        Column("largest_skew_mN", "largest P(x) S, mN"),
        Column("x_of_largest_skew_mm", "at x, mm", digits(3)),
        Column("skew_at_equator_mN", "P(L) S, mN"),
    )
    values = (forces.speed_mm_s, forces.max_skew, forces.x_of_max_skew, forces.side_pressure_force)
    return Table("skew-maximum", "Largest skew resistance, and where it lies", columns, _rows(*values))


def _skew(results: PaperResults) -> Table:
    length = 0.5 * results.capsule.diameter_mm * np.sin(np.radians(results.capsule.contact_angle_deg))
    x = np.append(np.linspace(0.0, length, SKEW_POINTS), length + results.model.side_contact_mm)
    curves = [
        skew_resistance(x, speed, results.model, results.capsule, results.wall_thickness_mm) for speed in SKEW_SPEEDS
    ]
    columns = (Column("x_mm", "x, mm"), *(Column(f"skew_mN_at_{speed:g}_mm_s", f"{speed:g}") for speed in SKEW_SPEEDS))
    return Table("skew-resistance", "Skew resistance along the contact", columns, _rows(x, *curves))


def _coulomb(results: PaperResults) -> Table:
    columns = (
        Column("source", "source"),
        Column("force_mN", "mean force, mN"),
        Column("force_standard_error_mN", "±", digits(2)),
        Column("viscous_mN", "of it viscous, mN", digits(2)),
        Column("mu", "μ, all Coulomb", digits(3)),
        Column("mu_standard_error", "±", digits(2)),
        Column("mu_without_viscous", "μ without f_v", digits(3)),
        Column("mu_without_viscous_standard_error", "±", digits(2)),
    )
    viscous = coulomb_test.viscous_mN(results.model.viscous)
    weight = coulomb_test.weight_mN()
    whole, without = coulomb_test.coefficient(), coulomb_test.coefficient(viscous)
    rows: list[tuple[Cell, ...]] = [
        ("the paper's force, as printed", printed.COULOMB_FORCE_MN, None, viscous, whole, None, without, None),
        _simulated("the model that was simulated", results.model.friction_coefficient, viscous, weight),
    ]
    found = results.coulomb
    if found is not None:
        own = results.of_run.get(found.file, results.model).friction_coefficient
        rows.append(_simulated("the same with this run’s own μ", own, viscous, weight))
        estimates = (found.force, found.mu, found.mu_without_viscous)
        force, mu_all, mu_less = (_pair(one) for one in estimates)
        rows.append(("identified from the simulated run", *force, found.viscous_mN, *mu_all, *mu_less))
    return Table("coulomb", "The Coulomb test at 0.5 mm/s with 50.1 g", columns, tuple(rows))


def _simulated(source: str, mu: float, viscous_mN: float, weight_mN: float) -> tuple[Cell, ...]:
    force = mu * weight_mN + viscous_mN
    return source, force, None, viscous_mN, force / weight_mN, None, mu, None


def _forces(results: PaperResults) -> Table:
    forces = steady_forces(printed.SPEEDS_MM_S, results.model, results.capsule, results.wall_thickness_mm)
    columns = (
        SPEED,
        *(Column(f"{name}_mN", f"{name}, mN", places(2)) for name in ("f_e", "f_v", "f_c", "total")),
        Column("f_e_share", "share of f_e", lambda value: f"{100 * value:.0f} %"),
    )
    values = (forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, forces.f_e / forces.total)
    return Table("forces", "The model's forces at steady speed", columns, _rows(*values))


def _drag(results: PaperResults) -> Table:
    columns = (
        SPEED,
        Column("runs", "runs", plainly),
        Column("measured_mN", "measured, mN", places(2)),
        Column("measured_low_mN", "95 % from", places(2)),
        Column("measured_high_mN", "to", places(2)),
        *(Column(f"{name}_mN", f"{name}, mN", places(2)) for name in ("f_e", "f_v", "f_c", "model")),
        Column("difference_mN", "measured − model", places(2)),
        Column("ln_law_mN", "ln v law, mN", places(2)),
        Column("simulated_model_mN", "as simulated, mN", places(2)),
    )
    drag = results.identification.drag
    points = () if drag is None else drag.points
    setup = Setup(results.capsule, results.wall_thickness_mm)
    put_in = parts(setup, results.model, np.array([one.speed_mm_s for one in points])).total.tolist()
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


def _determination(results: PaperResults) -> Table:
    columns = (
        Column("band", "simulated runs, band"),
        Column("speeds", "speeds", plainly),
        Column("eq15_ratio", "ratio of Eq. 15", places(4)),
        Column("squared_correlation", "squared correlation", places(4)),
    )
    drag = results.identification.drag
    rows = tuple(
        (one.band, one.speeds, one.eq15, one.correlation) for one in (() if drag is None else drag.determination)
    )
    return Table("determination", "How the identified model explains the simulated runs", columns, rows)


def _examples() -> Table:
    columns = (
        Column("made_up_measurement", "made-up measurement"),
        Column("eq15_ratio", "ratio of Eq. 15", places(4)),
        Column("squared_correlation", "squared correlation", places(4)),
    )
    rows = tuple((one.name, one.eq15, one.correlation) for one in examples())
    return Table("eq15-examples", "Eq. 15 beside the squared correlation, above 20 mm/s", columns, rows)


def _findings(results: PaperResults) -> Table:
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


def _rows(*columns: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> tuple[tuple[Cell, ...], ...]:
    return tuple(tuple(map(float, row)) for row in zip(*columns, strict=True))


def _pair(estimate: Estimate) -> tuple[float | None, float | None]:
    return estimate.value, estimate.standard_error
