"""The identification of a specimen: one fit of a nominal model to all its runs, and each kind of run on its own."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np

from dragrig.analysis import (
    FORCE_CHANNEL,
    NORMAL_95,
    PARAMETER_BOUND,
    CapsuleModel,
    Estimate,
    JointProblem,
    JointSolution,
    NominalModel,
    Progress,
    RunSelection,
    counted,
    is_at_bound,
    missing,
    no_progress,
    single_blas_thread,
    solve_joint,
    zero_remarks,
)
from dragrig.analysis.identification.identification import (
    MIN_P_VALUE,
    Identification,
    JointFit,
    ParameterEstimate,
    RelaxationResult,
    RunResidual,
)
from dragrig.analysis.identification.relaxation_elements import identify_relaxation, wall_polynomials
from dragrig.analysis.identification.steady_sliding import identify_coulomb, identify_drag
from dragrig.config import AnalysisError, FrictionModelSettings, SettingsError
from dragrig.rig import FloatArray

MAX_CORRELATION = 0.95
"""Parameters that are correlated more strongly cannot be separated."""
MIN_VARIATION_P = 1e-3
"""Variations as large as the runs' are less probable than this, where a remark says so."""
MAX_ERROR_OF_PRIOR = 0.8
"""A run constrains a variation if it reduces the prior's error below this share."""


@single_blas_thread()
def fit_jointly(selection: RunSelection, nominal: NominalModel) -> JointFit:
    """Fit a nominal model, with its priors, to all runs of a specimen at once.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks a part that it needs.
    """
    from scipy.special import fdtrc

    problem = JointProblem.of(selection, nominal)
    solution = solve_joint(problem)
    values = problem.scales.values(solution.z)
    runs = tuple(_run_residuals(problem, solution, values))
    chi2 = sum(run.chi2 * run.blocks for run in runs) + float(solution.z @ solution.z)
    degrees = sum(run.blocks for run in runs)
    noise_degrees = min(noise.degrees for noise in problem.noises)
    # Noise that was assumed rejects no model, but it excuses nothing either.
    p_value = float(fdtrc(degrees, noise_degrees, chi2 / degrees)) if noise_degrees else float("nan")
    misfit = 1.0 if p_value >= MIN_P_VALUE else max(1.0, chi2 / degrees)
    # The solution's own misfit is in its covariance already.
    covariance = max(1.0, misfit / solution.misfit) * solution.covariance
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    return JointFit(
        nominal=nominal.name,
        parameters=tuple(_parameter_estimates(problem, solution.z, sd)),
        combinations=tuple(_combination_estimates(problem, values, covariance)),
        correlation=correlation,
        runs=runs,
        chi2=chi2,
        degrees=degrees,
        p_value=p_value,
        converged=solution.converged,
        steps=solution.steps,
        remarks=tuple(_joint_remarks(problem, solution, runs, correlation, misfit)),
    )


def _parameter_estimates(problem: JointProblem, z: FloatArray, sd: FloatArray) -> Iterator[ParameterEstimate]:
    scales = problem.scales
    values, low, high = (scales.values(z + side * NORMAL_95 * sd) for side in (0.0, -1.0, 1.0))
    prior_low, prior_high = (scales.values(np.full_like(z, side * NORMAL_95)) for side in (-1.0, 1.0))
    errors = scales.slopes(values) * sd
    for index, parameter in enumerate(problem.nominal.parameters):
        yield ParameterEstimate(
            name=parameter.name,
            unit=parameter.unit,
            value=float(values[index]),
            standard_error=float(errors[index]),
            interval=(float(low[index]), float(high[index])),
            prior=(float(prior_low[index]), float(prior_high[index])),
            learnt=max(0.0, 1.0 - float(sd[index])),
            meaning=parameter.meaning,
        )


def _combination_estimates(
    problem: JointProblem, values: FloatArray, covariance: FloatArray
) -> Iterator[ParameterEstimate]:
    parameters = problem.nominal.parameters
    nominal = np.array([parameter.nominal for parameter in parameters])
    for combination in problem.nominal.combinations:
        powers = np.array([combination.powers.get(parameter.name, 0.0) for parameter in parameters])
        value, prior_value = float(np.prod(values**powers)), float(np.prod(nominal**powers))
        direction = powers * problem.scales.sd
        sd, prior_sd = float(np.sqrt(direction @ covariance @ direction)), float(np.sqrt(direction @ direction))
        yield ParameterEstimate(
            name=combination.name,
            unit=combination.unit,
            value=value,
            standard_error=value * sd,
            interval=_lognormal_interval(value, sd),
            prior=_lognormal_interval(prior_value, prior_sd),
            learnt=max(0.0, 1.0 - sd / prior_sd) if prior_sd else 0.0,
            meaning=combination.meaning,
        )


