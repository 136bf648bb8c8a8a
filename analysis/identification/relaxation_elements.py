"""The five elements of every relaxation run of a specimen, and their dependence on strain as in Eq. 14."""

from collections.abc import Iterable, Sequence

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.estimates import NORMAL_95, Estimate, EstimatedQuantity
from dragrig.analysis.identification.identification import RelaxationFit, RelaxationResult, StrainLaw
from dragrig.analysis.identification.maxwell_fit import (
    POOR_FIT_CHI2,
    BranchFit,
    ShearRecord,
    WhitenedRecord,
    fit_two_branches,
    third_branch_test,
)
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.capsule_model import STIFFNESS_SCATTER
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.paper.published import WALL_UNITS
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import WallPolynomials
from dragrig.rig.arrays import FloatArray

ELEMENT_NAMES = tuple(WALL_UNITS)
TIME_CONSTANTS = ("tau1", "tau2")
MAX_RELATIVE_ERROR = 0.25
"""Largest relative standard error with which a run supports an element."""
MIN_SAMPLES_PER_TIME_CONSTANT = 1.5
"""A branch that relaxes within fewer samples absorbs whatever the stage does between two of them."""
SAME_STRAIN_TOLERANCE = 0.01
"""Relative difference up to which strains count as repeats of one strain."""
MAX_DEGREE = 2

_TO_ELEMENTS = np.array(
    [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, 1, 0, 1]], dtype=float
)
"""Logarithms of E1, E2, E3, η1, η2 from zero and logarithms of E3, E1, E2, τ1, τ2."""


@single_blas_thread()
def identify_relaxation(selection: RunSelection) -> RelaxationResult:
    """Identify E1, E2, E3, η1, η2 from each relaxation run, ramp and hold, and their laws over strain.

    Noise levels are estimated from the rests and the ends of the holds of these runs, which share them. A run that
    supports no elements has none, with the reason in its `remark`.
    """
    experiments = selection.of_kind("relaxation")
    if not experiments:
        return RelaxationResult((), (), ("There is no relaxation run, so that the five elements are not known.",))
    noise = estimate_noise(experiments, "force")
    fits = tuple(_fit_relaxation(experiment, noise) for experiment in experiments)
    return RelaxationResult(fits, *strain_laws(fits))


def _fit_relaxation(experiment: Experiment, noise: NoiseModel) -> RelaxationFit:
    """Identify the five elements of one run; nothing is raised."""
    try:
        record = ShearRecord.of(experiment)
        whitened = WhitenedRecord.of(record, noise)
        fit = fit_two_branches(whitened)
    except AnalysisError as error:
        remark = str(error).removeprefix(f"{experiment.file}: ")
        return RelaxationFit(experiment.file, experiment.shear_strain, remark=remark)
    covariance = fit.covariance()
    logs = _TO_ELEMENTS @ fit.values
    element_covariance = _TO_ELEMENTS @ covariance @ _TO_ELEMENTS.T
    errors = np.sqrt(np.diag(element_covariance))
    if (reason := _unsupported_reason(record, fit, errors)) is not None:
        return RelaxationFit(
            record.file, record.shear_strain, chi2=fit.chi2, degrees=fit.degrees, converged=fit.converged, remark=reason
        )
    remarks = []
    if not record.rested:
        remarks.append("no rest shows the sensor's zero, which was assumed as 0 ± 5 mN")
    if fit.reduced_chi2 > POOR_FIT_CHI2:
        remarks.append(
            f"the five elements describe it poorly (χ² per degree {fit.reduced_chi2:.3g}), which widened the intervals"
        )
    return RelaxationFit(
        file=record.file,
        shear_strain=record.shear_strain,
        elements=_lognormal(WALL_UNITS.items(), logs, errors),
        times=_lognormal([(name, "s") for name in TIME_CONSTANTS], fit.values[4:], np.sqrt(np.diag(covariance)[4:])),
        correlation=element_covariance / np.outer(errors, errors),
        zero=Estimate(float(fit.values[0]), float(np.sqrt(covariance[0, 0]))),
        chi2=fit.chi2,
        degrees=fit.degrees,
        test=third_branch_test(whitened, fit),
        converged=True,
        remark="; ".join(remarks),
    )


def _lognormal(named: Iterable[tuple[str, str]], logs: FloatArray, errors: FloatArray) -> tuple[EstimatedQuantity, ...]:
    return tuple(
        EstimatedQuantity.lognormal(name, unit, float(log), float(error))
        for (name, unit), log, error in zip(named, logs, errors, strict=True)
    )


def _unsupported_reason(record: ShearRecord, fit: BranchFit, errors: FloatArray) -> str | None:
    if not fit.converged:
        return f"the fit did not converge: {_missing_information(record, fit)}"
    fast = float(fit.times_s[0])
    if fast < MIN_SAMPLES_PER_TIME_CONSTANT * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too slow for a fast branch of {1e3 * fast:.2g} ms"
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    if errors[worst] <= MAX_RELATIVE_ERROR:
        return None
    if fit.reduced_chi2 > POOR_FIT_CHI2:
        return f"a spring and two Maxwell branches do not describe its force (χ² per degree {fit.reduced_chi2:.0f})"
    name, factor = ELEMENT_NAMES[worst], np.exp(min(NORMAL_95 * errors[worst], 9.0))
    return f"{name} stays uncertain by a factor of {factor:.2g}: {_missing_information(record, fit)}"


