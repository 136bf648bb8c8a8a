"""The five elements of every relaxation run of a specimen, and their dependence on strain as in Eq. 14."""

from collections.abc import Iterable, Sequence

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.estimates import NORMAL_95, Estimate, EstimatedQuantity
from dragrig.analysis.identification.identification import RelaxationFit, RelaxationResult, StrainLaw
from dragrig.analysis.identification.maxwell_fit import (
    BranchFit,
    ShearRecord,
    WhitenedRecord,
    fit_two_branches,
    third_branch_test,
)
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import WallPolynomials
from dragrig.rig.arrays import FloatArray

RUN_TO_RUN_STIFFNESS = 0.02
"""Relative standard deviation of all stiffness from run to run on one specimen."""
SAME_STRAIN_TOLERANCE = 0.01
"""Strains that differ by less than this share are one strain, repeated."""
MAX_DEGREE = 2
ELEMENT_NAMES = ("E1", "E2", "E3", "eta1", "eta2")


def strain_laws(fits: Iterable[RelaxationFit]) -> tuple[tuple[StrainLaw, ...], tuple[str, ...]]:
    """Fit each element against strain.

    Runs at one strain are averaged first. A point's error holds its interval, the run-to-run scatter of 2 %, and what
    its repeats scatter by if that is more; the covariance holds the lack of fit where points lie further from the
    polynomial than that.

    Returns
    -------
    laws, remarks
        A quadratic over three or more strains, a straight line over two, none over one; remarks say which.
    """
    usable = [fit for fit in fits if fit.elements]
    groups = _by_strain(usable)
    strains = tuple(float(np.mean([fit.shear_strain for fit in group])) for group in groups)
    if len(strains) < 2:
        told = "no run" if not strains else f"only the strain of {100 * strains[0]:.4g} %"
        return (), (f"The elements' dependence on strain is unknown: {told} gave elements.",)
    laws = tuple(_fit_law(index, strains, groups) for index in range(len(ELEMENT_NAMES)))
    remarks = {
        2: "Two strains give straight lines through both; a curvature as in Eq. 14 needs a third.",
        3: "The quadratics run exactly through the three strains, so that nothing checks them.",
    }
    return laws, (remarks[len(strains)],) if len(strains) in remarks else ()


