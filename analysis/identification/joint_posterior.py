"""One fit of a nominal model to all runs of a specimen, and what its posterior says."""

from collections.abc import Iterator

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.estimates import NORMAL_95, Estimate, missing
from dragrig.analysis.identification.identification import MIN_P_VALUE, JointFit, ParameterEstimate, RunResidual
from dragrig.analysis.inference.linear_gaussian import (
    PARAMETER_BOUND,
    JointProblem,
    JointSolution,
    is_at_bound,
    solve_joint,
)
from dragrig.analysis.models.nominal_model import Combination, NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.rig.arrays import FloatArray

MAX_CORRELATION = 0.95
"""Parameters that are correlated more strongly than this cannot be told apart."""
MIN_VARIATION_P = 1e-3


def summarise_solution(problem: JointProblem, solution: JointSolution) -> JointFit:
    """Read a solution."""
    from scipy.special import fdtrc

    values = problem.scales.values(solution.z)
    runs = tuple(_run_residuals(problem, solution, values))
    chi2 = sum(one.chi2 * one.blocks for one in runs) + float(solution.z @ solution.z)
    degrees = sum(one.blocks for one in runs)
    known = min(noise.degrees for noise in problem.noises)
    # Noise that was assumed and not seen rejects no model, but it excuses nothing either.
    p_value = float(fdtrc(degrees, known, chi2 / degrees)) if known else float("nan")
    widened = 1.0 if p_value >= MIN_P_VALUE else max(1.0, chi2 / degrees)
    # The solution's own misfit is in its covariance already.
    covariance = max(1.0, widened / solution.misfit) * solution.covariance
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    return JointFit(
        nominal=problem.nominal.name,
        parameters=tuple(_parameter_estimates(problem, solution.z, sd)),
        combinations=tuple(
            _combination_estimate(problem, values, covariance, one) for one in problem.nominal.combinations
        ),
        correlation=correlation,
        runs=runs,
        chi2=chi2,
        degrees=degrees,
        p_value=p_value,
        converged=solution.converged,
        steps=solution.steps,
        remarks=tuple(_joint_remarks(problem, solution, runs, correlation, widened)),
    )


def _parameter_estimates(problem: JointProblem, z: FloatArray, sd: FloatArray) -> Iterator[ParameterEstimate]:
    scales = problem.scales
    at, low, high = (scales.values(z + side * NORMAL_95 * sd) for side in (0.0, -1.0, 1.0))
    first, last = (scales.values(np.full_like(z, side * NORMAL_95)) for side in (-1.0, 1.0))
    errors = scales.slopes(at) * sd
    for index, one in enumerate(problem.nominal.parameters):
        yield ParameterEstimate(
            name=one.name,
            unit=one.unit,
            value=float(at[index]),
            standard_error=float(errors[index]),
            interval=(float(low[index]), float(high[index])),
            prior=(float(first[index]), float(last[index])),
            learnt=max(0.0, 1.0 - float(sd[index])),
            meaning=one.meaning,
        )


def _combination_estimate(
    problem: JointProblem, values: FloatArray, covariance: FloatArray, one: Combination
) -> ParameterEstimate:
    powers = np.array([one.powers.get(parameter.name, 0.0) for parameter in problem.nominal.parameters])
    value = float(np.prod(values**powers))
    along = powers * problem.scales.sd
    sd, before = float(np.sqrt(along @ covariance @ along)), float(np.sqrt(along @ along))
    nominal = float(np.prod(np.array([parameter.nominal for parameter in problem.nominal.parameters]) ** powers))
    return ParameterEstimate(
        name=one.name,
        unit=one.unit,
        value=value,
        standard_error=value * sd,
        interval=_lognormal_interval(value, sd),
        prior=_lognormal_interval(nominal, before),
        learnt=max(0.0, 1.0 - sd / before) if before else 0.0,
        meaning=one.meaning,
    )


def _lognormal_interval(median: float, sd: float) -> tuple[float, float]:
    return median * float(np.exp(-NORMAL_95 * sd)), median * float(np.exp(NORMAL_95 * sd))


