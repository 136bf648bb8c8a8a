"""An identification laid out for a reader: joint fit, relaxation, Coulomb friction, drag, and what was left out."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from math import isnan
from typing import TYPE_CHECKING

from dragrig import present
from dragrig.analysis import (
    UNKNOWN,
    CoulombResult,
    DragResult,
    Estimate,
    EstimatedQuantity,
    Exclusion,
    Identification,
    JointFit,
    LogLaw,
    ParameterEstimate,
    RelaxationFit,
    RelaxationResult,
    RunResidual,
    SpeedPoint,
    StrainLaw,
    count_text,
    join_names,
    range_text,
    value_with_error,
)
from dragrig.present import (
    Block,
    Cell,
    Column,
    Document,
    Facts,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    Text,
    attributes_json,
    decimals,
    estimate_text,
    exclusions_json,
    grouped_files,
    interval_text,
    listed_exclusions,
    p_value_text,
    parameter_symbol,
    percent,
    quantity_json,
    shortest,
    unit_text,
)
from dragrig.rig import FloatArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

MAX_RELATIVE_WIDTH = 10.0
"""A half-width of more than ten times the value says nothing and is not shown."""
MAX_IN_ANSWER = 2
"""Parameters that the first sentence names."""
STRONG_CORRELATION = 0.9
"""Correlation from which two elements are called hard to distinguish."""


def identification_document(identification: Identification) -> Document:
    """Lay out an identification."""
    joint, used = identification.joint, len(identification.used)
    parts = (identification.relaxation, identification.coulomb, identification.drag)
    # A nominal model such as the drive alone has none of the parts of the friction model.
    sections = () if joint is not None and not any(parts) else tuple(_part_sections(identification))

    runs = f"{used} of {used + len(identification.left_out)} runs used"
    figures = () if joint is None else (joint_figure(joint),)
    if identification.drag is not None and identification.drag.model is not None:
        figures = (_drag_figure(identification.drag), *figures)
    return Document(
        title=f"Identification of specimen {identification.specimen}",
        badges=identification.backends,
        answer=_answer(identification),
        lead=(*_wall_sentence(identification.relaxation), f"{runs}; intervals hold 95 %, ± is a standard error."),
        sections=(
            Section("joint-figure", "", figures),
            Section("joint", "Joint fit", (Text("None."),) if joint is None else _joint_blocks(joint)),
            *sections,
            left_out_section(identification.left_out),
            Section("appendix", "Appendix", () if joint is None else (_residual_table(joint.runs),)),
            Section("remarks", "Remarks", (Items(identification.remarks, remarks=True),)),
        ),
        data=identification_json(identification),
    )


def left_out_section(left_out: Sequence[Exclusion]) -> Section:
    """List what an evaluation left out, and why."""
    return Section("left-out", "Left out", (left_out_table("exclusions", "what", left_out),))


def left_out_table(name: str, what: str, left_out: Sequence[Exclusion], brief_rows: int | None = None) -> Table:
    """Tabulate what was left out, in a column of this name, and why."""
    return Table.of(
        name,
        "",
        listed_exclusions(left_out),
        Field(what, "left out", lambda exclusion: exclusion.item),
        Field("reason", "reason", lambda exclusion: exclusion.reason),
        brief_rows=brief_rows,
    )


def _answer(identification: Identification) -> str:
    """Say what the runs determine, the best known parameters with their intervals."""
    name, joint = identification.specimen, identification.joint
    if joint is None:
        return f"The runs of specimen {name} do not support a joint fit."
    if not joint.converged:
        return f"The joint fit of specimen {name} did NOT converge: no interval holds."
    known = sorted((entry for entry in joint.parameters if entry.determined), key=lambda entry: entry.half_width)
    if not known:
        return f"The runs of specimen {name} determine none of the {joint.nominal} model's parameters."
    best = "; ".join(map(_named_value, known[:MAX_IN_ANSWER]))
    doubt = "" if joint.holds else "the residuals exceed noise, and "
    return (
        f"Specimen {name}: {doubt}the runs determine {len(known)} of {len(joint.parameters)} parameters. "
        f"Best known: {best}."
    )


def _wall_sentence(relaxation: RelaxationResult | None) -> Iterator[str]:
    """Give the wall's elements in their units, of the first relaxation that has some."""
    fit = None if relaxation is None else next((fit for fit in relaxation.fits if fit.elements and fit.converged), None)
    if fit is not None:
        yield f"The wall at {100 * fit.shear_strain:.3g} % strain: {', '.join(map(_named_value, fit.elements))}."


