"""Steady drag of a specimen against speed, run by run and averaged, beside the friction model."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from math import hypot, log

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.estimates import Estimate, Exclusion
from dragrig.analysis.identification.identification import DragResult, LogLaw, SpeedPoint
from dragrig.analysis.identification.speed_dependence import (
    ForceDeviation,
    SteadyForces,
    find_boundary,
    fit_log_law,
    r2_by_band,
)
from dragrig.analysis.identification.steady_sliding import along_motion, measure_sliding, rest_mean, subtract_estimates
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.capsule_model import (
    ANGLE_PARAMETER,
    ANGLE_SD_DEG,
    FORCE_CHANNEL,
    FRICTION_SCATTER,
    SPECIMEN_PRIORS,
    STIFFNESS_SCATTER,
)
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.segments import at_rest
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import gauss_legendre
from dragrig.sim_backend.friction.friction_force import steady_forces
from dragrig.sim_backend.friction.wall import HemisphereContact

SAME_SPEED_FACTOR = 1.03
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


@dataclass(frozen=True, slots=True, eq=False)
class SteadyForceParts:
    """Parts of the steady force [mN], shape `(n,)`; `wall` is the part of f_e and f_c that scales with stiffness."""

    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    wall: FloatArray

    @property
    def total(self) -> FloatArray:
        """Their sum."""
        return self.f_e + self.f_v + self.f_c


@dataclass(frozen=True, slots=True)
class DragRun:
    """Steady drag of one run along its motion, the sensor's zero subtracted.

    Attributes
    ----------
    force
        With the error of this run's own force.
    scatter_mN
        Standard deviation between runs of these settings.
    rest_age_s
        Age of the contact at rest, where the zero was taken from the rest; None where it was given.
    """

    file: str
    setup: DragSetup
    direction: int
    speed_mm_s: float
    force: Estimate
    scatter_mN: float
    rest_age_s: float | None

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
    selection: RunSelection, model: FrictionModelSettings, zeros: Mapping[str, Estimate] | None = None
) -> DragResult:
    """Compare the steady drag of a specimen with the model.

    Forces are those in the channel, counted along the motion; backward speeds are negative. Law, boundary
    and R² are those of the direction with more speeds; R² of the opposite direction follows.

    Parameters
    ----------
    zeros
        The sensor's zero by the name of the run's file. A run without one has it taken from its rest, less the
        force of the model's relaxed wall on the capsule there.
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
    return DragResult(tuple(group.point for group in groups), law, boundary, bands, tuple(remarks))


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
            runs.append(_measure_run(experiment, model, zeros.get(experiment.file), noise))
        except (AnalysisError, SettingsError) as error:
            left_out.append(Exclusion(experiment.file, str(error).removeprefix(f"{experiment.file}: ")))
    return runs, left_out


def _measure_run(
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
        force = subtract_estimates(sliding.steady, along_motion(own, sliding.direction))
        subtracted_mN = 0.0
    if force.value is None:
        raise AnalysisError(force.reason)
    parts = steady_force_parts(setup, model, np.array([sliding.speed_mm_s]))
    # A run whose wall is stiffer presses harder at rest too, which is subtracted with the rest.
    stiff_mN = STIFFNESS_SCATTER * (float(parts.wall[0]) - subtracted_mN) - correlated_mN
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
            if previous and log(run.speed_mm_s / previous) < log(SAME_SPEED_FACTOR):
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


def steady_force_parts(setup: DragSetup, model: FrictionModelSettings, speed_mm_s: FloatArray) -> SteadyForceParts:
    """Return the model's parts at steady speeds as the channel shows them; raises `SettingsError`."""
    steady, gain = steady_forces(speed_mm_s, model, setup.capsule, setup.wall_thickness_mm), model.force_gain
    wall = steady.f_e + model.friction_coefficient * steady.side_pressure_force
    return SteadyForceParts(gain * steady.f_e, gain * steady.f_v, gain * steady.f_c, gain * wall)


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
    steady = SteadyForces.of([group.point for group in groups])
    ages = [[run.rest_age_s for run in group.runs if run.rest_age_s is not None] for group in groups]
    rest_shares = np.array([len(known) / len(group.runs) for known, group in zip(ages, groups, strict=True)])
    known_ages = [age for group_ages in ages for age in group_ages]

    def expected(varied: FrictionModelSettings) -> FloatArray:
        # The resting force was subtracted from the measurement with the rest, so here too.
        resting = resting_force(setup, varied, float(np.mean(known_ages))) if known_ages else 0.0
        return steady_force_parts(setup, varied, steady.speed_mm_s).total - rest_shares * resting

    by_model = np.array([group.point.model_mN for group in groups])
    freedom = _prior_deviations(model, expected)
    return ForceDeviation(steady.speed_mm_s, steady.force_mN - by_model, steady.error_mN, freedom)


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
        steady = SteadyForces.of(points)
        line = law.intercept.value + law.slope.value * np.log(steady.speed_mm_s)
        no_freedom = np.empty((0, len(points)))
        bend = find_boundary(
            ForceDeviation(steady.speed_mm_s, steady.force_mN - line, steady.error_mN, no_freedom),
            "measurement and law",
        )
        where = "" if bend.speed_mm_s is None else f"; they bend away at {bend.speed_mm_s:.3g} mm/s"
        if bend.interval is not None:
            where += f" (95 %: {bend.interval[0]:.3g} to {bend.interval[1]:.3g})"
        yield f"the forces do not lie on a straight line in ln v (p = {law.lack_of_fit_p:.2g}){where}"
