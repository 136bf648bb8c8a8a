"""An identification as what JSON knows: units in the names of keys, null for what is not known."""

import re
from collections.abc import Iterable, Mapping
from math import isfinite

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import (
    Coulomb,
    Drag,
    Identification,
    Identified,
    JointFit,
    LeftOut,
    Quantity,
    Relaxation,
    RelaxationFit,
    StrainLaw,
)
from dragrig.rig.arrays import FloatArray

Table = dict[str, object]


def identification_table(identification: Identification) -> Table:
    """Return all that an identification says; a part that the campaign does not support is None."""
    one = identification
    return {
        "specimen": one.specimen,
        "used": list(one.used),
        "left_out": left_out_table(one.left_out),
        "joint": None if one.joint is None else joint_table(one.joint),
        "relaxation": None if one.relaxation is None else relaxation_table(one.relaxation),
        "coulomb": None if one.coulomb is None else coulomb_table(one.coulomb),
        "drag": None if one.drag is None else drag_table(one.drag),
        "remarks": list(one.remarks),
    }


def joint_table(fit: JointFit) -> Table:
    """Return the joint fit: parameters and products by name, their correlation, and how each run is left."""
    return {
        "nominal": fit.nominal,
        "converged": fit.converged,
        "steps": fit.steps,
        "chi2": finite(fit.chi2),
        "degrees": fit.degrees,
        "p_value": finite(fit.p_value),
        "holds": fit.holds,
        "parameters": {_key(one): _identified(one, fit) for one in fit.parameters},
        "combinations": {_key(one): _identified(one, fit) for one in fit.combinations},
        "correlation": _matrix(fit.correlation, [one.name for one in fit.parameters]),
        "runs": [
            {
                "file": run.file,
                "kind": run.kind,
                "channel": run.channel,
                "blocks": run.blocks,
                "chi2_per_degree": finite(run.chi2),
                "rms_mN": finite(run.rms_mN),
                "zero_mN": _estimate(run.zero),
                "factors": {name: _estimate(one) for name, one in run.factors.items()},
                "offsets": {name: _estimate(one) for name, one in run.offsets.items()},
            }
            for run in fit.runs
        ],
        "remarks": list(fit.remarks),
    }


def relaxation_table(relaxation: Relaxation) -> Table:
    """Return the elements of each run, and how they depend on strain."""
    return {
        "runs": [_fit(fit) for fit in relaxation.fits],
        "laws": [_law(law) for law in relaxation.laws],
        "remarks": list(relaxation.remarks),
    }


def coulomb_table(coulomb: Coulomb) -> Table:
    """Return the friction coefficient of all runs and of each."""
    return {
        "mu": _estimate(coulomb.mu),
        "mu_without_viscous": _estimate(coulomb.mu_without_viscous),
        "runs": [
            {
                "file": run.file,
                "speed_mm_s": finite(run.speed_mm_s),
                "weight_mN": finite(run.weight_mN),
                "force_mN": _estimate(run.force),
                "mu": _estimate(run.mu),
                "mu_without_viscous": _estimate(run.mu_without_viscous),
                "viscous_mN": finite(run.viscous_mN),
                "viscous_share": finite(run.viscous_share),
            }
            for run in coulomb.runs
        ],
        "remarks": list(coulomb.remarks),
    }


def drag_table(drag: Drag) -> Table:
    """Return the steady drag by speed, its law, the boundary and R²."""
    law, boundary = drag.log_law, drag.boundary
    return {
        "speeds": [
            {
                "speed_mm_s": finite(point.speed_mm_s),
                "runs": point.runs,
                "force_mN": _estimate(point.force),
                "f_e_mN": finite(point.f_e_mN),
                "f_v_mN": finite(point.f_v_mN),
                "f_c_mN": finite(point.f_c_mN),
                "model_mN": finite(point.model_mN),
            }
            for point in drag.points
        ],
        "log_law": None
        if law is None
        else {
            **_quantities((law.intercept, law.slope)),
            "correlation": finite(law.correlation),
            "r2": finite(law.r2),
            "lack_of_fit_p": finite(law.lack_of_fit_p),
        },
        "boundary": None
        if boundary is None
        else {
            "speed_mm_s": finite(boundary.speed_mm_s),
            "interval_95_mm_s": _interval(boundary.interval),
            "p_value": finite(boundary.p_value),
            "sentence": boundary.sentence,
        },
        "determination": [
            {"band": one.band, "speeds": one.speeds, "eq15": finite(one.eq15), "correlation2": finite(one.correlation)}
            for one in drag.determination
        ],
        "remarks": list(drag.remarks),
    }