def _missing_information(record: ShearRecord, fit: BranchFit) -> str:
    """Say what a run lacks that does not determine both branches."""
    fast, slow = fit.times_s.tolist()
    ramp = record.ramp_s[1] - record.ramp_s[0]
    if slow > 0.5 * record.hold_s:
        return f"its hold of {record.hold_s:.3g} s is too short to separate the slow branch from the spring"
    if fast < 2 * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too slow for the fast branch"
    if fast < 0.05 * ramp:
        return f"its ramp of {ramp:.3g} s is too slow to show the fast branch"
    return "its force shows no two separate branches"


def strain_laws(fits: Iterable[RelaxationFit]) -> tuple[tuple[StrainLaw, ...], tuple[str, ...]]:
    """Fit each element against strain, by weighted least squares.

    Runs at one strain are averaged first. A point's error includes its interval, the run-to-run scatter of 2 %, and
    the scatter of its repeats if that is more; the covariance includes the lack of fit where points lie further from
    the polynomial than that.

    Returns
    -------
    laws, remarks
        A quadratic over three or more strains, a straight line over two, none over one; remarks say which.
    """
    groups: list[list[RelaxationFit]] = []
    for fit in sorted((fit for fit in fits if fit.elements), key=lambda fit: fit.shear_strain):
        if groups and fit.shear_strain - groups[-1][0].shear_strain <= SAME_STRAIN_TOLERANCE * fit.shear_strain:
            groups[-1].append(fit)
        else:
            groups.append([fit])
    strains = tuple(float(np.mean([fit.shear_strain for fit in group])) for group in groups)
    if len(strains) < 2:
        known = "no run" if not strains else f"only the strain of {100 * strains[0]:.4g} %"
        return (), (f"The elements' dependence on strain is unknown: {known} gave elements.",)
    laws = tuple(_fit_law(index, strains, groups) for index in range(len(ELEMENT_NAMES)))
    remarks = {
        2: "Two strains give straight lines through both; a curvature as in Eq. 14 needs a third.",
        3: "The quadratics run exactly through the three strains, so that nothing checks them.",
    }
    return laws, (remarks[len(strains)],) if len(strains) in remarks else ()


def _fit_law(index: int, strains: tuple[float, ...], groups: Sequence[Sequence[RelaxationFit]]) -> StrainLaw:
    values, errors = np.array([_strain_mean([fit.elements[index] for fit in group]) for group in groups]).T
    degree = min(MAX_DEGREE, len(strains) - 1)
    powers = np.vander(np.array(strains), degree + 1)
    weighted = powers / errors[:, None]
    coefficients, *_ = np.linalg.lstsq(weighted, values / errors)
    degrees = len(strains) - degree - 1
    residual = values - powers @ coefficients
    widening = max(1.0, float(((residual / errors) ** 2).sum()) / degrees) if degrees else 1.0
    about_mean = float(((values - values.mean()) ** 2).sum())
    element = groups[0][0].elements[index]
    return StrainLaw(
        element=element.name,
        unit=element.unit,
        strains=strains,
        coefficients=tuple(map(float, coefficients)),
        covariance=widening * np.linalg.inv(weighted.T @ weighted),
        r2=1 - float(residual @ residual) / about_mean if degrees and about_mean else None,
    )


def _strain_mean(repeats: Sequence[EstimatedQuantity]) -> tuple[float, float]:
    """Mean of an element over the runs at one strain, and its standard error."""
    values = np.array([quantity.value for quantity in repeats])
    errors = np.array([quantity.standard_error for quantity in repeats])
    mean = float(values.mean())
    variance = float((errors**2).mean()) + (STIFFNESS_SCATTER * mean) ** 2
    if len(values) > 1:
        variance = max(variance, float(values.var(ddof=1)))
    return mean, float(np.sqrt(variance / len(values)))


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
        Where an element is missing, or a law is not positive throughout its strains.
    """
    by_element = {law.element: law for law in laws}
    missing = [name for name in ELEMENT_NAMES if name not in by_element]
    if missing:
        raise AnalysisError(
            f"No law over strain for {', '.join(missing)}: relaxations at two strains or more are needed for a wall"
        )
    for name in ELEMENT_NAMES:
        law = by_element[name]
        between = np.linspace(min(law.strains), max(law.strains), 101)
        values, _ = evaluate_strain_law(law, between)
        if values.min() <= 0:
            raise AnalysisError(
                f"The law of {name} is not positive at a strain of {between[values.argmin()]:.0%}, as a wall must be; "
                "measure at more strains"
            )
    return WallPolynomials.model_validate({name: by_element[name].coefficients for name in ELEMENT_NAMES})
