"""The five elements of every relaxation run of a specimen, and how they depend on strain."""

from collections.abc import Iterable

import numpy as np

from dragrig.analysis.estimates import NORMAL_95, Estimate
from dragrig.analysis.identification.maxwell.fit import BranchFit, Whitened, fit_two
from dragrig.analysis.identification.maxwell.record import ShearRecord
from dragrig.analysis.identification.maxwell.third import five_or_more
from dragrig.analysis.identification.noise import Noise, estimate_noise
from dragrig.analysis.identification.results import Quantity, Relaxation, RelaxationFit
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.strain_law import strain_laws
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray

KIND = "relaxation"
ELEMENTS = (("E1", "kPa"), ("E2", "kPa"), ("E3", "kPa"), ("eta1", "kPa·s"), ("eta2", "kPa·s"))
TIMES = ("tau1", "tau2")
LEAST_SUPPORT = 0.25
"""A relative standard error beyond which a run does not support an element."""
FEWEST_SAMPLES = 1.5
"""A branch that relaxes within fewer samples takes up whatever the stage does between two of them."""
POOR_FIT = 2.0
"""Squared whitened residuals per degree of freedom beyond which the fit is called poor."""

_TO_ELEMENTS = np.array(
    [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0], [0, 0, 0, 1, 0, 1]], dtype=float
)
"""Logarithms of E1, E2, E3, η1, η2 from zero and logarithms of E3, E1, E2, τ1, τ2."""


@one_thread()
def identify_relaxation(selection: Selection) -> Relaxation:
    """Identify E1, E2, E3, η1, η2 from each relaxation run, ramp and hold, and their laws over strain.

    Noise levels are estimated from the rests and the ends of the holds of these runs, which share them. A run that
    does not support numbers gets none, with the reason in its `remark`.
    """
    experiments = selection.of_kind(KIND)
    if not experiments:
        return Relaxation((), (), ("There is no relaxation run, so that nothing says what the five elements are.",))
    noise = estimate_noise(experiments, "force")
    fits = tuple(fit_run(experiment, noise) for experiment in experiments)
    laws, remarks = strain_laws(fits)
    return Relaxation(fits, laws, remarks)


def fit_run(experiment: Experiment, noise: Noise) -> RelaxationFit:
    """Identify the five elements of one run; what it does not support is missing, and nothing is raised."""
    try:
        record = ShearRecord.of(experiment)
        whitened = Whitened.of(record, noise)
        fit = fit_two(whitened)
    except AnalysisError as fault:
        told = str(fault).removeprefix(f"{experiment.file}: ")
        return RelaxationFit(experiment.file, experiment.shear_strain, remark=told)
    if not fit.converged:
        return _without(record, fit, f"the fit did not converge: {_why(record, fit)}")
    covariance = fit.covariance()
    logs = _TO_ELEMENTS @ fit.values
    among = _TO_ELEMENTS @ covariance @ _TO_ELEMENTS.T
    errors = np.sqrt(np.diag(among))
    if (reason := _unsupported(record, fit, errors)) is not None:
        return _without(record, fit, reason)
    zero = Estimate(float(fit.values[0]), float(np.sqrt(covariance[0, 0])))
    return RelaxationFit(
        file=record.file,
        shear_strain=record.shear_strain,
        elements=_quantities(ELEMENTS, logs, errors),
        times=_quantities([(name, "s") for name in TIMES], fit.values[4:], np.sqrt(np.diag(covariance)[4:])),
        correlation=among / np.outer(errors, errors),
        zero=zero,
        chi2=fit.chi2,
        degrees=fit.degrees,
        test=five_or_more(whitened, fit),
        converged=True,
        remark=_remark(record, fit),
    )


def _quantities(names: Iterable[tuple[str, str]], logs: FloatArray, errors: FloatArray) -> tuple[Quantity, ...]:
    return tuple(
        Quantity(
            name,
            unit,
            value := float(np.exp(log)),
            value * float(error),
            (float(np.exp(log - NORMAL_95 * error)), float(np.exp(log + NORMAL_95 * error))),
        )
        for (name, unit), log, error in zip(names, logs, errors, strict=True)
    )


def _without(record: ShearRecord, fit: BranchFit, reason: str) -> RelaxationFit:
    return RelaxationFit(
        record.file, record.shear_strain, chi2=fit.chi2, degrees=fit.degrees, converged=fit.converged, remark=reason
    )


def _unsupported(record: ShearRecord, fit: BranchFit, errors: FloatArray) -> str | None:
    fast = float(fit.times_s[0])
    if fast < FEWEST_SAMPLES * record.step_s:
        return f"a sample every {1e3 * record.step_s:.2g} ms is too seldom for a fast branch of {1e3 * fast:.2g} ms"
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    if errors[worst] <= LEAST_SUPPORT:
        return None
    name = ELEMENTS[worst][0]
    left = fit.chi2 / max(fit.degrees, 1)
    if left > POOR_FIT:
        return f"a spring and two Maxwell branches do not describe its force (χ² per degree {left:.0f})"
    told = f"it leaves {name} uncertain by a factor of {np.exp(min(NORMAL_95 * errors[worst], 9.0)):.2g}"
    return f"{told}: {_why(record, fit)}"


def _why(record: ShearRecord, fit: BranchFit) -> str:
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


def _remark(record: ShearRecord, fit: BranchFit) -> str:
    remarks = []
    if not record.rested:
        remarks.append("no rest shows the sensor's zero, which was taken to be 0 ± 5 mN")
    left = fit.chi2 / max(fit.degrees, 1)
    if left > POOR_FIT:
        remarks.append(f"the five elements describe it poorly (χ² per degree {left:.3g}), which widened the intervals")
    return "; ".join(remarks)
