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
from dragrig.analysis.models.capsule_model import FORCE_CHANNEL, RUN_VARIATIONS, SPECIMEN_PRIORS
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2, viscous_force
from dragrig.sim_backend.friction.wall import HemisphereContact

MAX_SCATTER_FACTOR = 1e3
"""Scatter beyond so many times the largest deviation is not looked for."""


@dataclass(frozen=True, slots=True)
class PooledMean:
    """A weighted mean.

    Attributes
    ----------
    mean
        Its error holds the scatter between runs.
    scatter
        Standard deviation between runs that was reckoned with, in the unit of the values.
    p_value
        Chance that runs differ so much by errors and the usual scatter; None for one run.
    """

    mean: Estimate
    scatter: float
    p_value: float | None


def pool_estimates(values: FloatArray, covariance: FloatArray, usual_scatter: float) -> PooledMean:
    """Return the weighted mean of values of shape `(n,)` with a covariance of their errors, `(n, n)`.

    The scatter between runs is the usual one, or the observed one where that is larger: the one that brings
    the weighted squares down to their expectation (Paule and Mandel, J. Res. NBS 87, 1982).
    """
    from scipy.optimize import brentq
    from scipy.special import chdtrc

    degrees = len(values) - 1
    if degrees == 0:
        error = float(np.sqrt(covariance[0, 0] + usual_scatter**2))
        return PooledMean(Estimate(float(values[0]), error), usual_scatter, None)

    def surplus(scatter: float) -> float:
        return _weighted_mean(values, covariance, scatter)[2] - degrees

    scatter, squares = usual_scatter, surplus(usual_scatter) + degrees
    if squares > degrees:
        scatter = float(brentq(surplus, usual_scatter, usual_scatter + MAX_SCATTER_FACTOR * float(np.ptp(values))))
    mean, error, _ = _weighted_mean(values, covariance, scatter)
    return PooledMean(Estimate(mean, error), scatter, float(chdtrc(degrees, squares)))


def linear_trend(values: FloatArray, covariance: FloatArray, along: FloatArray) -> tuple[float, float]:
    """Return slope and standard error of a straight line through values by generalised least squares."""
    design = np.column_stack((np.ones_like(along), along))
    weight = np.linalg.inv(covariance)
    spread = np.linalg.inv(design.T @ weight @ design)
    slope = float((spread @ design.T @ weight @ values)[1])
    return slope, float(np.sqrt(spread[1, 1]))


def _weighted_mean(values: FloatArray, covariance: FloatArray, scatter: float) -> tuple[float, float, float]:
    """Mean, its error, and the weighted squares about it."""
    weight = np.linalg.inv(covariance + scatter**2 * np.eye(len(values)))
    total = float(weight.sum())
    mean = float(weight.sum(axis=0) @ values) / total
    rest = values - mean
    return mean, total**-0.5, float(rest @ weight @ rest)


FRICTION_SCATTER = RUN_VARIATIONS[1].sd
GAIN_SD = SPECIMEN_PRIORS["force_gain"][0]
MUCUS_SD = SPECIMEN_PRIORS["mucus_scale"][0]
SAME_SPEED_FACTOR = 1.5
"""Runs whose speeds differ by less than this factor stand for one speed."""
SIGNIFICANCE = 0.05


@single_blas_thread()
def identify_coulomb(selection: RunSelection, model: FrictionModelSettings) -> CoulombResult:
    """Return μ of each Coulomb run and of all together.

    The error of a run's `mu` is that of its force; `mu_without_viscous` holds besides that viscous friction
    differs by 20 % between specimens. Together, runs differ by 1.5 % of μ, or by what is observed where that is
    more, and share a force calibration good to 0.5 %. The paper's `mu` counts viscous friction in, which grows
    with speed; it is pooled over the runs at the lowest speed only.
    """
    experiments = selection.of_kind("coulomb")
    if not experiments:
        nothing = missing("the campaign has no usable Coulomb run; record one in the vacuum fixture")
        return CoulombResult((), nothing, nothing)
    noise = estimate_noise(selection.experiments, FORCE_CHANNEL)
    runs = tuple(_measure_run(experiment, model, noise) for experiment in experiments)
    slow = _slowest_runs([run for run in runs if run.mu.value is not None])
    net = [run for run in runs if run.mu_without_viscous.value is not None]
    as_printed = _pool_runs(slow, [run.mu for run in slow], np.zeros(len(slow)))
    # The mucus is the same in all runs: its part of the error is common to them.
    shared = np.array([MUCUS_SD * run.viscous_mN / (run.weight_mN * model.force_gain) for run in net])
    without = _pool_runs(
        net,
        [_without_shared_error(run.mu_without_viscous, part) for run, part in zip(net, shared, strict=True)],
        shared,
    )
    why = "no Coulomb run supports a friction coefficient: " + "; ".join(
        f"{one.file}: {_missing_reason(one)}" for one in runs
    )
    return CoulombResult(
        runs,
        missing(why) if as_printed is None else _with_gain_error(as_printed.mean),
        missing(why) if without is None else _with_gain_error(without.mean),
        tuple(_remarks(slow, net, shared, without)) if without else (),
    )