def left_out_table(left_out: Iterable[LeftOut]) -> list[Table]:
    """Return what was left out, and why."""
    return [{"what": one.what, "reason": one.reason} for one in left_out]


def finite(value: float | None) -> float | None:
    """Return a number as JSON knows it: None for NaN and infinities."""
    return float(value) if value is not None and isfinite(value) else None


def _fit(fit: RelaxationFit) -> Table:
    test = fit.test
    return {
        "file": fit.file,
        "shear_strain": finite(fit.shear_strain),
        "elements": _quantities(fit.elements),
        "times": _quantities(fit.times),
        "correlation": _matrix(fit.correlation, [one.name for one in fit.elements]),
        "zero_mN": _estimate(fit.zero),
        "chi2": finite(fit.chi2),
        "degrees": fit.degrees,
        "converged": fit.converged,
        "five_elements": None
        if test is None
        else {
            "suffice": test.suffices,
            "p_value": finite(test.p_value),
            "third_time_s": finite(test.third_time_s),
            "third_force_mN": finite(test.third_force_mN),
            "sentence": test.sentence,
        },
        "remark": fit.remark,
    }


def _law(law: StrainLaw) -> Table:
    return {
        "element": law.element,
        "unit": law.unit,
        "strains": [finite(one) for one in law.strains],
        "coefficients_highest_power_first": [finite(one) for one in law.coefficients],
        "covariance": [[finite(one) for one in row] for row in law.covariance.tolist()],
        "r2": finite(law.r2),
    }


def _quantities(quantities: Iterable[Quantity]) -> Table:
    return {_key(one): _quantity(one) for one in quantities}


def _quantity(one: Quantity) -> Table:
    return {
        "value": finite(one.value),
        "standard_error": finite(one.standard_error),
        "interval_95": _interval(one.interval),
    }


def _identified(one: Identified, fit: JointFit) -> Table:
    """Return a number of a joint fit: none that the runs do not determine, no error of a fit that did not converge."""
    known = one.determined
    return {
        "determined": known,
        "value": finite(one.value) if known else None,
        "standard_error": finite(one.standard_error) if known and fit.converged else None,
        "interval_95": _interval(one.interval) if known and fit.converged else None,
        "prior_95": _interval(one.prior),
        "learnt": finite(one.learnt),
        "meaning": one.meaning,
    }


def _estimate(one: Estimate) -> Table:
    return {
        "value": finite(one.value),
        "standard_error": finite(one.standard_error),
        "interval_95": _interval(one.interval),
        "reason": one.reason,
    }


def _interval(interval: tuple[float, float] | None) -> list[float | None] | None:
    return None if interval is None else [finite(one) for one in interval]


def _matrix(matrix: FloatArray | None, names: Iterable[str]) -> Mapping[str, object] | None:
    if matrix is None:
        return None
    return {"names": list(names), "rows": [[finite(one) for one in row] for row in matrix.tolist()]}


def _key(one: Quantity) -> str:
    """Return a name with its unit: E1_kPa, eta1_kPa_s; just the name where it has none or ends with it already."""
    unit = re.sub(r"[^0-9A-Za-zµμ]+", "_", one.unit).strip("_")
    return one.name if unit in {"", "1"} or one.name.endswith(f"_{unit}") else f"{one.name}_{unit}"
