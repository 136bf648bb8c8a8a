"""Steady sliding: friction coefficient from runs in the vacuum fixture, and drag of a specimen against speed.

Of each run the steady force, the rest before it and the speed are measured; forces that oppose the motion are positive
in either direction. In the vacuum fixture the capsule's weight alone presses on the gut. The paper divides the mean
force by the weight and so counts viscous friction in: 40.07 mN at 0.5 mm/s give 0.0816, of which the model ascribes
0.73 mN to the mucus; without it 0.0801 is left.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from math import hypot, log

import numpy as np

from dragrig.analysis import (
    ANGLE_PARAMETER,
    ANGLE_SD_DEG,
    FORCE_CHANNEL,
    FRICTION_SCATTER,
    MIN_SAMPLES_FOR_MEAN,
    SPECIMEN_PRIORS,
    STIFFNESS_SCATTER,
    Estimate,
    Exclusion,
    Experiment,
    Mask,
    NoiseModel,
    RunSelection,
    at_rest,
    attribute_number,
    clipped_samples,
    default_filter_settings,
    empty_stretch_reason,
    estimate_noise,
    missing,
    single_blas_thread,
    smooth_channel,
    steady_stretch,
    stretch_mean,
)
from dragrig.analysis.identification.identification import CoulombResult, CoulombRun, DragResult, LogLaw, SpeedPoint
from dragrig.analysis.identification.speed_dependence import ForceDeviation, find_boundary, fit_log_law, r2_by_band
from dragrig.config import AnalysisError, Capsule, Fixture, FrictionModelSettings, SettingsError
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import (
    GRAVITY_M_S2,
    HemisphereContact,
    SteadyFriction,
    gauss_legendre,
    steady_forces,
    viscous_force,
)


@dataclass(frozen=True, slots=True)
class SteadySliding:
    """Steady sliding of a run."""

    direction: int
    """1 forward, −1 backward, 0 unknown."""
    speed_mm_s: float
    """Measured over the steady stretch, positive; NaN where there is none."""
    steady: Estimate
    """Mean force [mN] over it, the sensor's zero included."""


def measure_sliding(experiment: Experiment, *, filtered: bool = False) -> SteadySliding:
    """Measure the steady sliding of a run; values without support in its data are missing, with the reason.

    Parameters
    ----------
    filtered
        Whether the steady mean is that of the Savitzky–Golay filtered force, as in the paper. Its error is
        always that of the raw force: the filter removes white noise, which hardly matters to a mean.
    """
    run = experiment.run
    stretch, chosen_by = steady_stretch(run)
    direction, speed = _steady_speed(experiment, stretch)
    if not stretch.any():
        return SteadySliding(0, speed, missing(empty_stretch_reason(chosen_by)))
    if not direction:
        return SteadySliding(0, speed, missing("the capsule does not move in its steady phase"))
    finite = stretch & np.isfinite(run.trace.force)
    steady = stretch_mean(run, finite, clipped_samples(run), "the steady phase")
    if filtered and not steady.reason:
        steady = _filtered_mean(experiment, stretch, steady)
    return SteadySliding(direction, speed, steady.scaled(direction))


def rest_mean(experiment: Experiment, direction: int, noise: NoiseModel) -> Estimate:
    """Mean force [mN] before the motion, counted along a direction.

    A rest of a second holds too few correlation times for an error of its own; that comes from the noise of all rests.
    """
    trace = experiment.run.trace
    rest = at_rest(trace)
    if not rest.any():
        return missing("the run has no rest phase, so that the sensor's zero is not known")
    if clipped := int(np.count_nonzero(rest & clipped_samples(experiment.run))):
        return missing(f"{clipped} samples in the rest are clipped at the end of the sensor's range")
    values = trace.force[rest & experiment.valid]
    if len(values) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"the rest holds only {len(values)} samples")
    duration_s = np.array([len(values) / trace.sample_rate_hz])
    variance = noise.covariance(np.zeros(1), duration_s, np.array([float(len(values))]))[0, 0]
    mean = Estimate(float(np.mean(values, dtype=np.float64)), float(variance) ** 0.5)
    return mean.scaled(direction or 1)