def _run_residuals(problem: JointProblem, solution: JointSolution, values: FloatArray) -> Iterator[RunResidual]:
    parts = zip(problem.channels, solution.whitenings, solution.slopes, problem.zero_sds, strict=True)
    for one, white, slopes, zero_sd in parts:
        prediction = one.predict(values)
        residual = one.blocks.mean - prediction.total
        whole = white.whiten(residual)
        own, covariance = white.posterior_run_effects(residual, slopes, solution.covariance)
        errors = np.sqrt(np.diag(covariance))
        zero = missing("the model has no zero of this channel's own")
        left = residual
        if zero_sd > 0:
            zero = Estimate(float(own[0]) * zero_sd, float(errors[0]) * zero_sd)
            left, own, errors = left - own[0] * zero_sd, own[1:], errors[1:]
        left = left - (own * problem.variation_sds) @ prediction.varying
        variations = problem.nominal.variations
        varied = {
            variation: Estimate(variation.usual + float(share) * variation.sd, float(error) * variation.sd)
            for variation, share, error in zip(variations, own, errors, strict=True)
        }
        seconds = one.blocks.end_s - one.blocks.start_s
        yield RunResidual(
            file=one.experiment.file,
            kind=one.experiment.kind,
            channel=one.channel,
            blocks=len(residual),
            chi2=float(whole @ whole) / len(residual),
            rms_mN=float(np.sqrt(np.average(left**2, weights=seconds))),
            zero=zero,
            factors={variation.name: found for variation, found in varied.items() if variation.unit == "1"},
            offsets={variation.name: found for variation, found in varied.items() if variation.unit != "1"},
        )


def _joint_remarks(
    problem: JointProblem,
    solution: JointSolution,
    runs: tuple[RunResidual, ...],
    correlation: FloatArray,
    widened: float,
) -> Iterator[str]:
    if not solution.converged:
        yield f"the fit did not converge ({solution.why}): no interval holds"
    assumed = min(noise.degrees for noise in problem.noises) == 0
    if widened > 1.0 and not assumed:
        worst = max(runs, key=lambda one: one.chi2)
        yield (
            f"the model {problem.nominal.name} leaves {widened:.3g} times the squares that noise and repeatability "
            f"explain, most in {worst.file} ({worst.chi2:.3g} times): something acts that it does not have, its "
            f"parameters soak up some of it, and the intervals, widened by {np.sqrt(widened):.2f}, need not hold"
        )
    yield from _variation_remarks(problem, runs)
    pinned = [one.name for one, at in zip(problem.nominal.parameters, is_at_bound(solution.z), strict=True) if at]
    if pinned:
        yield (
            f"{' and '.join(pinned)} reached the bound of the fit, {PARAMETER_BOUND:g} prior standard deviations from "
            "the nominal value: the model does not describe these runs"
        )
    for group in _correlated_groups(correlation):
        names = [problem.nominal.parameters[index].name for index in group]
        yield (
            f"{', '.join(names[:-1])} and {names[-1]} can hardly be told apart by these runs (correlation at least "
            f"{MAX_CORRELATION:g}): what they combine to is known better than each"
        )
    if assumed:
        yield (
            "no run rests long enough to show its noise, so that one was assumed: nothing tells whether the "
            f"model holds, and the intervals were widened by {np.sqrt(widened):.2f} for what it leaves"
        )


def _correlated_groups(correlation: FloatArray) -> Iterator[list[int]]:
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(np.abs(correlation) > MAX_CORRELATION, directed=False)
    for group in range(count):
        members = np.flatnonzero(label == group).tolist()
        if len(members) > 1:
            yield members


def _variation_remarks(problem: JointProblem, runs: tuple[RunResidual, ...]) -> Iterator[str]:
    from scipy.special import chdtrc

    for variation in problem.nominal.variations:
        found = [{**one.factors, **one.offsets}[variation.name] for one in runs]
        # A run that says nothing of a variation leaves it as usual with the prior's error.
        said = [
            one.value - variation.usual
            for one in found
            if one.value is not None and one.standard_error is not None and one.standard_error < 0.8 * variation.sd
        ]
        squares = float(np.sum(np.square(said))) / variation.sd**2
        if said and chdtrc(len(said), squares) < MIN_VARIATION_P:
            rms = float(np.sqrt(np.mean(np.square(said))))
            by, usual = (f"{size:.1%}" if variation.unit == "1" else f"{size:.3g}" for size in (rms, variation.sd))
            yield (
                f"{variation.name} differs from run to run by {by}, more than the usual {usual}: "
                "the specimen changes, or something acts that the model does not have"
            )


@single_blas_thread()
def fit_jointly(selection: RunSelection, nominal: NominalModel) -> JointFit:
    """Fit a nominal model to all runs of a specimen at once.

    Parameters
    ----------
    selection
        The runs.
    nominal
        Model with priors; see `dragrig.analysis.models`.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks what it needs.
    """
    problem = JointProblem.of(selection, nominal)
    return summarise_solution(problem, solve_joint(problem))