def _lognormal_interval(median: float, sd: float) -> tuple[float, float]:
    return median * float(np.exp(-NORMAL_95 * sd)), median * float(np.exp(NORMAL_95 * sd))


def _run_residuals(problem: JointProblem, solution: JointSolution, values: FloatArray) -> Iterator[RunResidual]:
    by_channel = zip(problem.channels, solution.whitenings, solution.slopes, problem.zero_sds, strict=True)
    for channel, whitening, slopes, zero_sd in by_channel:
        prediction = channel.predict(values)
        residual = channel.blocks.mean - prediction.total
        whitened = whitening.whiten(residual)
        effects, covariance = whitening.posterior_run_effects(residual, slopes, solution.covariance)
        errors = np.sqrt(np.diag(covariance))
        zero = missing("the model has no zero in this channel")
        if zero_sd > 0:
            zero = Estimate(float(effects[0]) * zero_sd, float(errors[0]) * zero_sd)
            residual, effects, errors = residual - effects[0] * zero_sd, effects[1:], errors[1:]
        residual = residual - (effects * problem.variation_sds) @ prediction.varying
        factors: dict[str, Estimate] = {}
        offsets: dict[str, Estimate] = {}
        for variation, size, error in zip(problem.nominal.variations, effects, errors, strict=True):
            estimate = Estimate(variation.usual + float(size) * variation.sd, float(error) * variation.sd)
            (factors if variation.unit == "1" else offsets)[variation.name] = estimate
        durations = channel.blocks.end_s - channel.blocks.start_s
        yield RunResidual(
            file=channel.experiment.file,
            kind=channel.experiment.kind,
            channel=channel.channel,
            blocks=len(residual),
            chi2=float(whitened @ whitened) / len(residual),
            rms_mN=float(np.sqrt(np.average(residual**2, weights=durations))),
            zero=zero,
            factors=factors,
            offsets=offsets,
        )


def _joint_remarks(
    problem: JointProblem,
    solution: JointSolution,
    runs: tuple[RunResidual, ...],
    correlation: FloatArray,
    misfit: float,
) -> Iterator[str]:
    parameters = problem.nominal.parameters
    noise_is_assumed = min(noise.degrees for noise in problem.noises) == 0
    if not solution.converged:
        yield f"the fit did not converge ({solution.why}): its intervals are invalid"
    if misfit > 1.0 and not noise_is_assumed:
        worst = max(runs, key=lambda run: run.chi2)
        yield (
            f"χ² of the model {problem.nominal.name} is {misfit:.3g} times what noise and repeatability explain, most "
            f"in {worst.file} ({worst.chi2:.3g} times): an effect that it does not contain acts, its parameters absorb "
            f"some of it, and the intervals, widened by {np.sqrt(misfit):.2f}, may not hold"
        )
    yield from zero_remarks(problem)
    yield from _variation_remarks(problem, runs)
    pinned = [parameter.name for parameter, bound in zip(parameters, is_at_bound(solution.z), strict=True) if bound]
    if pinned:
        yield (
            f"{' and '.join(pinned)} reached the bound of the fit, {PARAMETER_BOUND:g} prior standard deviations from "
            "the nominal value: the model does not describe these runs"
        )
    for group in correlated_groups(correlation):
        names = [parameters[index].name for index in group]
        yield (
            f"{', '.join(names[:-1])} and {names[-1]} can hardly be separated by these runs (correlation at least "
            f"{MAX_CORRELATION:g}): their combination is known better than each of them"
        )
    if noise_is_assumed:
        yield (
            "no run rests long enough to show its noise, which was assumed: whether the model holds cannot be tested, "
            f"and the intervals were widened by {np.sqrt(misfit):.2f} for its residuals"
        )


def correlated_groups(correlation: FloatArray) -> Iterator[list[int]]:
    """Yield the places of parameters that are correlated by more than `MAX_CORRELATION`."""
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(np.abs(correlation) > MAX_CORRELATION, directed=False)
    for group in range(count):
        members = np.flatnonzero(label == group).tolist()
        if len(members) > 1:
            yield members