def _named_value(quantity: EstimatedQuantity) -> str:
    value, symbol = value_with_error(quantity.value, quantity.standard_error), parameter_symbol(quantity.name)
    return f"{symbol}{'' if symbol.endswith('×') else ' ='} {value} {unit_text(quantity.unit)}".rstrip()


def _drag_figure(drag: DragResult) -> Figure:
    return Figure(
        "drag",
        "Steady drag against speed, measured with intervals, and by the model before and after the fit; below, "
        "measured less the model.",
        "Bars hold 95 %. The areas are the parts of the identified model; the sensor's zero is taken off, and forces "
        "count along the motion.",
        lambda: present.drag_figure(drag),
    )


def joint_figure(joint: JointFit) -> Figure:
    """Return the figure of a joint fit."""
    return Figure(
        "joint-fit",
        "Left, the 95 % interval of each parameter before and after the runs, and of their combinations; right, χ² per "
        "degree of freedom of each run.",
        "Left, on a scale on which all parameters were known equally well before; right, 1 where only noise and the "
        "variation between runs remain.",
        lambda: present.joint_fit_figure(joint),
    )


def identified_campaigns_document(campaigns: Sequence[tuple[str, Identification | None, str]]) -> Document:
    """Lay out the joint fits of several campaigns: folder, identification, and why there is none."""
    fits = [result.joint for _, result, _ in campaigns if result is not None and result.joint is not None]
    names = list(dict.fromkeys(parameter.name for fit in fits for parameter in fit.parameters))
    columns = (Column("campaign", "campaign"), *(Column(name, parameter_symbol(name)) for name in names))
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
        yield _estimate_cell(known[name] if converged and name in known else Estimate())


def _joint_blocks(fit: JointFit) -> tuple[Block, ...]:
    """Lay out a joint fit: no value that the runs do not determine, no interval of a fit that did not converge."""

    def interval(parameter: ParameterEstimate) -> str:
        return interval_text(parameter) if parameter.determined and fit.converged else ""

    names = re.compile(rf"\b(?:{'|'.join(parameter.name for parameter in fit.parameters)})\b")
    remarks = (names.sub(lambda found: parameter_symbol(found[0]), remark) for remark in fit.remarks)
    return (
        Text(_joint_fit_heading(fit)),
        Table.of(
            "parameters",
            "",
            fit.parameters,
            Field("symbol", "parameter", lambda parameter: parameter_symbol(parameter.name)),
            Field("value", "value", lambda parameter: _value_cell(parameter if parameter.determined else None)),
            Field("interval_95", "95 % interval", interval),
            Field("unit", "unit", lambda parameter: unit_text(parameter.unit)),
            Field("prior_95", "prior, 95 %", lambda parameter: range_text(parameter.prior, parameter.standard_error)),
            Field("learnt", "narrowed by", lambda parameter: parameter.learnt if fit.converged else "", percent()),
            Field("meaning", "meaning", lambda parameter: parameter.meaning),
            Field("parameter", "key in files", lambda parameter: parameter.name),
        ),
        Table.of(
            "combinations",
            "Combinations",
            fit.combinations,
            Field("symbol", "combination", lambda product: parameter_symbol(product.name)),
            Field("value", "value", lambda product: _value_cell(product if product.determined else None)),
            Field("interval_95", "95 % interval", interval),
            Field("half_width", "± 95 %", lambda product: _half_width_text(product) if interval(product) else ""),
            Field("unit", "unit", lambda product: unit_text(product.unit)),
            Field("combination", "key in files", lambda product: product.name),
        ),
        Items((*_joint_fit_warnings(fit), *remarks), remarks=True),
    )


