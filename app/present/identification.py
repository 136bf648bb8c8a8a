"""An identification as text and as JSON: joint fit, relaxation, Coulomb friction, drag, and what was left out."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite, isnan, sqrt

from dragrig.analysis.estimates import Estimate, EstimatedQuantity, Exclusion
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
from dragrig.config.friction_model import IdentificationSummary, IdentifiedValue
from dragrig.present.document import (
    estimate_cells,
    interval_text,
    p_value_text,
    range_text,
    rounded_to_error,
    unit_text,
)
from dragrig.present.numbers import number_text, text_columns
from dragrig.rig.arrays import FloatArray
from dragrig.rig.session import software_version

JsonObject = dict[str, object]


def identification_json(identification: Identification) -> JsonObject:
    """Return all that an identification says; a part that the campaign does not support is None."""
    one = identification
    return {
        "specimen": one.specimen,
        "used": list(one.used),
        "left_out": left_out_json(one.left_out),
        "joint": None if one.joint is None else joint_fit_json(one.joint),
        "relaxation": None if one.relaxation is None else relaxation_json(one.relaxation),
        "coulomb": None if one.coulomb is None else coulomb_json(one.coulomb),
        "drag": None if one.drag is None else drag_json(one.drag),
        "remarks": list(one.remarks),
    }


def joint_fit_json(fit: JointFit) -> JsonObject:
    """Return the joint fit: parameters and products by name, their correlation, and how each run is left."""
    return {
        "nominal": fit.nominal,
        "converged": fit.converged,
        "steps": fit.steps,
        "chi2": finite_or_none(fit.chi2),
        "degrees": fit.degrees,
        "p_value": finite_or_none(fit.p_value),
        "holds": fit.holds,
        "parameters": {_key_with_unit(one): _identified_json(one, fit) for one in fit.parameters},
        "combinations": {_key_with_unit(one): _identified_json(one, fit) for one in fit.combinations},
        "correlation": _matrix_json(fit.correlation, [one.name for one in fit.parameters]),
        "runs": [
            {
                "file": run.file,
                "kind": run.kind,
                "channel": run.channel,
                "blocks": run.blocks,
                "chi2_per_degree": finite_or_none(run.chi2),
                "rms_mN": finite_or_none(run.rms_mN),
                "zero_mN": _estimate_json(run.zero),
                "factors": {name: _estimate_json(one) for name, one in run.factors.items()},
                "offsets": {name: _estimate_json(one) for name, one in run.offsets.items()},
            }
            for run in fit.runs
        ],
        "remarks": list(fit.remarks),
    }


def relaxation_json(relaxation: RelaxationResult) -> JsonObject:
    """Return the elements of each run, and how they depend on strain."""
    return {
        "runs": [_relaxation_fit_json(fit) for fit in relaxation.fits],
        "laws": [_strain_law_json(law) for law in relaxation.laws],
        "remarks": list(relaxation.remarks),
    }


def coulomb_json(coulomb: CoulombResult) -> JsonObject:
    """Return the friction coefficient of all runs and of each."""
    return {
        "mu": _estimate_json(coulomb.mu),
        "mu_without_viscous": _estimate_json(coulomb.mu_without_viscous),
        "runs": [
            {
                "file": run.file,
                "speed_mm_s": finite_or_none(run.speed_mm_s),
                "weight_mN": finite_or_none(run.weight_mN),
                "force_mN": _estimate_json(run.force),
                "mu": _estimate_json(run.mu),
                "mu_without_viscous": _estimate_json(run.mu_without_viscous),
                "viscous_mN": finite_or_none(run.viscous_mN),
                "viscous_share": finite_or_none(run.viscous_share),
            }
            for run in coulomb.runs
        ],
        "remarks": list(coulomb.remarks),
    }


def drag_json(drag: DragResult) -> JsonObject:
    """Return the steady drag by speed, its law, the boundary and R²."""
    law, boundary = drag.log_law, drag.boundary
    return {
        "speeds": [
            {
                "speed_mm_s": finite_or_none(point.speed_mm_s),
                "runs": point.runs,
                "force_mN": _estimate_json(point.force),
                "f_e_mN": finite_or_none(point.f_e_mN),
                "f_v_mN": finite_or_none(point.f_v_mN),
                "f_c_mN": finite_or_none(point.f_c_mN),
                "model_mN": finite_or_none(point.model_mN),
            }
            for point in drag.points
        ],
        "log_law": None
        if law is None
        else {
            **_quantities_json((law.intercept, law.slope)),
            "correlation": finite_or_none(law.correlation),
            "r2": finite_or_none(law.r2),
            "lack_of_fit_p": finite_or_none(law.lack_of_fit_p),
        },
        "boundary": None
        if boundary is None
        else {
            "speed_mm_s": finite_or_none(boundary.speed_mm_s),
            "interval_95_mm_s": _interval_json(boundary.interval),
            "p_value": finite_or_none(boundary.p_value),
            "sentence": boundary.sentence,
        },
        "determination": [
            {
                "band": one.band,
                "speeds": one.speeds,
                "eq15": finite_or_none(one.eq15),
                "correlation2": finite_or_none(one.correlation),
            }
            for one in drag.determination
        ],
        "remarks": list(drag.remarks),
    }


def left_out_json(left_out: Iterable[Exclusion]) -> list[JsonObject]:
    """Return what was left out, and why."""
    return [{"what": one.what, "reason": one.reason} for one in left_out]


def finite_or_none(value: float | None) -> float | None:
    """Return a number as JSON knows it: None for NaN and infinities."""
    return float(value) if value is not None and isfinite(value) else None


def _relaxation_fit_json(fit: RelaxationFit) -> JsonObject:
    test = fit.test
    return {
        "file": fit.file,
        "shear_strain": finite_or_none(fit.shear_strain),
        "elements": _quantities_json(fit.elements),
        "times": _quantities_json(fit.times),
        "correlation": _matrix_json(fit.correlation, [one.name for one in fit.elements]),
        "zero_mN": _estimate_json(fit.zero),
        "chi2": finite_or_none(fit.chi2),
        "degrees": fit.degrees,
        "converged": fit.converged,
        "five_elements": None
        if test is None
        else {
            "suffice": test.suffices,
            "p_value": finite_or_none(test.p_value),
            "third_time_s": finite_or_none(test.third_time_s),
            "third_force_mN": finite_or_none(test.third_force_mN),
            "sentence": test.sentence,
        },
        "remark": fit.remark,
    }


def _strain_law_json(law: StrainLaw) -> JsonObject:
    return {
        "element": law.element,
        "unit": law.unit,
        "strains": [finite_or_none(one) for one in law.strains],
        "coefficients_highest_power_first": [finite_or_none(one) for one in law.coefficients],
        "covariance": [[finite_or_none(one) for one in row] for row in law.covariance.tolist()],
        "r2": finite_or_none(law.r2),
    }


def _quantities_json(quantities: Iterable[EstimatedQuantity]) -> JsonObject:
    return {_key_with_unit(one): _quantity_json(one) for one in quantities}


def _quantity_json(one: EstimatedQuantity) -> JsonObject:
    return {
        "value": finite_or_none(one.value),
        "standard_error": finite_or_none(one.standard_error),
        "interval_95": _interval_json(one.interval),
    }


def _identified_json(one: ParameterEstimate, fit: JointFit) -> JsonObject:
    """Return a number of a joint fit: none that the runs do not determine, no error of a fit that did not converge."""
    known = one.determined
    return {
        "determined": known,
        "value": finite_or_none(one.value) if known else None,
        "standard_error": finite_or_none(one.standard_error) if known and fit.converged else None,
        "interval_95": _interval_json(one.interval) if known and fit.converged else None,
        "prior_95": _interval_json(one.prior),
        "learnt": finite_or_none(one.learnt),
        "meaning": one.meaning,
    }


def _estimate_json(one: Estimate) -> JsonObject:
    return {
        "value": finite_or_none(one.value),
        "standard_error": finite_or_none(one.standard_error),
        "interval_95": _interval_json(one.interval),
        "reason": one.reason,
    }


def _interval_json(interval: tuple[float, float] | None) -> list[float | None] | None:
    return None if interval is None else [finite_or_none(one) for one in interval]


def _matrix_json(matrix: FloatArray | None, names: Iterable[str]) -> Mapping[str, object] | None:
    if matrix is None:
        return None
    return {"names": list(names), "rows": [[finite_or_none(one) for one in row] for row in matrix.tolist()]}


def _key_with_unit(one: EstimatedQuantity) -> str:
    """Return a name with its unit: E1_kPa, eta1_kPa_s; just the name where it has none or ends with it already."""
    unit = re.sub(r"[^0-9A-Za-zµμ]+", "_", one.unit).strip("_")
    return one.name if unit in {"", "1"} or one.name.endswith(f"_{unit}") else f"{one.name}_{unit}"


def identified_model_origin(result: Identification, joint: JointFit, campaign: str) -> IdentificationSummary:
    """Return what the file of an identified model says of where its values come from."""
    return IdentificationSummary(
        campaign=campaign,
        specimen=result.specimen,
        runs=len(result.used),
        software=software_version(),
        converged=joint.converged,
        chi2_per_degree=joint.chi2 / joint.degrees,
        parameters=tuple(_identified_value(one) for one in joint.parameters),
        combinations=tuple(_identified_value(one) for one in joint.combinations),
        correlation=tuple(tuple(row) for row in joint.correlation.round(4).tolist()),
    )


def _identified_value(one: ParameterEstimate) -> IdentifiedValue:
    return IdentifiedValue(
        name=one.name,
        unit=one.unit,
        value=one.value,
        standard_error=one.standard_error,
        low=one.interval[0],
        high=one.interval[1],
        learnt=one.learnt,
        determined=one.determined,
    )


STRONG_CORRELATION = 0.9
"""Correlation from which two elements are said to be hard to tell apart."""
LACK_OF_FIT_P = 0.01


def relaxation_text(relaxation: RelaxationResult) -> str:
    """Return the five elements of each relaxation run, whether five suffice, and how they depend on strain."""
    known = [fit for fit in relaxation.fits if fit.elements]
    lines = [f"Relaxation: five elements from {len(known)} of {len(relaxation.fits)} runs"]
    if known:
        header = ("run", "strain", "", "value", "95 % interval", "±", "")
        lines.append(text_columns(header, [row for fit in known for row in _element_rows(fit)]))
    lines += [
        "",
        *(f"{fit.file}: {sentence}" for fit in relaxation.fits for sentence in _relaxation_fit_sentences(fit)),
    ]
    if relaxation.laws:
        against = ("element", "", "against strain ε", "R²", "strains")
        lines += ["", text_columns(against, [_strain_law_row(law) for law in relaxation.laws])]
    lines += [f"! {remark}" for remark in relaxation.remarks]
    return "\n".join(lines)


def coulomb_text(coulomb: CoulombResult) -> str:
    """Return the friction coefficient of each run in the vacuum fixture, and of all."""
    header = ("run", "mm/s", "weight mN", "force mN", "±", "μ", "±", "μ less viscous", "±", "viscous mN", "share")
    lines = [
        "Coulomb friction",
        f"μ                         {_estimate_text(coulomb.mu)}",
        f"μ without viscous part    {_estimate_text(coulomb.mu_without_viscous)}",
    ]
    if coulomb.runs:
        lines.append(text_columns(header, [_coulomb_row(run) for run in coulomb.runs]))
    lines += [f"! {remark}" for remark in coulomb.remarks]
    return "\n".join(lines)


def drag_text(drag: DragResult) -> str:
    """Return the steady drag at each speed beside the model, its law, the boundary, and R² in both forms."""
    lines = ["Drag: steady force, zero taken off, beside the model"]
    if drag.points:
        header = ("mm/s", "runs", "measured mN", "±", "f_e mN", "f_v mN", "f_c mN", "model mN", "over model", "errors")
        lines.append(text_columns(header, [_speed_row(point) for point in drag.points]))
    if drag.log_law is not None:
        lines += ["", *_log_law_lines(drag.log_law)]
    if drag.boundary is not None:
        lines += ["", drag.boundary.sentence]
    if drag.determination:
        forms = ("R² of the model", "speeds", "Eq. 15", "correlation²")
        rows = [
            (one.band, str(one.speeds), _r2_text(one.eq15), _r2_text(one.correlation)) for one in drag.determination
        ]
        lines += ["", text_columns(forms, rows)]
    lines += [f"! {remark}" for remark in drag.remarks]
    return "\n".join(lines)


def _element_rows(fit: RelaxationFit) -> Iterator[tuple[str, ...]]:
    for place, one in enumerate((*fit.elements, *fit.times)):
        first = (fit.file, f"{100 * fit.shear_strain:.3g} %") if place == 0 else ("", "")
        yield (
            *first,
            element_symbol(one.name),
            rounded_to_error(one.value, one.standard_error),
            interval_text(one),
            _half_width_text(one),
            one.unit,
        )


def _half_width_text(quantity: EstimatedQuantity) -> str:
    return f"{number_text(100 * quantity.half_width, 2)} %" if quantity.half_width < 10 else ""


def _relaxation_fit_sentences(fit: RelaxationFit) -> Iterator[str]:
    if not fit.elements:
        yield f"nothing can be said of its elements: {fit.remark or 'the fit gave none'}."
        return
    if not fit.converged:
        yield "the fit did NOT converge, so that no interval of it holds."
    if fit.test is not None:
        yield fit.test.sentence
    together = _correlated_text(fit)
    if together:
        yield f"hard to tell apart: {together}."
    if fit.remark:
        yield f"{fit.remark}."


def _correlated_text(fit: RelaxationFit) -> str:
    if fit.correlation is None:
        return ""
    names = [element_symbol(one.name) for one in fit.elements]
    found = [
        f"{names[row]} and {names[column]} (correlation {fit.correlation[row, column]:.2f})"
        for row in range(len(names))
        for column in range(row)
        if abs(fit.correlation[row, column]) >= STRONG_CORRELATION
    ]
    return ", ".join(found)


def _strain_law_row(law: StrainLaw) -> tuple[str, ...]:
    highest = len(law.coefficients) - 1
    text = ""
    for place, value in enumerate(law.coefficients):
        error = float(law.covariance[place, place]) ** 0.5
        sign = ("−" if value < 0 else "") if place == 0 else (" − " if value < 0 else " + ")
        power = highest - place
        text += (
            f"{sign}({rounded_to_error(abs(value), error)} ± {rounded_to_error(error, error)})"
            + ("", " ε", " ε²", " ε³")[min(power, 3)]
        )
    strains = ", ".join(f"{100 * one:.3g}" for one in law.strains)
    return (
        element_symbol(law.element),
        unit_text(law.unit),
        text,
        "" if law.r2 is None else f"{law.r2:.3f}",
        f"{strains} %",
    )


def _estimate_text(estimate: Estimate) -> str:
    value, error = estimate_cells(estimate)
    if not error:
        return value
    return f"{value} ± {error} (95 %: {range_text(estimate.interval, estimate.standard_error)})"


def _known_cells(estimate: Estimate) -> tuple[str, str]:
    """Spell an estimate for two columns; why one is missing stands with the coefficient of all runs."""
    return estimate_cells(estimate) if estimate.value is not None else ("-", "")


def _coulomb_row(run: CoulombRun) -> tuple[str, ...]:
    return (
        run.file,
        number_text(run.speed_mm_s),
        f"{run.weight_mN:.1f}",
        *_known_cells(run.force),
        *_known_cells(run.mu),
        *_known_cells(run.mu_without_viscous),
        f"{run.viscous_mN:.2f}" if isfinite(run.viscous_mN) else "-",
        "" if run.viscous_share is None else f"{100 * run.viscous_share:.1f} %",
    )


def _speed_row(point: SpeedPoint) -> tuple[str, ...]:
    value, error = point.force.value, point.force.standard_error
    over = None if value is None else value - point.model_mN
    return (
        number_text(point.speed_mm_s),
        str(point.runs),
        *estimate_cells(point.force),
        f"{point.f_e_mN:.1f}",
        f"{point.f_v_mN:.1f}",
        f"{point.f_c_mN:.1f}",
        f"{point.model_mN:.1f}",
        "" if over is None else f"{over:+.1f}",
        "" if over is None or not error else f"{over / error:+.1f}",
    )


def _log_law_lines(law: LogLaw) -> Sequence[str]:
    fits = "too few speeds to tell whether it holds"
    if law.lack_of_fit_p is not None:
        doubted = (
            "stray from it by more than their errors"
            if law.lack_of_fit_p < LACK_OF_FIT_P
            else "lie on it within errors"
        )
        fits = f"the forces {doubted} ({p_value_text(law.lack_of_fit_p)})"
    rows = [
        (letter, rounded_to_error(one.value, one.standard_error), interval_text(one))
        for letter, one in (("a", law.intercept), ("b", law.slope))
    ]
    heading = f"Force = a + b ln(v / 1 mm/s), R² {law.r2:.3f}: {fits}"
    return heading, text_columns(("", "mN", "95 % interval"), rows)


def _r2_text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def element_symbol(name: str) -> str:
    """Spell an element or a time constant as on paper: η1, τ2."""
    return name.replace("eta", "η").replace("tau", "τ")


CHI2_ALERT_SD = 4.0
"""Standard deviations of χ² above which a run is pointed out."""
UNKNOWN_CELL = "-"
LARGE_CHI2 = 1000.0
MISSING_PARTS = {
    "joint": "Joint fit: none.",
    "relaxation": "Relaxation: not identified.",
    "coulomb": "Coulomb friction: not identified.",
    "drag": "Drag: not identified.",
}


def identification_text(identification: Identification) -> str:
    """Return all that an identification says: the joint fit, each kind of run by itself, and what was left out."""
    parts = [
        _identification_heading(identification),
        joint_fit_text(identification.joint) if identification.joint is not None else MISSING_PARTS["joint"],
        *_part_texts(identification),
        left_out_text(identification.left_out),
        "\n".join(f"! {remark}" for remark in identification.remarks),
    ]
    return "\n\n".join(part for part in parts if part)


def _part_texts(identification: Identification) -> Iterator[str]:
    one = identification
    if one.joint is not None and all(part is None for part in (one.relaxation, one.coulomb, one.drag)):
        return  # a model that has no such parts
    yield relaxation_text(one.relaxation) if one.relaxation is not None else MISSING_PARTS["relaxation"]
    yield coulomb_text(one.coulomb) if one.coulomb is not None else MISSING_PARTS["coulomb"]
    yield drag_text(one.drag) if one.drag is not None else MISSING_PARTS["drag"]


def joint_fit_text(fit: JointFit) -> str:
    """Return the joint fit: parameters, their products, what cannot be told apart, and how each run is left."""
    lines = [_joint_fit_heading(fit), "", _parameter_columns(fit)]
    if fit.combinations:
        rows = [
            (*_parameter_cells(one, fit), _half_width_percent(one, fit), unit_text(one.unit))
            for one in fit.combinations
        ]
        lines += ["", "What these combine to", text_columns(("", "value", "95 % interval", "±", ""), rows)]
    told = [*_joint_fit_warnings(fit), *fit.remarks]
    lines += ["", *(f"! {one}" for one in told)] if told else []
    if fit.runs:
        lines += ["", _residual_columns(fit.runs)]
    return "\n".join(lines)


def left_out_text(left_out: Sequence[Exclusion]) -> str:
    """Return what is not used, and why; empty where nothing was left out."""
    if not left_out:
        return ""
    return "Left out\n" + text_columns(("what", "why"), [(one.what, one.reason) for one in left_out])


def _identification_heading(identification: Identification) -> str:
    used, all_runs = len(identification.used), len(identification.used) + len(identification.left_out)
    runs = f"{used} run{'' if used == 1 else 's'}" if used == all_runs else f"{used} of {all_runs} runs"
    return f"Specimen {identification.specimen}: {runs} used. Intervals hold 95 %; ± in columns is a standard error."


def _joint_fit_heading(fit: JointFit) -> str:
    if not fit.converged:
        return f"Joint fit of the {fit.nominal} model: did NOT converge in {fit.steps} steps, no interval below holds."
    per_degree = (
        f"χ² is {fit.chi2 / fit.degrees:.3g} per degree of freedom ({fit.degrees})"
        if fit.degrees
        else "no degree of freedom"
    )
    beginning = (
        f"Joint fit of the {fit.nominal} model, {fit.steps} steps: {per_degree}, {_fit_p_value_text(fit.p_value)}"
    )
    if not fit.holds:
        return f"{beginning}: the model leaves something unexplained, so that no interval below need hold."
    if not any(one.determined for one in fit.parameters):
        return f"{beginning}. These runs determine NONE of its parameters."
    return f"{beginning}."


def _fit_p_value_text(p_value: float) -> str:
    return "its chance not known" if isnan(p_value) else p_value_text(p_value)


def _parameter_cells(one: ParameterEstimate, fit: JointFit) -> tuple[str, str, str]:
    """Return name, value and interval: no value that the runs do not determine, no interval that does not hold."""
    if not one.determined:
        return one.name, UNKNOWN_CELL, ""
    return one.name, rounded_to_error(one.value, one.standard_error), interval_text(one) if fit.converged else ""


def _parameter_columns(fit: JointFit) -> str:
    rows = [
        (
            *_parameter_cells(one, fit),
            unit_text(one.unit),
            range_text(one.prior, one.standard_error),
            f"{100 * one.learnt:.0f} %" if fit.converged else "",
            one.meaning,
        )
        for one in fit.parameters
    ]
    return text_columns(("parameter", "value", "95 % interval", "", "before the runs", "learnt", "what it is"), rows)


def _joint_fit_warnings(fit: JointFit) -> Iterator[str]:
    unknown = [one.name for one in fit.parameters if not one.determined]
    if unknown:
        yield f"the runs say next to nothing of {_joined_names(unknown)}: no more is known than before"
    strange = [one.name for one in fit.parameters if one.determined and not one.prior[0] <= one.value <= one.prior[1]]
    if strange:
        yield (
            f"{_joined_names(strange)} lies outside of what was expected before the runs"
            if len(strange) == 1
            else (f"{_joined_names(strange)} lie outside of what was expected before the runs")
        )
    odd = [one.file for one in fit.runs if _exceeds_noise(one)]
    if odd:
        yield f"the model leaves more than noise in {_joined_names(odd)}"


def _residual_columns(runs: Sequence[RunResidual]) -> str:
    factors = list(dict.fromkeys(name for run in runs for name in run.factors))
    offsets = list(dict.fromkeys(name for run in runs for name in run.offsets))
    own = (*(f"{name} ×" for name in factors), *offsets)
    header = ("run", "kind", "channel", "χ²", "", "rms mN", "zero mN", "±", *own)
    return text_columns(header, [_residual_row(run, factors, offsets) for run in runs])


def _residual_row(run: RunResidual, factors: Sequence[str], offsets: Sequence[str]) -> tuple[str, ...]:
    zero = estimate_cells(run.zero) if run.zero.value is not None else (UNKNOWN_CELL, "")
    return (
        run.file,
        run.kind,
        run.channel,
        f"{run.chi2:.2f}" if run.chi2 < LARGE_CHI2 else f"{run.chi2:.3g}",
        "!" if _exceeds_noise(run) else "",
        f"{run.rms_mN:.2f}",
        *zero,
        *_run_factor_cells(run.factors, factors, ".3f"),
        *_run_factor_cells(run.offsets, offsets, ".1f"),
    )


def _run_factor_cells(known: Mapping[str, Estimate], names: Sequence[str], spelling: str) -> tuple[str, ...]:
    found = (known.get(name) for name in names)
    return tuple("" if one is None or one.value is None else format(one.value, spelling) for one in found)


def _exceeds_noise(run: RunResidual) -> bool:
    return run.blocks > 0 and run.chi2 > 1 + CHI2_ALERT_SD * sqrt(2 / run.blocks)


def _half_width_percent(one: ParameterEstimate, fit: JointFit) -> str:
    share = one.half_width
    return f"{number_text(100 * share, 2)} %" if fit.converged and one.determined and share < 10 else ""


def _joined_names(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
