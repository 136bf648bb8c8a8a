"""An identification laid out for a reader: joint fit, relaxation, Coulomb friction, drag, and what was left out."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite, isnan, sqrt

from dragrig.analysis.estimates import Estimate, EstimatedQuantity
from dragrig.analysis.gap.diagnosis_text import join_names
from dragrig.analysis.identification.identification import (
    CoulombResult,
    CoulombRun,
    DragResult,
    Identification,
    JointFit,
    LogLaw,
    ParameterEstimate,
    RelaxationFit,
    RelaxationResult,
    RunResidual,
    SpeedPoint,
    StrainLaw,
)
from dragrig.present.document import (
    Block,
    Cell,
    Column,
    Document,
    Facts,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
)
from dragrig.present.json_values import exclusions_json, to_json_object
from dragrig.present.numbers import (
    UNKNOWN,
    decimals,
    estimate_text,
    interval_text,
    p_value_text,
    percent,
    range_text,
    rounded_to_error,
    shortest,
    unit_text,
    value_with_error,
)
from dragrig.rig.arrays import FloatArray

CHI2_ALERT_SD = 4.0
"""Standard deviations of χ² above which a run is pointed out."""
MAX_RELATIVE_WIDTH = 10.0
"""A half-width of more than ten times the value says nothing and is not shown."""
STRONG_CORRELATION = 0.9
"""Correlation from which two elements are called hard to distinguish."""
MAX_LOG_LAW_P = 0.01
"""p-value of the lack of fit below which the forces are said to deviate from the logarithmic law."""


def identification_document(identification: Identification) -> Document:
    """Lay out an identification."""
    joint, used = identification.joint, len(identification.used)
    parts = (identification.relaxation, identification.coulomb, identification.drag)
    # A nominal model such as the drive alone has none of the parts of the friction model.
    sections = () if joint is not None and not any(parts) else tuple(_part_sections(identification))
    columns = (Column("what", "what"), Column("reason", "reason"))
    left_out = tuple((exclusion.what, exclusion.reason) for exclusion in identification.left_out)
    return Document(
        title=f"Specimen {identification.specimen}: {used} of {used + len(left_out)} runs used",
        lead=("Intervals hold 95 %; ± is a standard error.",),
        sections=(
            Section("joint", "Joint fit", (Text("None."),) if joint is None else _joint_blocks(joint)),
            *sections,
            Section("left-out", "Left out", (Table("exclusions", "", columns, left_out),)),
            Section("remarks", "", (Items(identification.remarks, remarks=True),)),
        ),
        data=identification_json(identification),
    )


def identified_campaigns_document(campaigns: Sequence[tuple[str, Identification | None, str]]) -> Document:
    """Lay out the joint fits of several campaigns: folder, identification, and why there is none."""
    fits = [result.joint for _, result, _ in campaigns if result is not None and result.joint is not None]
    names = list(dict.fromkeys(parameter.name for fit in fits for parameter in fit.parameters))
    columns = (Column("campaign", "campaign"), *(Column(name, name) for name in names))
    rows = tuple((source, *_campaign_cells(result, names)) for source, result, _ in campaigns)
    return Document(
        title=f"{len(rows)} campaigns",
        lead=(f"Value ± standard error of the joint fits; {UNKNOWN} is not determined by the runs.",),
        sections=(
            Section("parameters", "", (Table("campaigns", "", columns, rows),)),
            Section("failed", "", (Items(tuple(why for *_, why in campaigns if why), remarks=True),)),
        ),
    )


def _campaign_cells(identification: Identification | None, names: Iterable[str]) -> Iterator[Cell]:
    joint = None if identification is None else identification.joint
    converged = joint is not None and joint.converged
    known = {parameter.name: parameter for parameter in joint.parameters if parameter.determined} if joint else {}
    for name in names:
        yield _value_cell(known.get(name), with_error=True) if converged else FormattedNumber(None, UNKNOWN)


def _joint_blocks(fit: JointFit) -> tuple[Block, ...]:
    parameters = (
        Column("parameter", "parameter"),
        Column("value", "value"),
        Column("interval_95", "95 % interval"),
        Column("unit", "unit"),
        Column("prior_95", "before the runs"),
        Column("learnt", "learnt", percent()),
        Column("meaning", "meaning"),
    )
    combinations = (
        Column("combination", "combination"),
        Column("value", "value"),
        Column("interval_95", "95 % interval"),
        Column("half_width", "±"),
        Column("unit", "unit"),
    )
    return (
        Text(_joint_fit_heading(fit)),
        Table("parameters", "", parameters, tuple(_parameter_row(parameter, fit) for parameter in fit.parameters)),
        Table(
            "combinations",
            "Combinations",
            combinations,
            tuple(_combination_row(product, fit) for product in fit.combinations),
        ),
        Items((*_joint_fit_warnings(fit), *fit.remarks), remarks=True),
        _residual_table(fit.runs),
    )


def _joint_fit_heading(fit: JointFit) -> str:
    if not fit.converged:
        return f"Fit of the {fit.nominal} model: did NOT converge in {fit.steps} steps; no interval below holds."
    chi2 = (
        f"χ² is {fit.chi2 / fit.degrees:.3g} per degree of freedom ({fit.degrees})"
        if fit.degrees
        else "no degree of freedom"
    )
    p_value = "p not known" if isnan(fit.p_value) else p_value_text(fit.p_value)
    heading = f"Fit of the {fit.nominal} model, {fit.steps} steps: {chi2}, {p_value}"
    if not fit.holds:
        return f"{heading}. The model leaves more than noise unexplained, so that no interval below need hold."
    if not any(parameter.determined for parameter in fit.parameters):
        return f"{heading}. These runs determine NONE of its parameters."
    return f"{heading}."


def _parameter_row(parameter: ParameterEstimate, fit: JointFit) -> tuple[Cell, ...]:
    """Return the cells of a parameter: no value that the runs do not determine, no interval that does not hold."""
    known = parameter.determined
    return (
        parameter.name,
        _value_cell(parameter if known else None),
        interval_text(parameter) if known and fit.converged else "",
        unit_text(parameter.unit),
        range_text(parameter.prior, parameter.standard_error),
        parameter.learnt if fit.converged else "",
        parameter.meaning,
    )


def _combination_row(product: ParameterEstimate, fit: JointFit) -> tuple[Cell, ...]:
    known = product.determined
    return (
        product.name,
        _value_cell(product if known else None),
        interval_text(product) if known and fit.converged else "",
        _half_width_text(product) if known and fit.converged else "",
        unit_text(product.unit),
    )


def _value_cell(quantity: EstimatedQuantity | None, *, with_error: bool = False) -> FormattedNumber:
    if quantity is None:
        return FormattedNumber(None, UNKNOWN)
    write = value_with_error if with_error else rounded_to_error
    return FormattedNumber(quantity.value, write(quantity.value, quantity.standard_error))


def _half_width_text(quantity: EstimatedQuantity) -> str:
    width = quantity.half_width
    return f"{shortest(2)(100 * width)} %" if width < MAX_RELATIVE_WIDTH else ""


def _joint_fit_warnings(fit: JointFit) -> Iterator[str]:
    unknown = [parameter.name for parameter in fit.parameters if not parameter.determined]
    if unknown:
        yield f"these runs do not determine {join_names(unknown)}"
    strange = [
        parameter.name
        for parameter in fit.parameters
        if parameter.determined and not parameter.prior[0] <= parameter.value <= parameter.prior[1]
    ]
    if strange:
        yield f"outside of the interval expected before the runs: {join_names(strange)}"
    unexplained = [run.file for run in fit.runs if _exceeds_noise(run)]
    if unexplained:
        yield f"the model leaves more than noise in {join_names(unexplained)}"


def _residual_table(runs: Sequence[RunResidual]) -> Table:
    factors = list(dict.fromkeys(name for run in runs for name in run.factors))
    offsets = list(dict.fromkeys(name for run in runs for name in run.offsets))
    columns = (
        Column("file", "run"),
        Column("kind", "kind"),
        Column("channel", "channel"),
        Column("chi2_per_degree", "χ² per degree", decimals(2)),
        Column("alert", ""),
        Column("rms_mN", "rms, mN", decimals(2)),
        Column("zero_mN", "zero, mN"),
        *(Column(name, f"{name} ×", decimals(3)) for name in factors),
        *(Column(name, name, decimals(1)) for name in offsets),
    )
    rows = tuple(
        (
            run.file,
            run.kind,
            run.channel,
            run.chi2,
            "!" if _exceeds_noise(run) else "",
            run.rms_mN,
            _estimate_cell(run.zero),
            *(_own_value(run.factors, name) for name in factors),
            *(_own_value(run.offsets, name) for name in offsets),
        )
        for run in runs
    )
    return Table("residuals", "What the fit leaves of each run", columns, rows)


def _own_value(estimates: Mapping[str, Estimate], name: str) -> Cell:
    return "" if name not in estimates else estimates[name].value


def _estimate_cell(estimate: Estimate) -> FormattedNumber:
    """Return an estimate with its error; why one is missing stands beside the result of all runs."""
    return FormattedNumber(estimate.value, value_with_error(estimate.value, estimate.standard_error))


def _exceeds_noise(run: RunResidual) -> bool:
    return run.blocks > 0 and run.chi2 > 1 + CHI2_ALERT_SD * sqrt(2 / run.blocks)


def _part_sections(identification: Identification) -> Iterator[Section]:
    none = (Text("Not identified."),)
    relaxation, coulomb, drag = identification.relaxation, identification.coulomb, identification.drag
    yield Section("relaxation", "Relaxation", none if relaxation is None else _relaxation_blocks(relaxation))
    yield Section("coulomb", "Coulomb friction", none if coulomb is None else _coulomb_blocks(coulomb))
    yield Section("drag", "Drag", none if drag is None else _drag_blocks(drag))


def _relaxation_blocks(relaxation: RelaxationResult) -> tuple[Block, ...]:
    elements = (
        Column("file", "run"),
        Column("strain", "strain"),
        Column("element", "element"),
        Column("value", "value"),
        Column("interval_95", "95 % interval"),
        Column("half_width", "±"),
        Column("unit", "unit"),
    )
    laws = (
        Column("element", "element"),
        Column("unit", "unit"),
        Column("law", "against strain ε"),
        Column("r2", "R²", decimals(3)),
        Column("strains", "strains"),
    )
    known = [fit for fit in relaxation.fits if fit.elements]
    return (
        Text(f"Five elements from {len(known)} of {len(relaxation.fits)} runs."),
        Table("elements", "", elements, tuple(row for fit in known for row in _element_rows(fit))),
        Items(tuple(f"{fit.file}: {text}" for fit in relaxation.fits for text in _relaxation_fit_sentences(fit))),
        Table("strain-laws", "Elements against strain", laws, tuple(map(_strain_law_row, relaxation.laws))),
        Items(relaxation.remarks, remarks=True),
    )


def _element_rows(fit: RelaxationFit) -> Iterator[tuple[Cell, ...]]:
    for place, quantity in enumerate((*fit.elements, *fit.times)):
        first = (fit.file, f"{100 * fit.shear_strain:.3g} %") if place == 0 else ("", "")
        value = _value_cell(quantity)
        yield (
            *first,
            element_symbol(quantity.name),
            value,
            interval_text(quantity),
            _half_width_text(quantity),
            quantity.unit,
        )


def _relaxation_fit_sentences(fit: RelaxationFit) -> Iterator[str]:
    if not fit.elements:
        yield f"no elements: {fit.remark or 'the fit gave none'}."
        return
    if not fit.converged:
        yield "the fit did NOT converge, so that none of its intervals holds."
    if fit.test is not None:
        yield fit.test.sentence
    if pairs := _correlated_pairs(fit):
        yield f"hard to distinguish: {', '.join(pairs)}."
    if fit.remark:
        yield f"{fit.remark}."


def _correlated_pairs(fit: RelaxationFit) -> list[str]:
    if fit.correlation is None:
        return []
    names = [element_symbol(element.name) for element in fit.elements]
    return [
        f"{names[row]} and {names[column]} (correlation {decimals(2)(fit.correlation[row, column])})"
        for row in range(len(names))
        for column in range(row)
        if abs(fit.correlation[row, column]) >= STRONG_CORRELATION
    ]


def _strain_law_row(law: StrainLaw) -> tuple[Cell, ...]:
    highest = len(law.coefficients) - 1
    terms = ""
    for place, coefficient in enumerate(law.coefficients):
        error = float(law.covariance[place, place]) ** 0.5
        sign = ("−" if coefficient < 0 else "") if place == 0 else (" − " if coefficient < 0 else " + ")
        terms += (
            f"{sign}({value_with_error(abs(coefficient), error)}){('', ' ε', ' ε²', ' ε³')[min(highest - place, 3)]}"
        )
    strains = ", ".join(f"{100 * strain:.3g}" for strain in law.strains)
    r2 = "" if law.r2 is None else law.r2
    return element_symbol(law.element), unit_text(law.unit), terms, r2, f"{strains} %"


def _coulomb_blocks(coulomb: CoulombResult) -> tuple[Block, ...]:
    columns = (
        Column("file", "run"),
        Column("speed_mm_s", "mm/s", shortest(3)),
        Column("weight_mN", "weight, mN", decimals(1)),
        Column("force_mN", "force, mN"),
        Column("mu", "μ"),
        Column("mu_without_viscous", "μ without viscous part"),
        Column("viscous_mN", "viscous, mN", decimals(2)),
        Column("viscous_share", "viscous share", percent(1)),
    )
    estimates = {
        "μ": estimate_text(coulomb.mu),
        "μ without viscous part": estimate_text(coulomb.mu_without_viscous),
    }
    return (
        Facts(estimates),
        Table("coulomb-runs", "", columns, tuple(map(_coulomb_row, coulomb.runs))),
        Items(coulomb.remarks, remarks=True),
    )


def _coulomb_row(run: CoulombRun) -> tuple[Cell, ...]:
    return (
        run.file,
        run.speed_mm_s,
        run.weight_mN,
        *(_estimate_cell(estimate) for estimate in (run.force, run.mu, run.mu_without_viscous)),
        run.viscous_mN if isfinite(run.viscous_mN) else None,
        "" if run.viscous_share is None else run.viscous_share,
    )


def _drag_blocks(drag: DragResult) -> tuple[Block, ...]:
    points = (
        Column("speed_mm_s", "mm/s", shortest(3)),
        Column("runs", "runs", shortest()),
        Column("measured_mN", "measured, mN"),
        *(Column(f"{name}_mN", f"{name}, mN", decimals(1)) for name in ("f_e", "f_v", "f_c", "model")),
        Column("residual_mN", "measured − model", decimals(1, signed=True)),
        Column("residual_errors", "in errors", decimals(1, signed=True)),
    )
    determination = (
        Column("band", "R² of the model"),
        Column("speeds", "speeds", shortest()),
        Column("eq15", "Eq. 15", decimals(4)),
        Column("correlation2", "correlation²", decimals(4)),
    )
    bands = tuple((band.band, band.speeds, band.eq15, band.correlation) for band in drag.determination)
    return (
        Table(
            "drag-points", "Steady force, zero subtracted, beside the model", points, tuple(map(_drag_row, drag.points))
        ),
        *(() if drag.log_law is None else _log_law_blocks(drag.log_law)),
        Text("" if drag.boundary is None else drag.boundary.sentence),
        Table("drag-r2", "", determination, bands),
        Items(drag.remarks, remarks=True),
    )


def _drag_row(point: SpeedPoint) -> tuple[Cell, ...]:
    value, error = point.force.value, point.force.standard_error
    residual = None if value is None else value - point.model_mN
    return (
        point.speed_mm_s,
        point.runs,
        FormattedNumber(value, value_with_error(value, error) if value is not None else estimate_text(point.force)),
        point.f_e_mN,
        point.f_v_mN,
        point.f_c_mN,
        point.model_mN,
        "" if residual is None else residual,
        "" if residual is None or not error else residual / error,
    )


def _log_law_blocks(law: LogLaw) -> tuple[Block, ...]:
    fits = "too few speeds to test it"
    if law.lack_of_fit_p is not None:
        deviates = law.lack_of_fit_p < MAX_LOG_LAW_P
        verdict = "deviate from it by more than their errors" if deviates else "agree with it within errors"
        fits = f"the forces {verdict} ({p_value_text(law.lack_of_fit_p)})"
    columns = (Column("coefficient", ""), Column("value_mN", "mN"), Column("interval_95", "95 % interval"))
    rows = tuple(
        (letter, _value_cell(quantity), interval_text(quantity))
        for letter, quantity in (("a", law.intercept), ("b", law.slope))
    )
    return Text(f"Force = a + b ln(v / 1 mm/s), R² {law.r2:.3f}: {fits}."), Table("log-law", "", columns, rows)


def element_symbol(name: str) -> str:
    """Return an element or a time constant as on paper: η1, τ2."""
    return name.replace("eta", "η").replace("tau", "τ")


def identification_json(identification: Identification) -> Mapping[str, object]:
    """Return an identification as JSON, without any NaN or infinity; null for parts that the campaign lacks."""
    joint, relaxation = identification.joint, identification.relaxation
    coulomb, drag = identification.coulomb, identification.drag
    return to_json_object(
        {
            "specimen": identification.specimen,
            "used": identification.used,
            "left_out": exclusions_json(identification.left_out),
            "joint": None if joint is None else _joint_fit_json(joint),
            "relaxation": None if relaxation is None else _relaxation_json(relaxation),
            "coulomb": None if coulomb is None else _coulomb_json(coulomb),
            "drag": None if drag is None else _drag_json(drag),
            "remarks": identification.remarks,
        }
    )


def _joint_fit_json(fit: JointFit) -> Mapping[str, object]:
    return {
        "nominal": fit.nominal,
        "converged": fit.converged,
        "steps": fit.steps,
        "chi2": fit.chi2,
        "degrees": fit.degrees,
        "p_value": fit.p_value,
        "holds": fit.holds,
        "parameters": {_key_with_unit(parameter): _parameter_json(parameter, fit) for parameter in fit.parameters},
        "combinations": {_key_with_unit(product): _parameter_json(product, fit) for product in fit.combinations},
        "correlation": _matrix_json(fit.correlation, [parameter.name for parameter in fit.parameters]),
        "runs": [
            {
                "file": run.file,
                "kind": run.kind,
                "channel": run.channel,
                "blocks": run.blocks,
                "chi2_per_degree": run.chi2,
                "rms_mN": run.rms_mN,
                "zero_mN": _estimate_json(run.zero),
                "factors": {name: _estimate_json(estimate) for name, estimate in run.factors.items()},
                "offsets": {name: _estimate_json(estimate) for name, estimate in run.offsets.items()},
            }
            for run in fit.runs
        ],
        "remarks": fit.remarks,
    }


def _relaxation_json(relaxation: RelaxationResult) -> Mapping[str, object]:
    return {
        "runs": [_relaxation_fit_json(fit) for fit in relaxation.fits],
        "laws": [_strain_law_json(law) for law in relaxation.laws],
        "remarks": relaxation.remarks,
    }


def _coulomb_json(coulomb: CoulombResult) -> Mapping[str, object]:
    return {
        "mu": _estimate_json(coulomb.mu),
        "mu_without_viscous": _estimate_json(coulomb.mu_without_viscous),
        "runs": [
            {
                "file": run.file,
                "speed_mm_s": run.speed_mm_s,
                "weight_mN": run.weight_mN,
                "force_mN": _estimate_json(run.force),
                "mu": _estimate_json(run.mu),
                "mu_without_viscous": _estimate_json(run.mu_without_viscous),
                "viscous_mN": run.viscous_mN,
                "viscous_share": run.viscous_share,
            }
            for run in coulomb.runs
        ],
        "remarks": coulomb.remarks,
    }


def _drag_json(drag: DragResult) -> Mapping[str, object]:
    law, boundary = drag.log_law, drag.boundary
    return {
        "speeds": [
            {
                "speed_mm_s": point.speed_mm_s,
                "runs": point.runs,
                "force_mN": _estimate_json(point.force),
                "f_e_mN": point.f_e_mN,
                "f_v_mN": point.f_v_mN,
                "f_c_mN": point.f_c_mN,
                "model_mN": point.model_mN,
            }
            for point in drag.points
        ],
        "log_law": None
        if law is None
        else {
            **_quantities_json((law.intercept, law.slope)),
            "correlation": law.correlation,
            "r2": law.r2,
            "lack_of_fit_p": law.lack_of_fit_p,
        },
        "boundary": None
        if boundary is None
        else {
            "speed_mm_s": boundary.speed_mm_s,
            "interval_95_mm_s": boundary.interval,
            "p_value": boundary.p_value,
            "sentence": boundary.sentence,
        },
        "determination": [
            {"band": band.band, "speeds": band.speeds, "eq15": band.eq15, "correlation2": band.correlation}
            for band in drag.determination
        ],
        "remarks": drag.remarks,
    }


def _relaxation_fit_json(fit: RelaxationFit) -> Mapping[str, object]:
    test = fit.test
    return {
        "file": fit.file,
        "shear_strain": fit.shear_strain,
        "elements": _quantities_json(fit.elements),
        "times": _quantities_json(fit.times),
        "correlation": _matrix_json(fit.correlation, [element.name for element in fit.elements]),
        "zero_mN": _estimate_json(fit.zero),
        "chi2": fit.chi2,
        "degrees": fit.degrees,
        "converged": fit.converged,
        "five_elements": None
        if test is None
        else {
            "suffice": test.suffices,
            "p_value": test.p_value,
            "third_time_s": test.third_time_s,
            "third_force_mN": test.third_force_mN,
            "sentence": test.sentence,
        },
        "remark": fit.remark,
    }


def _strain_law_json(law: StrainLaw) -> Mapping[str, object]:
    return {
        "element": law.element,
        "unit": law.unit,
        "strains": law.strains,
        "coefficients_highest_power_first": law.coefficients,
        "covariance": law.covariance,
        "r2": law.r2,
    }


def _quantities_json(quantities: Iterable[EstimatedQuantity]) -> Mapping[str, object]:
    return {
        _key_with_unit(quantity): {
            "value": quantity.value,
            "standard_error": quantity.standard_error,
            "interval_95": quantity.interval,
        }
        for quantity in quantities
    }


def _parameter_json(parameter: ParameterEstimate, fit: JointFit) -> Mapping[str, object]:
    """Return a number of a joint fit: none that the runs do not determine, no error of a fit that did not converge."""
    known = parameter.determined
    return {
        "determined": known,
        "value": parameter.value if known else None,
        "standard_error": parameter.standard_error if known and fit.converged else None,
        "interval_95": parameter.interval if known and fit.converged else None,
        "prior_95": parameter.prior,
        "learnt": parameter.learnt,
        "meaning": parameter.meaning,
    }


def _estimate_json(estimate: Estimate) -> Mapping[str, object]:
    return {
        "value": estimate.value,
        "standard_error": estimate.standard_error,
        "interval_95": estimate.interval,
        "reason": estimate.reason,
    }


def _matrix_json(matrix: FloatArray | None, names: Iterable[str]) -> Mapping[str, object] | None:
    return None if matrix is None else {"names": list(names), "rows": matrix}


def _key_with_unit(quantity: EstimatedQuantity) -> str:
    """Return a name with its unit: E1_kPa, eta1_kPa_s; just the name where it has none or ends with it already."""
    unit = re.sub(r"[^0-9A-Za-zµμ]+", "_", quantity.unit).strip("_")
    return quantity.name if unit in {"", "1"} or quantity.name.endswith(f"_{unit}") else f"{quantity.name}_{unit}"