def _joint_fit_heading(fit: JointFit) -> str:
    if not fit.converged:
        return (
            f"Fit of the {fit.nominal} model: did NOT converge in {fit.steps} steps; the intervals below are not valid."
        )
    chi2 = (
        f"χ² is {fit.chi2 / fit.degrees:.3g} per degree of freedom ({fit.degrees})"
        if fit.degrees
        else "no degree of freedom"
    )
    p_value = "p not known" if isnan(fit.p_value) else p_value_text(fit.p_value)
    heading = f"Fit of the {fit.nominal} model, {count_text(fit.steps, 'step')}: {chi2}, {p_value}"
    if not fit.holds:
        return f"{heading}. The residuals exceed noise, so the intervals below may be too narrow."
    if not any(parameter.determined for parameter in fit.parameters):
        return f"{heading}. These runs determine NONE of its parameters."
    return f"{heading}."


def _value_cell(quantity: EstimatedQuantity | None) -> FormattedNumber:
    """Return a value to the second digit of its error, which stands in a column of its own."""
    if quantity is None:
        return FormattedNumber(None, UNKNOWN)
    return FormattedNumber.rounded(quantity.value, quantity.standard_error)


def _half_width_text(quantity: EstimatedQuantity) -> str:
    width = quantity.half_width
    return f"{shortest(2)(100 * width)} %" if width < MAX_RELATIVE_WIDTH else ""


def _joint_fit_warnings(fit: JointFit) -> Iterator[str]:
    unknown = [parameter_symbol(parameter.name) for parameter in fit.parameters if not parameter.determined]
    if unknown:
        yield f"these runs do not determine {join_names(unknown)}"
    strange = [
        parameter_symbol(parameter.name)
        for parameter in fit.parameters
        if parameter.determined and not parameter.prior[0] <= parameter.value <= parameter.prior[1]
    ]
    if strange:
        yield f"outside of the 95 % interval of the prior: {join_names(strange)}"
    unexplained = [run.file for run in fit.runs if run.exceeds_noise]
    if unexplained:
        yield f"the model leaves more than noise in {grouped_files(unexplained)}"


def _residual_table(runs: Sequence[RunResidual]) -> Table:
    def own_field(estimates: str, name: str, heading: str, places: int) -> Field[RunResidual]:
        def cell(run: RunResidual) -> Cell:
            own: Mapping[str, Estimate] = getattr(run, estimates)
            return own[name].value if name in own else ""

        return Field(name, heading, cell, decimals(places))

    factors = dict.fromkeys(name for run in runs for name in run.factors)
    offsets = dict.fromkeys(name for run in runs for name in run.offsets)
    return Table.of(
        "residuals",
        "Residuals of each run",
        runs,
        Field("file", "run", lambda run: run.file),
        Field("kind", "kind", lambda run: run.kind),
        Field("channel", "channel", lambda run: run.channel),
        Field("chi2_per_degree", "χ² per degree", lambda run: run.chi2, decimals(2)),
        Field("alert", "", lambda run: "!" if run.exceeds_noise else ""),
        Field("rms_mN", "rms, mN", lambda run: run.rms_mN, decimals(2)),
        Field("zero_mN", "zero, mN", lambda run: _estimate_cell(run.zero)),
        *(own_field("factors", name, f"{name} ×", 3) for name in factors),
        *(own_field("offsets", name, name, 1) for name in offsets),
    )


def _estimate_cell(estimate: Estimate | EstimatedQuantity) -> FormattedNumber:
    """Return an estimate with its error; why one is missing stands beside the result of all runs."""
    return FormattedNumber.with_error(estimate.value, estimate.standard_error)