def _measure_run(experiment: Experiment, model: FrictionModelSettings, noise: NoiseModel) -> CoulombRun:
    measured = measure_sliding(experiment, filtered=True)
    speed = measured.direction * measured.speed_mm_s
    force = subtract_estimates(measured.steady, rest_mean(experiment, measured.direction, noise))
    if experiment.fixture is not Fixture.VACUUM:
        force = missing(
            f"its fixture is {experiment.fixture.value}, not vacuum: more than the weight presses on the gut"
        )
    mass = experiment.run.info.header.capsule.get("mass_g")
    weight = (
        GRAVITY_M_S2 * float(mass) if isinstance(mass, int | float) and not isinstance(mass, bool) else float("nan")
    )
    viscous, unknown = _viscous_estimate(experiment, measured.speed_mm_s, model)
    mu = _over_weight(force, weight * model.force_gain)
    net = _over_weight(subtract_estimates(force, viscous), weight * model.force_gain)
    share = viscous.value / force.value if viscous.value is not None and force.value else None
    return CoulombRun(
        file=experiment.file,
        speed_mm_s=speed,
        weight_mN=weight,
        force=force,
        mu=mu,
        mu_without_viscous=missing(unknown) if unknown and mu.value is not None else net,
        viscous_mN=float("nan") if viscous.value is None else viscous.value,
        viscous_share=share,
    )


def _viscous_estimate(experiment: Experiment, speed_mm_s: float, model: FrictionModelSettings) -> tuple[Estimate, str]:
    """Viscous friction as the force channel shows it, and why it is missing where it is."""
    area = 0.0
    if model.viscous == "newtonian":
        try:
            area = HemisphereContact.of(experiment.capsule, experiment.wall_thickness_mm, model).area_mm2
        except (AnalysisError, SettingsError) as fault:
            return missing(str(fault)), f"the viscous friction is not known: {fault}"
    if not speed_mm_s > 0:
        return missing("the speed is not known"), ""
    force = model.force_gain * float(viscous_force(np.array([speed_mm_s]), model, area)[0])
    return Estimate(force, MUCUS_SD * force), ""


def _over_weight(force: Estimate, weight_mN: float) -> Estimate:
    if force.value is None or force.standard_error is None:
        return missing(force.reason)
    if not weight_mN > 0:
        return missing("the run does not say its capsule's mass; import it again with mass_g")
    return Estimate(force.value / weight_mN, force.standard_error / weight_mN)


def _slowest_runs(runs: Sequence[CoulombRun]) -> list[CoulombRun]:
    lowest = min((abs(run.speed_mm_s) for run in runs), default=0.0)
    return [run for run in runs if abs(run.speed_mm_s) < SAME_SPEED_FACTOR * lowest]


def _without_shared_error(net: Estimate, shared: float) -> Estimate:
    """Return the estimate without the part of its error that all runs share."""
    return Estimate(net.value, max((net.standard_error or 0.0) ** 2 - shared**2, 0.0) ** 0.5)


def _pool_runs(runs: Sequence[CoulombRun], found: Sequence[Estimate], shared: FloatArray) -> PooledMean | None:
    if not runs:
        return None
    values = np.array([one.value for one in found], dtype=float)
    own = np.array([one.standard_error for one in found], dtype=float)
    return pool_estimates(
        values, np.diag(own**2) + np.outer(shared, shared), FRICTION_SCATTER * abs(float(np.median(values)))
    )


def _with_gain_error(mu: Estimate) -> Estimate:
    assert mu.value is not None  # noqa: S101  # of a pooled mean it never is; this tells the type checker
    return Estimate(mu.value, hypot(mu.standard_error or 0.0, GAIN_SD * mu.value))


def _missing_reason(run: CoulombRun) -> str:
    return run.mu.reason or run.mu_without_viscous.reason


def _remarks(
    slow: Sequence[CoulombRun], net: Sequence[CoulombRun], shared: FloatArray, found: PooledMean
) -> Iterator[str]:
    share = slow[0].viscous_share
    if share is not None:
        yield (
            f"as the paper counts it, μ holds the viscous friction: {share:.1%} of the force at "
            f"{abs(slow[0].speed_mm_s):.3g} mm/s by the model"
        )
    mean = found.mean.value or float("nan")
    if found.p_value is not None and found.p_value < SIGNIFICANCE:
        yield (
            f"μ differs between runs by {found.scatter / abs(mean):.1%}, more than the usual {FRICTION_SCATTER:.1%} "
            f"(p = {found.p_value:.2g}); its error holds that"
        )
    yield from _speed_dependence(net, shared, mean)


def _speed_dependence(net: Sequence[CoulombRun], shared: FloatArray, mean: float) -> Iterator[str]:
    """Say so when μ, viscous friction taken off, still goes up or down with speed."""
    from scipy.special import ndtr

    speeds = np.array([abs(run.speed_mm_s) for run in net])
    if len(net) < 2 or speeds.max() < SAME_SPEED_FACTOR * speeds.min():
        return
    values = np.array([run.mu_without_viscous.value for run in net], dtype=float)
    errors = np.array([run.mu_without_viscous.standard_error for run in net], dtype=float)
    own = np.maximum(errors**2 - shared**2, 0.0) + (FRICTION_SCATTER * mean) ** 2
    slope, error = linear_trend(values, np.diag(own) + np.outer(shared, shared), np.log(speeds))
    chance = 2 * float(ndtr(-abs(slope) / error))
    if chance < SIGNIFICANCE:
        yield (
            f"μ {'falls' if slope < 0 else 'rises'} with speed, viscous friction taken off, by "
            f"{abs(slope) * log(10) / abs(mean):.1%} per decade between {speeds.min():.3g} and {speeds.max():.3g} mm/s "
            f"(p = {chance:.2g}): one coefficient does not describe these runs"
        )