def _variation_remarks(problem: JointProblem, runs: tuple[RunResidual, ...]) -> Iterator[str]:
    from scipy.special import chdtrc

    for variation in problem.nominal.variations:
        estimates = [{**run.factors, **run.offsets}[variation.name] for run in runs]
        # A run that does not constrain a variation has the usual value with the prior's error.
        deviations = [
            estimate.value - variation.usual
            for estimate in estimates
            if estimate.value is not None
            and estimate.standard_error is not None
            and estimate.standard_error < MAX_ERROR_OF_PRIOR * variation.sd
        ]
        chi2 = float(np.sum(np.square(deviations))) / variation.sd**2
        if deviations and chdtrc(len(deviations), chi2) < MIN_VARIATION_P:
            rms = float(np.sqrt(np.mean(np.square(deviations))))
            by, usual = (f"{size:.1%}" if variation.unit == "1" else f"{size:.3g}" for size in (rms, variation.sd))
            yield (
                f"{variation.name} differs from run to run by {by}, more than the usual {usual}: "
                "the specimen changes, or an effect acts that the model does not contain"
            )


ResultT = TypeVar("ResultT")

MISSING_KIND_REMARKS = {
    "relaxation": "no usable relaxation: the elements are known from the drag alone, if at all",
    "coulomb": "no usable Coulomb run: the friction coefficient is known from the drag alone, if at all",
    "drag": "no usable drag run: nothing is known of the contact angle and of steady drag",
}
JOINT_COST, RELAXATION_COST, SLIDING_COST = 31, 5, 7
"""Relative times of the joint fit, of the relaxations' own, and of Coulomb test and drag."""


def identify_specimen(
    selection: RunSelection, nominal: NominalModel, progress: Progress = no_progress
) -> Identification:
    """Identify a specimen.

    The joint fit of the nominal model is always made. With the friction model of the capsule the relaxations, the
    Coulomb test and the drag are evaluated on their own too, the drag beside the model from the joint fit.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks a part that it needs.
    """
    advance = counted(progress, JOINT_COST + RELAXATION_COST + SLIDING_COST)
    joint = fit_jointly(selection, nominal)
    advance(JOINT_COST)
    remarks = list(selection.remarks)
    relaxation = coulomb = drag = None

    def attempt(evaluate: Callable[[], ResultT], what: str) -> ResultT | None:
        try:
            return evaluate()
        except (AnalysisError, SettingsError) as error:
            remarks.append(f"{what}: {error}")
            return None

    if isinstance(nominal, CapsuleModel):
        remarks += [remark for kind, remark in MISSING_KIND_REMARKS.items() if not selection.of_kind(kind)]
        model = identified_settings(nominal, joint)
        zeros = {run.file: run.zero for run in joint.runs if run.channel == FORCE_CHANNEL} if joint.converged else None
        relaxation = attempt(lambda: identify_relaxation(selection), "relaxation")
        advance(RELAXATION_COST)
        coulomb = attempt(lambda: identify_coulomb(selection, model), "Coulomb test")
        before = nominal.settings if joint.converged else None
        drag = attempt(lambda: identify_drag(selection, model, zeros, before), "drag")
        advance(SLIDING_COST)
    return Identification(
        backends=selection.backends,
        specimen=selection.specimen,
        used=tuple(experiment.file for experiment in selection.experiments),
        left_out=selection.left_out,
        joint=joint,
        relaxation=relaxation,
        coulomb=coulomb,
        drag=drag,
        remarks=tuple(remarks),
    )


def determined_values(joint: JointFit) -> dict[str, float]:
    """Return the values of the parameters that the runs determine; the others keep their nominal values."""
    return {parameter.name: parameter.value for parameter in joint.parameters if parameter.determined}


def why_no_model(joint: JointFit) -> str | None:
    """Return why a joint fit gives no model of the runs, None where it gives one."""
    if not joint.converged:
        return "the joint fit did not converge, so that there is no model; see its remarks"
    if not determined_values(joint):
        return "these runs determine no parameter, so that there is no model of them"
    return None


def identified_settings(nominal: CapsuleModel, joint: JointFit) -> FrictionModelSettings:
    """Return the friction model with the determined values, the rest nominal."""
    return nominal.settings_of(determined_values(joint)) if joint.converged else nominal.settings


def with_identified_wall(settings: FrictionModelSettings, relaxation: RelaxationResult) -> FrictionModelSettings:
    """Return the friction model with polynomials through the specimen's own relaxations for its wall.

    Raises
    ------
    AnalysisError
        Where the relaxations do not support them.
    """
    if not relaxation.laws:
        reasons = "; ".join(relaxation.remarks) or "there is no usable relaxation"
        raise AnalysisError(f"the wall cannot be taken from these relaxations ({reasons}); leave out --wall fitted.")
    try:
        polynomials = wall_polynomials(relaxation.laws)
    except SettingsError as error:
        raise AnalysisError(f"the wall cannot be taken from these relaxations: {error}") from error
    return settings.model_copy(update={"wall": "polynomial", "wall_polynomials": polynomials})
