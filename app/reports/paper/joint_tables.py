"""The report's tables of the joint fit: what comes back of everything that was put in."""

from collections.abc import Mapping
from math import prod

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import Identified, JointFit, RunResidual
from dragrig.analysis.identification.results.joint import DETERMINED
from dragrig.analysis.nominal.capsule_parameters import COMBINATIONS, VARIATIONS
from dragrig.analysis.nominal.protocol import Variation
from dragrig.config.model import FrictionModelSettings
from dragrig.reports.paper.results import PaperResults
from dragrig.reports.tabular import Cell, Column, Table, digits, places

VALUE = Column("value", "identified")
INTERVAL = (Column("low", "95 % from"), Column("high", "to"))
SIMULATED = Column("simulated", "simulated")
MEANINGS = {one.name: one.meaning for one in COMBINATIONS}
POWERS: dict[str, Mapping[str, float]] = {one.name: one.powers for one in COMBINATIONS}


def joint_tables(results: PaperResults) -> tuple[Table, ...]:
    """Return parameters, their combinations, and how each run is left; empty without a joint fit that converged."""
    joint = results.identification.joint
    fit = joint if joint is not None and joint.converged else None
    return _parameters(fit, results.model), _combinations(fit, results.model), _runs(fit, results)


def simulated(name: str, model: FrictionModelSettings) -> float:
    """Return what a parameter or a combination of the capsule model was simulated with."""
    if name in POWERS:
        return prod(float(float(getattr(model, factor)) ** power) for factor, power in POWERS[name].items())
    return float(getattr(model, name))


def held(found: tuple[Identified, ...], model: FrictionModelSettings) -> tuple[int, int]:
    """Return how many of the intervals that the runs determine hold what was simulated, and how many there are."""
    known = [one for one in found if one.determined]
    return sum(one.interval[0] <= simulated(one.name, model) <= one.interval[1] for one in known), len(known)


def _value(one: Identified) -> tuple[float | None, float | None, float | None]:
    """Return value and interval; nothing of what the runs do not determine."""
    return (one.value, *one.interval) if one.determined else (None, None, None)


def _parameters(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        Column("parameter", "parameter"),
        VALUE,
        *INTERVAL,
        SIMULATED,
        Column("prior_low", "before: from"),
        Column("prior_high", "to"),
        Column("learnt", "learnt", lambda value: f"{100 * value:.0f} %"),
        Column("meaning", "what it is"),
        Column("standard_error", "±", digits(2)),
        Column("unit", "unit"),
    )
    rows = () if fit is None else tuple(_parameter(one, model) for one in fit.parameters)
    return Table("parameters", "All parameters from all runs at once", columns, rows)


def _parameter(one: Identified, model: FrictionModelSettings) -> tuple[Cell, ...]:
    error = one.standard_error if one.determined else None
    numbers = (*_value(one), simulated(one.name, model), *one.prior, one.learnt)
    return one.name, *numbers, one.meaning, error, one.unit


def _combinations(fit: JointFit | None, model: FrictionModelSettings) -> Table:
    columns = (
        Column("combination", "combination"),
        VALUE,
        *INTERVAL,
        SIMULATED,
        Column("half_width", "±", lambda value: f"{100 * value:.2g} %"),
        Column("meaning", "what it is"),
    )
    rows = tuple(
        (
            *(one.name, *_value(one), simulated(one.name, model)),
            *(one.half_width if one.determined else None, MEANINGS[one.name]),
        )
        for one in (() if fit is None else fit.combinations)
    )
    return Table("combinations", "What the parameters combine to", columns, rows)


def _runs(fit: JointFit | None, results: PaperResults) -> Table:
    columns = (
        Column("file", "run"),
        Column("kind", "kind"),
        Column("chi2_per_degree", "χ² per degree", places(2)),
        Column("rms_mN", "rms, mN", places(2)),
        Column("zero_mN", "zero, mN", places(2)),
        Column("zero_standard_error_mN", "±", places(2)),
        Column("stiffness_factor", "stiffness ×", places(3)),
        Column("simulated_stiffness_factor", "simulated", places(3)),
        Column("friction_factor", "friction ×", places(3)),
        Column("simulated_friction_factor", "simulated", places(3)),
    )
    rows = () if fit is None else tuple(_run(one, results) for one in fit.runs)
    return Table(
        "joint-runs", "What the joint fit leaves of each run, and the run’s own zero and factors", columns, rows
    )


def _run(one: RunResidual, results: PaperResults) -> tuple[Cell, ...]:
    own, model = results.of_run.get(one.file, results.model), results.model
    put_in = {
        "stiffness": own.stiffness_scale / model.stiffness_scale,
        "friction": own.friction_coefficient / model.friction_coefficient,
    }
    factors = [cell for variation in VARIATIONS for cell in _factor(one, variation, put_in[variation.name])]
    return one.file, one.kind, one.chi2, one.rms_mN, one.zero.value, one.zero.standard_error, *factors


def _factor(one: RunResidual, variation: Variation, put_in: float) -> tuple[Cell, Cell]:
    """Return a run's factor and what it was simulated with; nothing of a factor that the run does not show."""
    found = one.factors.get(variation.name, Estimate())
    shown = found.standard_error is not None and found.standard_error < variation.sd * (1 - DETERMINED)
    return (found.value, put_in) if shown else (None, None)