def evaluate_strain_law(law: StrainLaw, strain: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return value and standard error of a law at strains, each of their shape."""
    powers = np.vander(np.asarray(strain, dtype=float), len(law.coefficients))
    variance = np.einsum("ij,jk,ik->i", powers, law.covariance, powers)
    return np.asarray(powers @ np.array(law.coefficients)), np.sqrt(np.maximum(variance, 0.0))


def wall_polynomials(laws: Sequence[StrainLaw]) -> WallPolynomials:
    """Turn the laws of all five elements into what the simulator loads as `wall = "polynomial"`.

    Raises
    ------
    AnalysisError
        Where an element is lacking, or a law is not positive throughout the strains that it comes from.
    """
    found = {law.element: law for law in laws}
    lacking = [name for name in ELEMENT_NAMES if name not in found]
    if lacking:
        raise AnalysisError(
            f"No law over strain for {', '.join(lacking)}: relaxations at two strains or more are needed for a wall"
        )
    for name in ELEMENT_NAMES:
        law = found[name]
        between = np.linspace(min(law.strains), max(law.strains), 101)
        values, _ = evaluate_strain_law(law, between)
        if values.min() <= 0:
            raise AnalysisError(
                f"The law of {name} is not positive at a strain of {between[values.argmin()]:.0%}, as a wall must be; "
                "measure at more strains"
            )
    return WallPolynomials.model_validate({name: found[name].coefficients for name in ELEMENT_NAMES})


def _by_strain(fits: Iterable[RelaxationFit]) -> list[list[RelaxationFit]]:
    groups: list[list[RelaxationFit]] = []
    for fit in sorted(fits, key=lambda one: one.shear_strain):
        if groups and fit.shear_strain - groups[-1][0].shear_strain <= SAME_STRAIN_TOLERANCE * fit.shear_strain:
            groups[-1].append(fit)
        else:
            groups.append([fit])
    return groups


def _fit_law(index: int, strains: tuple[float, ...], groups: Sequence[Sequence[RelaxationFit]]) -> StrainLaw:
    points = np.array([_strain_mean(index, group) for group in groups])
    values, errors = points[:, 0], points[:, 1]
    degree = min(MAX_DEGREE, len(strains) - 1)
    powers = np.vander(np.array(strains), degree + 1)
    weighted = powers / errors[:, None]
    coefficients, *_ = np.linalg.lstsq(weighted, values / errors)
    inverse = np.linalg.inv(weighted.T @ weighted)
    free = len(strains) - degree - 1
    stray = values - powers @ coefficients
    scale = max(1.0, float(((stray / errors) ** 2).sum()) / free) if free else 1.0
    around = float(((values - values.mean()) ** 2).sum())
    return StrainLaw(
        element=ELEMENT_NAMES[index],
        unit=groups[0][0].elements[index].unit,
        strains=strains,
        coefficients=tuple(float(one) for one in coefficients),
        covariance=scale * inverse,
        r2=1 - float(stray @ stray) / around if free and around else None,
    )


def _strain_mean(index: int, group: Sequence[RelaxationFit]) -> tuple[float, float]:
    """Mean of an element over the runs at one strain, and its standard error."""
    values = np.array([fit.elements[index].value for fit in group])
    errors = np.array([fit.elements[index].standard_error for fit in group])
    mean = float(values.mean())
    variance = float((errors**2).mean()) + (RUN_TO_RUN_STIFFNESS * mean) ** 2
    if len(values) > 1:
        variance = max(variance, float(values.var(ddof=1)))
    return mean, float(np.sqrt(variance / len(values)))


RELAXATION_KIND = "relaxation"
ELEMENT_UNITS = (("E1", "kPa"), ("E2", "kPa"), ("E3", "kPa"), ("eta1", "kPa·s"), ("eta2", "kPa·s"))
TIME_CONSTANTS = ("tau1", "tau2")
MAX_RELATIVE_ERROR = 0.25
"""A relative standard error beyond which a run does not support an element."""
MIN_SAMPLES_PER_TIME_CONSTANT = 1.5
"""A branch that relaxes within fewer samples takes up whatever the stage does between two of them."""
POOR_FIT_CHI2 = 2.0
"""Squared whitened residuals per degree of freedom beyond which the fit is called poor."""

_TO_ELEMENTS = np.array(
    [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, 1, 0, 1]], dtype=float
)
"""Logarithms of E1, E2, E3, η1, η2 from zero and logarithms of E3, E1, E2, τ1, τ2."""


@single_blas_thread()
def identify_relaxation(selection: RunSelection) -> RelaxationResult:
    """Identify E1, E2, E3, η1, η2 from each relaxation run, ramp and hold, and their laws over strain.

    Noise levels are estimated from the rests and the ends of the holds of these runs, which share them. A run that
    does not support numbers gets none, with the reason in its `remark`.
    """
    experiments = selection.of_kind(RELAXATION_KIND)
    if not experiments:
        return RelaxationResult(
            (), (), ("There is no relaxation run, so that nothing says what the five elements are.",)
        )
    noise = estimate_noise(experiments, "force")
    fits = tuple(fit_relaxation(experiment, noise) for experiment in experiments)
    laws, remarks = strain_laws(fits)
    return RelaxationResult(fits, laws, remarks)


def fit_relaxation(experiment: Experiment, noise: NoiseModel) -> RelaxationFit:
    """Identify the five elements of one run; what it does not support is missing, and nothing is raised."""
    try:
        record = ShearRecord.of(experiment)
        whitened = WhitenedRecord.of(record, noise)
        fit = fit_two_branches(whitened)
    except AnalysisError as fault:
        told = str(fault).removeprefix(f"{experiment.file}: ")
        return RelaxationFit(experiment.file, experiment.shear_strain, remark=told)
    if not fit.converged:
        return _unsupported_fit(record, fit, f"the fit did not converge: {_missing_information(record, fit)}")
    covariance = fit.covariance()
    logs = _TO_ELEMENTS @ fit.values
    among = _TO_ELEMENTS @ covariance @ _TO_ELEMENTS.T
    errors = np.sqrt(np.diag(among))
    if (reason := _unsupported_reason(record, fit, errors)) is not None:
        return _unsupported_fit(record, fit, reason)
    zero = Estimate(float(fit.values[0]), float(np.sqrt(covariance[0, 0])))
    return RelaxationFit(
        file=record.file,
        shear_strain=record.shear_strain,
        elements=_quantities(ELEMENT_UNITS, logs, errors),
        times=_quantities([(name, "s") for name in TIME_CONSTANTS], fit.values[4:], np.sqrt(np.diag(covariance)[4:])),
        correlation=among / np.outer(errors, errors),
        zero=zero,
        chi2=fit.chi2,
        degrees=fit.degrees,
        test=third_branch_test(whitened, fit),
        converged=True,
        remark=_fit_remark(record, fit),
    )


def _quantities(
    names: Iterable[tuple[str, str]], logs: FloatArray, errors: FloatArray
) -> tuple[EstimatedQuantity, ...]:
    return tuple(
        EstimatedQuantity(
            name,
            unit,
            value := float(np.exp(log)),
            value * float(error),
            (float(np.exp(log - NORMAL_95 * error)), float(np.exp(log + NORMAL_95 * error))),
        )
        for (name, unit), log, error in zip(names, logs, errors, strict=True)
    )


def _unsupported_fit(record: ShearRecord, fit: BranchFit, reason: str) -> RelaxationFit:
    return RelaxationFit(
        record.file, record.shear_strain, chi2=fit.chi2, degrees=fit.degrees, converged=fit.converged, remark=reason
    )


def _unsupported_reason(record: ShearRecord, fit: BranchFit, errors: FloatArray) -> str | None:
    fast = float(fit.times_s[0])
    if fast < MIN_SAMPLES_PER_TIME_CONSTANT * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too seldom for a fast branch of {1e3 * fast:.2g} ms"
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    if errors[worst] <= MAX_RELATIVE_ERROR:
        return None
    name = ELEMENT_UNITS[worst][0]
    left = fit.chi2 / max(fit.degrees, 1)
    if left > POOR_FIT_CHI2:
        return f"a spring and two Maxwell branches do not describe its force (χ² per degree {left:.0f})"
    told = f"it leaves {name} uncertain by a factor of {np.exp(min(NORMAL_95 * errors[worst], 9.0)):.2g}"
    return f"{told}: {_missing_information(record, fit)}"


def _missing_information(record: ShearRecord, fit: BranchFit) -> str:
    """Say what a run lacks that does not determine both branches."""
    fast, slow = fit.times_s.tolist()
    ramp = record.ramp_s[1] - record.ramp_s[0]
    if slow > 0.5 * record.hold_s:
        return f"its hold of {record.hold_s:.3g} s is too short to tell the slow branch from the spring"
    if fast < 2 * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too seldom for the fast branch"
    if fast < 0.05 * ramp:
        return f"its ramp of {ramp:.3g} s is too slow to show the fast branch"
    return "its force shows no two separate branches"


def _fit_remark(record: ShearRecord, fit: BranchFit) -> str:
    remarks = []
    if not record.rested:
        remarks.append("no rest shows the sensor's zero, which was taken to be 0 ± 5 mN")
    left = fit.chi2 / max(fit.degrees, 1)
    if left > POOR_FIT_CHI2:
        remarks.append(f"the five elements describe it poorly (χ² per degree {left:.3g}), which widened the intervals")
    return "; ".join(remarks)
