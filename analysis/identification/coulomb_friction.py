"""The friction coefficient from runs in the vacuum fixture, where the capsule's weight alone presses on the gut.

The paper divides the mean force by the weight and so counts viscous friction in: 40.07 mN at 0.5 mm/s give
0.0816, of which the model ascribes 0.73 mN to the mucus; without it 0.0801 is left.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import hypot, log

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.estimates import Estimate, missing
from dragrig.analysis.identification.identification import CoulombResult, CoulombRun
from dragrig.analysis.identification.steady_sliding import measure_sliding, rest_mean, subtract_estimates
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.capsule_model import FORCE_CHANNEL, FRICTION_SCATTER, SPECIMEN_PRIORS
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.segments import attribute_number
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.friction_force import GRAVITY_M_S2, viscous_force
from dragrig.sim_backend.friction.wall import HemisphereContact

GAIN_SD = SPECIMEN_PRIORS["force_gain"][0]
MUCUS_SD = SPECIMEN_PRIORS["mucus_scale"][0]
SAME_SPEED_FACTOR = 1.5
"""Speeds within this factor count as one speed."""
SIGNIFICANCE = 0.05
MAX_SCATTER_FACTOR = 1e3
"""Largest scatter that is searched, over the range of the values."""


@dataclass(frozen=True, slots=True)
class PooledMean:
    """A weighted mean.

    Attributes
    ----------
    mean
        Its error includes the scatter between runs.
    scatter
        Standard deviation between runs that was assumed, in the unit of the values.
    p_value
        Probability that runs differ as much by errors and the usual scatter; None for one run.
    """

    mean: Estimate
    scatter: float
    p_value: float | None


@single_blas_thread()
def identify_coulomb(selection: RunSelection, model: FrictionModelSettings) -> CoulombResult:
    """Return μ of each Coulomb run and of all together.

    The error of a run's `mu` is that of its force; `mu_without_viscous` includes besides that viscous friction
    differs by 20 % between specimens. Together, runs differ by 1.5 % of μ, or by the observed scatter where that is
    more, and share a force calibration good to 0.5 %. The paper's `mu` includes viscous friction, which grows
    with speed; it is pooled over the runs at the lowest speed only.
    """
    experiments = selection.of_kind("coulomb")
    if not experiments:
        nothing = missing("the campaign has no usable Coulomb run; record one in the vacuum fixture")
        return CoulombResult((), nothing, nothing)
    noise = estimate_noise(selection.experiments, FORCE_CHANNEL)
    runs = tuple(_measure_run(experiment, model, noise) for experiment in experiments)
    with_mu = [run for run in runs if run.mu.value is not None]
    lowest = min((abs(run.speed_mm_s) for run in with_mu), default=0.0)
    slow = [run for run in with_mu if abs(run.speed_mm_s) < SAME_SPEED_FACTOR * lowest]
    net = [run for run in runs if run.mu_without_viscous.value is not None]
    # The mucus is the same in all runs: its part of the error is common to them.
    shared = np.array([MUCUS_SD * run.viscous_mN / (run.weight_mN * model.force_gain) for run in net])
    reasons = "; ".join(f"{run.file}: {run.mu.reason or run.mu_without_viscous.reason}" for run in runs)
    nothing = missing(f"no Coulomb run supports a friction coefficient: {reasons}")
    mu = mu_without_viscous = nothing
    remarks: tuple[str, ...] = ()
    if slow:
        errors = np.array([run.mu.standard_error for run in slow], dtype=float)
        mu = _with_gain_error(_pool_runs([run.mu for run in slow], np.diag(errors**2)).mean)
    if net:
        pooled = _pool_runs([run.mu_without_viscous for run in net], _covariance(net, shared))
        mu_without_viscous = _with_gain_error(pooled.mean)
        remarks = tuple(_remarks(slow, net, shared, pooled))
    return CoulombResult(runs, mu, mu_without_viscous, remarks)


def _measure_run(experiment: Experiment, model: FrictionModelSettings, noise: NoiseModel) -> CoulombRun:
    sliding = measure_sliding(experiment, filtered=True)
    force = subtract_estimates(sliding.steady, rest_mean(experiment, sliding.direction, noise))
    if experiment.fixture is not Fixture.VACUUM:
        force = missing(
            f"its fixture is {experiment.fixture.value}, not vacuum: more than the weight presses on the gut"
        )
    mass = attribute_number(experiment.run.info.header.capsule, "mass_g")
    weight = float("nan") if mass is None else GRAVITY_M_S2 * mass
    viscous = _viscous_estimate(experiment, sliding.speed_mm_s, model)
    share = viscous.value / force.value if viscous.value is not None and force.value else None
    return CoulombRun(
        file=experiment.file,
        speed_mm_s=sliding.direction * sliding.speed_mm_s,
        weight_mN=weight,
        force=force,
        mu=_over_weight(force, weight * model.force_gain),
        mu_without_viscous=_over_weight(subtract_estimates(force, viscous), weight * model.force_gain),
        viscous_mN=float("nan") if viscous.value is None else viscous.value,
        viscous_share=share,
    )


def _viscous_estimate(experiment: Experiment, speed_mm_s: float, model: FrictionModelSettings) -> Estimate:
    """Viscous friction as the force channel shows it."""
    area = 0.0
    if model.viscous == "newtonian":
        try:
            area = HemisphereContact.of(experiment.capsule, experiment.wall_thickness_mm, model).area_mm2
        except (AnalysisError, SettingsError) as error:
            return missing(f"the viscous friction is not known: {error}")
    if not speed_mm_s > 0:
        return missing("the speed is not known")
    force = model.force_gain * float(viscous_force(np.array([speed_mm_s]), model, area)[0])
    return Estimate(force, MUCUS_SD * force)


def _over_weight(force: Estimate, weight_mN: float) -> Estimate:
    if force.value is None or force.standard_error is None:
        return missing(force.reason)
    if not weight_mN > 0:
        return missing("the run does not state its capsule's mass; import it again with mass_g")
    return Estimate(force.value / weight_mN, force.standard_error / weight_mN)


def _covariance(net: Sequence[CoulombRun], shared: FloatArray) -> FloatArray:
    """Of `mu_without_viscous`, whose errors share a part, shape `(n, n)`."""
    errors = np.array([run.mu_without_viscous.standard_error for run in net], dtype=float)
    return np.asarray(np.diag(np.maximum(errors**2 - shared**2, 0.0)) + np.outer(shared, shared))


def _pool_runs(estimates: Sequence[Estimate], covariance: FloatArray) -> PooledMean:
    values = np.array([estimate.value for estimate in estimates], dtype=float)
    return pool_estimates(values, covariance, FRICTION_SCATTER * abs(float(np.median(values))))


def pool_estimates(values: FloatArray, covariance: FloatArray, usual_scatter: float) -> PooledMean:
    """Return the weighted mean of values of shape `(n,)` with a covariance of their errors, `(n, n)`.

    The scatter between runs is the usual one, or the observed one where that is larger: the scatter that reduces
    χ² to its expectation (Paule and Mandel, J. Res. NBS 87, 1982).
    """
    from scipy.optimize import brentq
    from scipy.special import chdtrc

    degrees = len(values) - 1
    if degrees == 0:
        error = float(np.sqrt(covariance[0, 0] + usual_scatter**2))
        return PooledMean(Estimate(float(values[0]), error), usual_scatter, None)

    def weighted_mean(scatter: float) -> tuple[float, float, float]:
        """Mean, its error, and χ² about it."""
        weight = np.linalg.inv(covariance + scatter**2 * np.eye(len(values)))
        total = float(weight.sum())
        mean = float(weight.sum(axis=0) @ values) / total
        residual = values - mean
        return mean, total**-0.5, float(residual @ weight @ residual)

    scatter, chi2 = usual_scatter, weighted_mean(usual_scatter)[2]
    if chi2 > degrees:
        largest = usual_scatter + MAX_SCATTER_FACTOR * float(np.ptp(values))
        scatter = float(brentq(lambda trial: weighted_mean(trial)[2] - degrees, usual_scatter, largest))
    mean, error, _ = weighted_mean(scatter)
    return PooledMean(Estimate(mean, error), scatter, float(chdtrc(degrees, chi2)))


def _with_gain_error(mu: Estimate) -> Estimate:
    value = mu.value or 0.0
    return Estimate(mu.value, hypot(mu.standard_error or 0.0, GAIN_SD * value))


def _remarks(
    slow: Sequence[CoulombRun], net: Sequence[CoulombRun], shared: FloatArray, pooled: PooledMean
) -> Iterator[str]:
    share = slow[0].viscous_share
    if share is not None:
        yield (
            f"μ by the paper's definition includes the viscous friction: {share:.1%} of the force at "
            f"{abs(slow[0].speed_mm_s):.3g} mm/s by the model"
        )
    mean = pooled.mean.value or float("nan")
    if pooled.p_value is not None and pooled.p_value < SIGNIFICANCE:
        yield (
            f"μ differs between runs by {pooled.scatter / abs(mean):.1%}, more than the usual {FRICTION_SCATTER:.1%} "
            f"(p = {pooled.p_value:.2g}); its error includes that"
        )
    yield from _speed_remark(net, shared, mean)


def _speed_remark(net: Sequence[CoulombRun], shared: FloatArray, mean: float) -> Iterator[str]:
    """Test whether μ without viscous friction depends on speed, by generalised least squares on ln v."""
    from scipy.special import ndtr

    speeds = np.array([abs(run.speed_mm_s) for run in net])
    if len(net) < 2 or speeds.max() < SAME_SPEED_FACTOR * speeds.min():
        return
    values = np.array([run.mu_without_viscous.value for run in net], dtype=float)
    weight = np.linalg.inv(_covariance(net, shared) + (FRICTION_SCATTER * mean) ** 2 * np.eye(len(net)))
    design = np.column_stack((np.ones_like(speeds), np.log(speeds)))
    covariance = np.linalg.inv(design.T @ weight @ design)
    slope = float((covariance @ design.T @ weight @ values)[1])
    p_value = 2 * float(ndtr(-abs(slope) / float(np.sqrt(covariance[1, 1]))))
    if p_value < SIGNIFICANCE:
        yield (
            f"μ without viscous friction {'falls' if slope < 0 else 'rises'} with speed, by "
            f"{abs(slope) * log(10) / abs(mean):.1%} per decade between {speeds.min():.3g} and {speeds.max():.3g} mm/s "
            f"(p = {p_value:.2g}): one coefficient does not describe these runs"
        )