def subtract_estimates(left: Estimate, right: Estimate) -> Estimate:
    """Difference of independent estimates; missing where either is, with its reason."""
    if left.value is None or left.standard_error is None:
        return missing(left.reason)
    if right.value is None or right.standard_error is None:
        return missing(right.reason)
    return Estimate(left.value - right.value, hypot(left.standard_error, right.standard_error))


def _steady_speed(experiment: Experiment, stretch: Mask) -> tuple[int, float]:
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    known = np.flatnonzero(stretch & np.isfinite(position))
    if known.size < 2:
        return 0, float("nan")
    ends = known[[0, -1]]
    speed = float(np.diff(position[ends])[0] / np.diff(experiment.time_s[ends])[0])
    return int(np.sign(speed)), abs(speed)


def _filtered_mean(experiment: Experiment, stretch: Mask, raw: Estimate) -> Estimate:
    """Mean of the filtered trace, without half a window before the stop, which the filter blurs."""
    trace = experiment.run.trace
    settings = default_filter_settings(trace.sample_rate_hz)
    try:
        filtered = smooth_channel(trace, trace.force, settings).values
    except AnalysisError as error:
        return missing(str(error))
    inside = np.flatnonzero(stretch)
    values = filtered[inside[: len(inside) - settings.samples(trace.sample_rate_hz) // 2]]
    values = values[np.isfinite(values)]
    if not values.size:
        return missing("the steady phase is shorter than the filter's window")
    return Estimate(float(values.mean()), raw.standard_error, raw.effective_samples)


GAIN_SD = SPECIMEN_PRIORS["force_gain"][0]
MUCUS_SD = SPECIMEN_PRIORS["mucus_scale"][0]
SIMILAR_SPEED_FACTOR = 1.5
"""Speeds within this factor count as one speed."""
SIGNIFICANCE = 0.05
MAX_SCATTER_FACTOR = 1e3
"""Largest scatter that is searched, over the range of the values."""


@dataclass(frozen=True, slots=True)
class PooledMean:
    """A weighted mean."""

    mean: Estimate
    """Its error includes the scatter between runs."""
    scatter: float
    """Standard deviation between runs that was assumed, in the unit of the values."""
    p_value: float | None
    """Probability that runs differ as much by errors and the usual scatter; None for one run."""


CURVE_SPEEDS, CURVE_MARGIN = 100, 1.25
"""Speeds of a model's curve, and how far it goes beyond those of the runs, as a factor."""


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
    runs = tuple(_measure_coulomb_run(experiment, model, noise) for experiment in experiments)
    with_mu = [run for run in runs if run.mu.value is not None]
    lowest = min((abs(run.speed_mm_s) for run in with_mu), default=0.0)
    slow = [run for run in with_mu if abs(run.speed_mm_s) < SIMILAR_SPEED_FACTOR * lowest]
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


def _measure_coulomb_run(experiment: Experiment, model: FrictionModelSettings, noise: NoiseModel) -> CoulombRun:
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
            f"μ by the paper's definition includes the viscous friction: {100 * share:.1f} % of the force at "
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
    if len(net) < 2 or speeds.max() < SIMILAR_SPEED_FACTOR * speeds.min():
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


REPEAT_SPEED_FACTOR = 1.03
"""Successive speeds within this factor are repeats."""
NOTABLE_SCATTER = 1.5
"""Scatter of repeats over its expectation from which a remark says so."""
QUADRATURE_NODES = 24
DERIVATIVE_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class DragSetup:
    """Capsule and wall of a drag run."""

    capsule: Capsule
    wall_thickness_mm: float

    @classmethod
    def of(cls, experiment: Experiment) -> "DragSetup":
        """Take them from a run; raises `AnalysisError` where it does not state enough of its capsule."""
        return cls(experiment.capsule.model_copy(update={"name": "capsule"}), experiment.wall_thickness_mm)


@dataclass(frozen=True, slots=True)
class DragRun:
    """Steady drag of one run along its motion, the sensor's zero subtracted."""

    file: str
    setup: DragSetup
    direction: int
    speed_mm_s: float
    force: Estimate
    """With the error of this run's own force."""
    scatter_mN: float
    """Standard deviation between runs of these settings."""
    rest_age_s: float | None
    """Age of the contact at rest, where the zero was taken from the rest; None where it was given."""

    @property
    def variance(self) -> float:
        """Squared error with which the run represents others of its settings [mN²]."""
        return (self.force.standard_error or 0.0) ** 2 + self.scatter_mN**2


@dataclass(frozen=True, slots=True)
class SpeedGroup:
    """A speed with its runs."""

    runs: tuple[DragRun, ...]
    point: SpeedPoint


@single_blas_thread()
def identify_drag(
    selection: RunSelection,
    model: FrictionModelSettings,
    zeros: Mapping[str, Estimate] | None = None,
    before: FrictionModelSettings | None = None,
) -> DragResult:
    """Compare the steady drag of a specimen with the model.

    Forces are those in the channel, counted along the motion; backward speeds are negative. Law, boundary
    and R² are those of the direction with more speeds; R² of the opposite direction follows.

    Parameters
    ----------
    zeros
        The sensor's zero by the name of the run's file. A run without one has it taken from its rest, less the
        force of the model's relaxed wall on the capsule there.
    before
        The model that it was fitted from, for its curve; None where it is the same.
    """
    experiments = selection.of_kind("drag")
    if not experiments:
        return DragResult((), None, None, remarks=("the campaign has no usable drag run",))
    known = {file: zero for file, zero in (zeros or {}).items() if zero.standard_error is not None}
    noise = cache(lambda: estimate_noise(selection.experiments, FORCE_CHANNEL))
    measured, left_out = _measure_runs(experiments, model, known, noise)
    usual_setup = Counter(run.setup for run in measured).most_common(1)[0][0] if measured else None
    left_out += [
        Exclusion(run.file, "its capsule or wall differs from that of most runs")
        for run in measured
        if run.setup != usual_setup
    ]
    runs = [run for run in measured if run.setup == usual_setup]
    remarks = [f"{exclusion.item} is left out of the drag: {exclusion.reason}" for exclusion in left_out]
    if not runs:
        return DragResult((), None, None, remarks=tuple(remarks))
    groups, scatter_factor = _group_by_speed(runs, model)
    by_sign = [[group for group in groups if sign * group.point.speed_mm_s > 0] for sign in (1, -1)]
    directions = sorted(filter(None, by_sign), key=len, reverse=True)
    points = [group.point for group in directions[0]]
    law = fit_log_law(points)
    boundary = find_boundary(_model_deviation(directions[0], model))
    bands = r2_by_band(points, boundary)
    for direction in directions[1:]:
        bands += r2_by_band([group.point for group in direction], None, f"{_direction_name(direction)}, ")
    remarks += _run_remarks(runs, scatter_factor)
    if len(directions) > 1:
        remarks.append(f"law and boundary are those of the {len(points)} {_direction_name(directions[0])} speeds")
    remarks += _law_remarks(points, law)
    along = [abs(group.point.speed_mm_s) for group in groups]
    speed = np.geomspace(min(along) / CURVE_MARGIN, max(along) * CURVE_MARGIN, CURVE_SPEEDS)
    return DragResult(
        points=tuple(group.point for group in groups),
        log_law=law,
        boundary=boundary,
        determination=bands,
        remarks=tuple(remarks),
        model=steady_force_parts(runs[0].setup, model, speed),
        before_mN=None if before is None else steady_force_parts(runs[0].setup, before, speed).total,
    )


def _direction_name(groups: Sequence[SpeedGroup]) -> str:
    return "backward" if groups[0].point.speed_mm_s < 0 else "forward"


# Runs.


def _measure_runs(
    experiments: Iterable[Experiment],
    model: FrictionModelSettings,
    zeros: Mapping[str, Estimate],
    noise: Callable[[], NoiseModel],
) -> tuple[list[DragRun], list[Exclusion]]:
    """Measure runs; the noise is estimated only for runs whose zero is not given."""
    runs, left_out = list[DragRun](), list[Exclusion]()
    for experiment in experiments:
        try:
            runs.append(_measure_drag_run(experiment, model, zeros.get(experiment.file), noise))
        except (AnalysisError, SettingsError) as error:
            left_out.append(Exclusion(experiment.file, str(error).removeprefix(f"{experiment.file}: ")))
    return runs, left_out


def _measure_drag_run(
    experiment: Experiment, model: FrictionModelSettings, zero: Estimate | None, noise: Callable[[], NoiseModel]
) -> DragRun:
    if experiment.fixture is not Fixture.FOAM:
        raise AnalysisError(
            f"its fixture is {experiment.fixture.value}, not foam: the gut does not close on the capsule"
        )
    setup = DragSetup.of(experiment)
    sliding = measure_sliding(experiment)
    still = experiment.time_s[at_rest(experiment.run.trace)]
    age_s = experiment.insertion_dwell_s + (0.5 * float(still[0] + still[-1]) if still.size else 0.0)
    resting_mN = resting_force(setup, model, age_s)
    if zero is None:
        force = subtract_estimates(sliding.steady, rest_mean(experiment, sliding.direction, noise()))
        if force.value is not None:
            force = Estimate(force.value + resting_mN, force.standard_error)
        subtracted_mN, correlated_mN = resting_mN, 0.0
    else:
        # A zero from a fit comes from the rest, and is as uncertain as the run's own wall's pressure there. That part
        # of its error varies with the steady force's scatter.
        zero_error = zero.standard_error or 0.0
        correlated_mN = min(zero_error, STIFFNESS_SCATTER * abs(resting_mN))
        own = Estimate(zero.value, (zero_error**2 - correlated_mN**2) ** 0.5)
        force = subtract_estimates(sliding.steady, own.scaled(sliding.direction))
        subtracted_mN = 0.0
    if force.value is None:
        raise AnalysisError(force.reason)
    parts = steady_force_parts(setup, model, np.array([sliding.speed_mm_s]))
    wall_mN = float(parts.f_e[0] + model.friction_coefficient * parts.side_pressure_force[0])
    # A run whose wall is stiffer presses harder at rest too, which is subtracted with the rest.
    stiff_mN = STIFFNESS_SCATTER * (wall_mN - subtracted_mN) - correlated_mN
    scatter_mN = hypot(stiff_mN, FRICTION_SCATTER * float(parts.f_c[0]))
    rest_age_s = age_s if zero is None else None
    return DragRun(experiment.file, setup, sliding.direction, sliding.speed_mm_s, force, scatter_mN, rest_age_s)


def _group_by_speed(runs: Sequence[DragRun], model: FrictionModelSettings) -> tuple[list[SpeedGroup], float]:
    """Average the runs at each speed and direction, forward before backward and slow before fast.

    Returns
    -------
    The speeds, and the factor by which repeats scatter more than their errors say; 1 where they do not.
    """
    groups: list[list[DragRun]] = []
    rising = sorted(runs, key=lambda run: (-run.direction, run.speed_mm_s))
    for _, one_way in groupby(rising, key=lambda run: run.direction):
        previous = 0.0
        for run in one_way:
            if previous and log(run.speed_mm_s / previous) < log(REPEAT_SPEED_FACTOR):
                groups[-1].append(run)
            else:
                groups.append([run])
            previous = run.speed_mm_s
    chi2 = 0.0
    for group in groups:
        mean, weights = _weighted_mean(group)
        chi2 += float(weights @ (np.array([run.force.value for run in group], dtype=float) - mean) ** 2)
    degrees = len(runs) - len(groups)
    factor = max(1.0, (chi2 / degrees) ** 0.5) if degrees else 1.0
    return [SpeedGroup(tuple(group), _speed_point(group, model, factor)) for group in groups], factor


def _weighted_mean(group: Sequence[DragRun]) -> tuple[float, FloatArray]:
    weights = np.array([1 / run.variance for run in group])
    values = np.array([run.force.value for run in group], dtype=float)
    return float(weights @ values / weights.sum()), weights


def _speed_point(group: Sequence[DragRun], model: FrictionModelSettings, factor: float) -> SpeedPoint:
    mean, weights = _weighted_mean(group)
    speed = float(np.mean([run.speed_mm_s for run in group]))
    parts = steady_force_parts(group[0].setup, model, np.array([speed]))
    return SpeedPoint(
        speed_mm_s=group[0].direction * speed,
        runs=len(group),
        force=Estimate(mean, factor * float(weights.sum()) ** -0.5),
        f_e_mN=float(parts.f_e[0]),
        f_v_mN=float(parts.f_v[0]),
        f_c_mN=float(parts.f_c[0]),
    )


# The friction model beside them.


def steady_force_parts(setup: DragSetup, model: FrictionModelSettings, speed_mm_s: FloatArray) -> SteadyFriction:
    """Return the model's parts at steady speeds as the channel shows them; raises `SettingsError`."""
    steady = steady_forces(speed_mm_s, model, setup.capsule, setup.wall_thickness_mm)
    forces = ("f_e", "f_v", "f_c", "total", "side_pressure_force", "max_skew")
    return replace(steady, **{name: model.force_gain * getattr(steady, name) for name in forces})


def resting_force(setup: DragSetup, model: FrictionModelSettings, age_s: float) -> float:
    """Return the axial force [mN] of wall that has all been in contact for one time, as before a drag test."""
    contact = HemisphereContact.of(setup.capsule, setup.wall_thickness_mm, model)
    nodes, weights = gauss_legendre(QUADRATURE_NODES)
    ages = np.full(QUADRATURE_NODES, age_s * model.insertion_dwell_scale)
    load = contact.axial_load(contact.length_mm * nodes, ages)
    return model.force_gain * contact.length_mm * float(load @ weights)


def _model_deviation(groups: Sequence[SpeedGroup], model: FrictionModelSettings) -> ForceDeviation:
    """Measured minus model, and the deviations that the priors of another specimen allow."""
    setup = groups[0].runs[0].setup
    points = [group.point for group in groups]
    speeds = np.array([abs(point.speed_mm_s) for point in points])
    ages = [[run.rest_age_s for run in group.runs if run.rest_age_s is not None] for group in groups]
    rest_shares = np.array([len(known) / len(group.runs) for known, group in zip(ages, groups, strict=True)])
    known_ages = [age for group_ages in ages for age in group_ages]

    def expected(varied: FrictionModelSettings) -> FloatArray:
        # The resting force was subtracted from the measurement with the rest, so here too.
        resting = resting_force(setup, varied, float(np.mean(known_ages))) if known_ages else 0.0
        return steady_force_parts(setup, varied, speeds).total - rest_shares * resting

    by_model = np.array([point.model_mN for point in points])
    return ForceDeviation.of(points, by_model, _prior_deviations(model, expected))


def _prior_deviations(
    model: FrictionModelSettings, expected: Callable[[FrictionModelSettings], FloatArray]
) -> FloatArray:
    """Change of a prediction by one prior standard deviation of each of a specimen's parameters, shape `(K, n)`."""
    nominal = expected(model)
    rows = []
    for name, (sd, _) in SPECIMEN_PRIORS.items():
        value = float(getattr(model, name))
        if value:
            scaled = model.model_copy(update={name: value * (1 + DERIVATIVE_STEP)})
            rows.append((expected(scaled) - nominal) * (sd / DERIVATIVE_STEP))
    turned = model.model_copy(update={ANGLE_PARAMETER: getattr(model, ANGLE_PARAMETER) + DERIVATIVE_STEP})
    rows.append((expected(turned) - nominal) * (ANGLE_SD_DEG / DERIVATIVE_STEP))
    return np.array(rows)


# Remarks.


def _run_remarks(runs: Sequence[DragRun], scatter_factor: float) -> Iterator[str]:
    from_rest = sum(run.rest_age_s is not None for run in runs)
    if from_rest:
        yield (
            f"in {from_rest} of {len(runs)} runs the zero is the mean at rest less the model's resting force: a wall "
            "stiffer than the model's shifts all these forces"
        )
    if scatter_factor > NOTABLE_SCATTER:
        yield (
            f"repeats scatter {scatter_factor:.2g} times as much as noise and 2 % of stiffness explain; the errors "
            "include that"
        )


def _law_remarks(points: Sequence[SpeedPoint], law: LogLaw | None) -> Iterator[str]:
    if law is None:
        yield f"a law in ln v needs at least three speeds; these are {len(points)}"
    elif law.deviates:
        line = law.force_mN(np.array([abs(point.speed_mm_s) for point in points]))
        bend = find_boundary(ForceDeviation.of(points, line), "measurement and law")
        where = "" if bend.speed_mm_s is None else f"; they bend away at {bend.speed_mm_s:.3g} mm/s"
        if bend.interval is not None:
            where += f" (95 %: {bend.interval[0]:.3g} to {bend.interval[1]:.3g})"
        p_value = law.lack_of_fit_p or 0.0
        p_text = "p < 0.0001" if p_value < 1e-4 else f"p = {p_value:.2g}"
        yield f"the forces do not lie on a straight line in ln v ({p_text}){where}"