def _part_sections(identification: Identification) -> Iterator[Section]:
    none = (Text("Not identified."),)
    relaxation, coulomb, drag = identification.relaxation, identification.coulomb, identification.drag
    yield Section("relaxation", "Relaxation", none if relaxation is None else _relaxation_blocks(relaxation))
    yield Section("coulomb", "Coulomb friction", none if coulomb is None else _coulomb_blocks(coulomb))
    yield Section("drag", "Drag", none if drag is None else _drag_blocks(drag))


def _relaxation_blocks(relaxation: RelaxationResult) -> tuple[Block, ...]:
    known = [fit for fit in relaxation.fits if fit.elements]
    # A run is named beside the first of its elements.
    elements = [
        (quantity, fit if place == 0 else None)
        for fit in known
        for place, quantity in enumerate((*fit.elements, *fit.times))
    ]
    return (
        Text(f"Five elements from {len(known)} of {len(relaxation.fits)} runs."),
        Table.of(
            "elements",
            "",
            elements,
            Field("file", "run", lambda row: row[1].file if row[1] else ""),
            Field("strain", "strain", lambda row: f"{100 * row[1].shear_strain:.3g} %" if row[1] else ""),
            Field("element", "element", lambda row: parameter_symbol(row[0].name)),
            Field("value", "value", lambda row: _value_cell(row[0])),
            Field("interval_95", "95 % interval", lambda row: interval_text(row[0])),
            Field("half_width", "± 95 %", lambda row: _half_width_text(row[0])),
            Field("unit", "unit", lambda row: row[0].unit),
        ),
        Items(tuple(f"{fit.file}: {text}" for fit in relaxation.fits for text in _relaxation_fit_sentences(fit))),
        Table.of(
            "strain-laws",
            "Elements against strain",
            relaxation.laws,
            Field("element", "element", lambda law: parameter_symbol(law.element)),
            Field("unit", "unit", lambda law: unit_text(law.unit)),
            Field("law", "against strain ε", _strain_law_text),
            Field("r2", "R²", lambda law: "" if law.r2 is None else law.r2, decimals(3)),
            Field("strains", "strains", lambda law: ", ".join(f"{100 * strain:.3g}" for strain in law.strains) + " %"),
        ),
        Items(relaxation.remarks, remarks=True),
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
    names = [parameter_symbol(element.name) for element in fit.elements]
    return [
        f"{names[row]} and {names[column]} (correlation {decimals(2)(fit.correlation[row, column])})"
        for row in range(len(names))
        for column in range(row)
        if abs(fit.correlation[row, column]) >= STRONG_CORRELATION
    ]


def _strain_law_text(law: StrainLaw) -> str:
    highest = len(law.coefficients) - 1
    terms = ""
    for place, coefficient in enumerate(law.coefficients):
        error = float(law.covariance[place, place]) ** 0.5
        sign = ("−" if coefficient < 0 else "") if place == 0 else (" − " if coefficient < 0 else " + ")
        power = ("", " ε", " ε²", " ε³")[min(highest - place, 3)]
        terms += f"{sign}({value_with_error(abs(coefficient), error)}){power}"
    return terms


def _coulomb_blocks(coulomb: CoulombResult) -> tuple[Block, ...]:
    return (
        Facts(
            {
                "μ": estimate_text(coulomb.mu),
                "μ without viscous part": estimate_text(coulomb.mu_without_viscous),
            }
        ),
        Table.of(
            "coulomb-runs",
            "",
            coulomb.runs,
            Field("file", "run", lambda run: run.file),
            Field("speed_mm_s", "mm/s", lambda run: run.speed_mm_s, shortest(3)),
            Field("weight_mN", "weight, mN", lambda run: run.weight_mN, decimals(1)),
            Field("force_mN", "force, mN", lambda run: _estimate_cell(run.force)),
            Field("mu", "μ", lambda run: _estimate_cell(run.mu)),
            Field("mu_without_viscous", "μ without viscous part", lambda run: _estimate_cell(run.mu_without_viscous)),
            Field("viscous_mN", "viscous, mN", lambda run: run.viscous_mN, decimals(2)),
            Field(
                "viscous_share",
                "viscous share",
                lambda run: "" if run.viscous_share is None else run.viscous_share,
                percent(1),
            ),
        ),
        Items(coulomb.remarks, remarks=True),
    )


def _drag_blocks(drag: DragResult) -> tuple[Block, ...]:
    one_decimal, signed = decimals(1), decimals(1, signed=True)
    return (
        Table.of(
            "drag-points",
            "Steady force, zero subtracted, and the model's",
            drag.points,
            Field("speed_mm_s", "mm/s", lambda point: point.speed_mm_s, shortest(3)),
            Field("runs", "runs", lambda point: point.runs, shortest()),
            Field("measured_mN", "measured, mN", _measured_cell),
            Field("f_e_mN", "f_e, mN", lambda point: point.f_e_mN, one_decimal),
            Field("f_v_mN", "f_v, mN", lambda point: point.f_v_mN, one_decimal),
            Field("f_c_mN", "f_c, mN", lambda point: point.f_c_mN, one_decimal),
            Field("model_mN", "model, mN", lambda point: point.model_mN, one_decimal),
            Field("residual_mN", "measured − model", _drag_residual, signed),
            Field(
                "residual_errors",
                "in errors",
                lambda point: _drag_residual(point, in_errors=True),
                signed,
            ),
        ),
        *(() if drag.log_law is None else _log_law_blocks(drag.log_law)),
        Text("" if drag.boundary is None else drag.boundary.sentence),
        Table.of(
            "drag-r2",
            "Eq. 15 compares spreads: it exceeds 1 where the model varies more than the measurement",
            drag.determination,
            Field("band", "R² of the model", lambda band: band.band),
            Field("speeds", "speeds", lambda band: band.speeds, shortest()),
            Field("eq15", "Eq. 15", lambda band: band.eq15, decimals(4)),
            Field("correlation2", "correlation²", lambda band: band.correlation, decimals(4)),
        ),
        Items(drag.remarks, remarks=True),
    )


def _measured_cell(point: SpeedPoint) -> FormattedNumber:
    force = point.force
    text = estimate_text(force) if force.value is None else value_with_error(force.value, force.standard_error)
    return FormattedNumber(force.value, text)


def _drag_residual(point: SpeedPoint, *, in_errors: bool = False) -> Cell:
    value, error = point.force.value, point.force.standard_error
    if value is None or (in_errors and not error):
        return ""
    return (value - point.model_mN) / ((error or 1.0) if in_errors else 1.0)


def _log_law_blocks(law: LogLaw) -> tuple[Block, ...]:
    fits = "too few speeds to test it"
    if law.lack_of_fit_p is not None:
        verdict = "deviate from it by more than their errors" if law.deviates else "agree with it within errors"
        fits = f"the forces {verdict} ({p_value_text(law.lack_of_fit_p)})"
    columns = (Column("coefficient", ""), Column("value_mN", "mN"), Column("interval_95", "95 % interval"))
    rows = tuple(
        (letter, _value_cell(quantity), interval_text(quantity))
        for letter, quantity in (("a", law.intercept), ("b", law.slope))
    )
    return Text(f"Force = a + b ln(v / 1 mm/s), R² {law.r2:.3f}: {fits}."), Table("log-law", "", columns, rows)


def identification_json(identification: Identification) -> Mapping[str, object]:
    """Return an identification for JSON; None for parts that the campaign lacks."""
    joint, relaxation = identification.joint, identification.relaxation
    coulomb, drag = identification.coulomb, identification.drag
    return {
        "specimen": identification.specimen,
        "used": identification.used,
        "left_out": exclusions_json(identification.left_out),
        "joint": None
        if joint is None
        else {
            **attributes_json(joint, "nominal", "converged", "steps", "chi2", "degrees", "p_value", "holds"),
            "parameters": {_key_with_unit(entry): _parameter_json(entry, joint) for entry in joint.parameters},
            "combinations": {_key_with_unit(entry): _parameter_json(entry, joint) for entry in joint.combinations},
            "correlation": _matrix_json(joint.correlation, [parameter.name for parameter in joint.parameters]),
            "runs": [_fields_json(run, chi2="chi2_per_degree", zero="zero_mN") for run in joint.runs],
            "remarks": joint.remarks,
        },
        "relaxation": None
        if relaxation is None
        else {
            "runs": [_relaxation_fit_json(fit) for fit in relaxation.fits],
            "laws": [_fields_json(law, coefficients="coefficients_highest_power_first") for law in relaxation.laws],
            "remarks": relaxation.remarks,
        },
        "coulomb": None
        if coulomb is None
        else {**_fields_json(coulomb), "runs": [_fields_json(run, force="force_mN") for run in coulomb.runs]},
        "drag": None if drag is None else _drag_json(drag),
        "remarks": identification.remarks,
    }


def _drag_json(drag: DragResult) -> Mapping[str, object]:
    law, boundary = drag.log_law, drag.boundary
    return {
        "speeds": [{**_fields_json(point, force="force_mN"), "model_mN": point.model_mN} for point in drag.points],
        "log_law": None
        if law is None
        else {
            **_quantities_json((law.intercept, law.slope)),
            **attributes_json(law, "correlation", "r2", "lack_of_fit_p"),
        },
        "boundary": None if boundary is None else _fields_json(boundary, interval="interval_95_mm_s"),
        "determination": [_fields_json(band, correlation="correlation2") for band in drag.determination],
        "remarks": drag.remarks,
    }


def _fields_json(record: "DataclassInstance", **renamed: str) -> dict[str, object]:
    """Return the fields of a result by their names, or new ones; an estimate has its interval beside it."""

    def value_json(value: object) -> object:
        if isinstance(value, Mapping):
            return {name: value_json(item) for name, item in value.items()}
        return _estimate_json(value) if isinstance(value, Estimate) else value

    return {renamed.get(item.name, item.name): value_json(getattr(record, item.name)) for item in fields(record)}


def _relaxation_fit_json(fit: RelaxationFit) -> Mapping[str, object]:
    test = fit.test
    return {
        **attributes_json(fit, "file", "shear_strain", "chi2", "degrees", "converged", "remark"),
        "elements": _quantities_json(fit.elements),
        "times": _quantities_json(fit.times),
        "correlation": _matrix_json(fit.correlation, [element.name for element in fit.elements]),
        "zero_mN": _estimate_json(fit.zero),
        "five_elements": None if test is None else _fields_json(test, suffices="suffice"),
    }


def _quantities_json(quantities: Iterable[EstimatedQuantity]) -> Mapping[str, object]:
    return {_key_with_unit(quantity): quantity_json(quantity) for quantity in quantities}


def _parameter_json(parameter: ParameterEstimate, fit: JointFit) -> Mapping[str, object]:
    """Return a number of a joint fit: none that the runs do not determine, no error of a fit that did not converge."""
    known = parameter.determined
    return {
        "determined": known,
        "value": parameter.value if known else None,
        "standard_error": parameter.standard_error if known and fit.converged else None,
        "interval_95": parameter.interval if known and fit.converged else None,
        "prior_95": parameter.prior,
        **attributes_json(parameter, "learnt", "meaning"),
    }


def _estimate_json(estimate: Estimate) -> Mapping[str, object]:
    return {**quantity_json(estimate), "reason": estimate.reason}


def _matrix_json(matrix: FloatArray | None, names: Iterable[str]) -> Mapping[str, object] | None:
    return None if matrix is None else {"names": list(names), "rows": matrix}


def _key_with_unit(quantity: EstimatedQuantity) -> str:
    """Return a name with its unit: E1_kPa, eta1_kPa_s; just the name where it has none or ends with it already."""
    unit = re.sub(r"[^0-9A-Za-zµμ]+", "_", quantity.unit).strip("_")
    return quantity.name if unit in {"", "1"} or quantity.name.endswith(f"_{unit}") else f"{quantity.name}_{unit}"
