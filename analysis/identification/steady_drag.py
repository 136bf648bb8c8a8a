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
from dragrig.analysis.identification.identification import DragResult, LogLaw, SpeedBoundary, SpeedPoint
from dragrig.analysis.identification.speed_dependence import ForceDeviation, find_boundary, fit_log_law, r2_by_band
from dragrig.analysis.identification.steady_sliding import along_motion, measure_sliding, rest_mean, subtract_estimates
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.capsule_model import (
    ANGLE_PARAMETER,
    ANGLE_SD_DEG,
    FORCE_CHANNEL,
    RUN_VARIATIONS,
    SPECIMEN_PRIORS,
)
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.segments import at_rest
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule, Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.environmental_resistance import gauss_legendre
from dragrig.sim_backend.friction.sliding import steady_forces
from dragrig.sim_backend.friction.wall import HemisphereContact

QUADRATURE_NODES = 24
DERIVATIVE_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class DragSetup:
    """Capsule and wall of a drag run."""

    capsule: Capsule
    wall_thickness_mm: float

    @classmethod
    def of(cls, experiment: Experiment) -> "DragSetup":
        """Take them from a run; raises `AnalysisError` where it does not say enough of its capsule."""
        capsule = experiment.capsule.model_copy(update={"name": "capsule"})
        return cls(capsule, experiment.wall_thickness_mm)


@dataclass(frozen=True, slots=True, eq=False)
class SteadyForceParts:
    """Parts of the steady force [mN], shape `(n,)`; `wall` is what the wall's stiffness multiplies, in f_e and f_c."""

    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    wall: FloatArray

    @property
    def total(self) -> FloatArray:
        """Their sum."""
        return self.f_e + self.f_v + self.f_c


def steady_force_parts(setup: DragSetup, model: FrictionModelSettings, speed_mm_s: FloatArray) -> SteadyForceParts:
    """Return the model's parts at steady speeds; raises `SettingsError` as `steady_forces`."""
    steady, gain = steady_forces(speed_mm_s, model, setup.capsule, setup.wall_thickness_mm), model.force_gain
    pressed = steady.f_e + model.friction_coefficient * steady.side_pressure_force
    return SteadyForceParts(gain * steady.f_e, gain * steady.f_v, gain * steady.f_c, gain * pressed)


def resting_force(setup: DragSetup, model: FrictionModelSettings, age_s: float) -> float:
    """Return the axial force [mN] of wall that has all been in contact for one time, as before a drag test."""
    contact = HemisphereContact.of(setup.capsule, setup.wall_thickness_mm, model)
    nodes, weights = gauss_legendre(QUADRATURE_NODES)
    load = contact.axial_load(contact.length_mm * nodes, np.full(QUADRATURE_NODES, age_s * model.insertion_dwell_scale))
    return model.force_gain * contact.length_mm * float(load @ weights)


def prior_deviations(
    model: FrictionModelSettings, expected: Callable[[FrictionModelSettings], FloatArray]
) -> FloatArray:
    """Return how far one standard deviation of each of a specimen's parameters moves a prediction, shape `(K, n)`."""
    nominal = expected(model)
    rows = []
    for name, (sd, _) in SPECIMEN_PRIORS.items():
        value = float(getattr(model, name))
        if value:
            moved = model.model_copy(update={name: value * (1 + DERIVATIVE_STEP)})
            rows.append((expected(moved) - nominal) * (sd / DERIVATIVE_STEP))
    turned = model.model_copy(update={ANGLE_PARAMETER: getattr(model, ANGLE_PARAMETER) + DERIVATIVE_STEP})
    rows.append((expected(turned) - nominal) * (ANGLE_SD_DEG / DERIVATIVE_STEP))
    return np.array(rows)


STIFFNESS_SCATTER, FRICTION_SCATTER = (one.sd for one in RUN_VARIATIONS)
SAME_SPEED_FACTOR = 1.03
"""Runs whose speeds follow one another by less than this factor are repeats."""


@dataclass(frozen=True, slots=True)
class DragRun:
    """Steady drag of one run, along its motion, the sensor's zero taken off.

    Attributes
    ----------
    force
        With the error of this run's own force.
    scatter_mN
        Standard deviation by which runs like it differ.
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
        """Squared error with which the run stands for others like it [mN²]."""
        return (self.force.standard_error or 0.0) ** 2 + self.scatter_mN**2


@dataclass(frozen=True, slots=True)
class SpeedGroup:
    """A speed with its runs."""

    runs: tuple[DragRun, ...]
    point: SpeedPoint


def measure_drag_runs(
    experiments: Iterable[Experiment],
    model: FrictionModelSettings,
    zeros: Mapping[str, Estimate],
    noise: Callable[[], NoiseModel],
) -> tuple[list[DragRun], list[Exclusion]]:
    """Measure runs, and say why others cannot be; the noise is asked for by those whose zero is not given."""
    found, left_out = list[DragRun](), list[Exclusion]()
    for experiment in experiments:
        try:
            found.append(_measure_drag_run(experiment, model, zeros.get(experiment.file), noise))
        except (AnalysisError, SettingsError) as fault:
            left_out.append(Exclusion(experiment.file, str(fault).removeprefix(f"{experiment.file}: ")))
    return found, left_out


def group_by_speed(runs: Sequence[DragRun], model: FrictionModelSettings) -> tuple[list[SpeedGroup], float]:
    """Average the runs at each speed and direction, forward before backward and slow before fast.

    Returns
    -------
    The speeds, and by what factor repeats scatter more than their errors say; 1 where they do not.
    """
    groups = _speed_groups(runs)
    squares, degrees = 0.0, 0
    for group in groups:
        mean, weights = _weighted_mean(group)
        values = np.array([run.force.value for run in group], dtype=float)
        squares += float(weights @ (values - mean) ** 2)
        degrees += len(group) - 1
    factor = max(1.0, (squares / degrees) ** 0.5) if degrees else 1.0
    return [SpeedGroup(tuple(group), _speed_point(group, model, factor)) for group in groups], factor


def _measure_drag_run(
    experiment: Experiment, model: FrictionModelSettings, zero: Estimate | None, noise: Callable[[], NoiseModel]
) -> DragRun:
    if experiment.fixture is not Fixture.FOAM:
        raise AnalysisError(
            f"its fixture is {experiment.fixture.value}, not foam: the gut does not close on the capsule"
        )
    setup = DragSetup.of(experiment)
    seen = measure_sliding(experiment)
    age, held, along_mN = None, 0.0, 0.0
    if zero is None:
        age = _rest_age(experiment)
        held = resting_force(setup, model, age)
        force = _add_force(subtract_estimates(seen.steady, rest_mean(experiment, seen.direction, noise())), held)
    else:
        along_mN = _correlated_zero_error(zero, resting_force(setup, model, _rest_age(experiment)))
        own = Estimate(zero.value, ((zero.standard_error or 0.0) ** 2 - along_mN**2) ** 0.5)
        force = subtract_estimates(seen.steady, along_motion(own, seen.direction))
    if force.value is None:
        raise AnalysisError(force.reason)
    by_model = steady_force_parts(setup, model, np.array([seen.speed_mm_s]))
    # A run whose wall is stiffer presses harder at rest too, which goes off with the rest.
    stiff = STIFFNESS_SCATTER * (float(by_model.wall[0]) - held) - along_mN
    scatter = hypot(stiff, FRICTION_SCATTER * float(by_model.f_c[0]))
    return DragRun(experiment.file, setup, seen.direction, seen.speed_mm_s, force, scatter, age)


def _correlated_zero_error(zero: Estimate, resting_mN: float) -> float:
    """Return which part of a zero's error goes along with the steady force's scatter, one standard deviation.

    Where a fit tells the zero, it does so from the rest, and is in doubt by how hard the run's own wall presses there.
    """
    return min(zero.standard_error or 0.0, STIFFNESS_SCATTER * abs(resting_mN))


def _add_force(force: Estimate, by_mN: float) -> Estimate:
    return force if force.value is None else Estimate(force.value + by_mN, force.standard_error)


def _rest_age(experiment: Experiment) -> float:
    """Return the noted age of the contact in the middle of the rest."""
    still = experiment.time_s[at_rest(experiment.run.trace)]
    return experiment.insertion_dwell_s + (0.5 * float(still[0] + still[-1]) if still.size else 0.0)


def _speed_groups(runs: Sequence[DragRun]) -> list[list[DragRun]]:
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
    return groups


def _weighted_mean(group: Sequence[DragRun]) -> "tuple[float, np.ndarray[tuple[int], np.dtype[np.float64]]]":
    weights = np.array([1 / run.variance for run in group])
    values = np.array([run.force.value for run in group], dtype=float)
    return float(weights @ values / weights.sum()), weights


def _speed_point(group: Sequence[DragRun], model: FrictionModelSettings, factor: float) -> SpeedPoint:
    mean, weights = _weighted_mean(group)
    speed = float(np.mean([run.speed_mm_s for run in group]))
    by_model = steady_force_parts(group[0].setup, model, np.array([speed]))
    error = factor * float(weights.sum()) ** -0.5
    return SpeedPoint(
        speed_mm_s=group[0].direction * speed,
        runs=len(group),
        force=Estimate(mean, error),
        f_e_mN=float(by_model.f_e[0]),
        f_v_mN=float(by_model.f_v[0]),
        f_c_mN=float(by_model.f_c[0]),
    )


SIGNIFICANCE = 0.05


@single_blas_thread()
def identify_drag(
    selection: RunSelection, model: FrictionModelSettings, zeros: Mapping[str, Estimate] | None = None
) -> DragResult:
    """Compare the steady drag of a specimen with the model.

    Forces are those that the channel shows, counted along the motion; backward speeds are negative. Law, boundary
    and R² are those of the direction with more speeds; R² of the other one follows.

    Parameters
    ----------
    zeros
        The sensor's zero by the name of the run's file. A run without one has it taken from its rest, less the
        force with which the model's relaxed wall presses on the capsule there.
    """
    experiments = selection.of_kind("drag")
    if not experiments:
        return DragResult((), None, None, remarks=("the campaign has no usable drag run",))
    known = {file: zero for file, zero in (zeros or {}).items() if zero.standard_error is not None}
    noise = cache(lambda: estimate_noise(selection.experiments, FORCE_CHANNEL))
    measured, left_out = measure_drag_runs(experiments, model, known, noise)
    runs, others = _split_by_setup(measured)
    remarks = [f"{one.what} is left out of the drag: {one.reason}" for one in left_out]
    remarks += [
        f"{one.file} is left out of the drag: its capsule or wall differs from that of most runs" for one in others
    ]
    if not runs:
        return DragResult((), None, None, remarks=tuple(remarks))
    speeds, factor = group_by_speed(runs, model)
    ways = _by_direction(speeds)
    main = [one.point for one in ways[0]]
    law = fit_log_law(main)
    boundary = find_boundary(_model_deviation(ways[0], model))
    compared = r2_by_band(main, boundary)
    for way in ways[1:]:
        name = "backward, " if way[0].point.speed_mm_s < 0 else "forward, "
        compared += r2_by_band([one.point for one in way], None, name)
    remarks += [*_run_remarks(runs, factor), *_direction_remarks(ways), *_law_remarks(main, law)]
    return DragResult(tuple(one.point for one in speeds), law, boundary, compared, tuple(remarks))


def _split_by_setup(runs: Sequence[DragRun]) -> tuple[list[DragRun], list[DragRun]]:
    """Divide runs into those with the capsule and wall that most have, and the others."""
    if not runs:
        return [], []
    usual, _ = Counter(run.setup for run in runs).most_common(1)[0]
    return [run for run in runs if run.setup == usual], [run for run in runs if run.setup != usual]


def _by_direction(speeds: Sequence[SpeedGroup]) -> list[list[SpeedGroup]]:
    """Return the speeds of each direction, the one with more of them first."""
    forward = [one for one in speeds if one.point.speed_mm_s > 0]
    backward = [one for one in speeds if one.point.speed_mm_s < 0]
    return sorted((way for way in (forward, backward) if way), key=len, reverse=True)


def _model_deviation(speeds: Sequence[SpeedGroup], model: FrictionModelSettings) -> ForceDeviation:
    """Measured minus model, and what another specimen would make of it."""
    setup = speeds[0].runs[0].setup
    at = np.array([abs(one.point.speed_mm_s) for one in speeds])
    ages = [[run.rest_age_s for run in one.runs if run.rest_age_s is not None] for one in speeds]
    shares = np.array([len(known) / len(one.runs) for known, one in zip(ages, speeds, strict=True)])
    known = [age for some in ages for age in some]
    age = float(np.mean(known)) if known else None

    def expected(varied: FrictionModelSettings) -> FloatArray:
        # What goes off with the rest goes off here as well.
        held = 0.0 if age is None else resting_force(setup, varied, age)
        return steady_force_parts(setup, varied, at).total - shares * held

    measured = np.array([one.point.force.value for one in speeds], dtype=float)
    errors = np.array([one.point.force.standard_error for one in speeds], dtype=float)
    by_model = np.array([one.point.model_mN for one in speeds])
    return ForceDeviation(at, measured - by_model, errors, prior_deviations(model, expected))


def _run_remarks(runs: Sequence[DragRun], factor: float) -> Iterator[str]:
    at_rest = sum(run.rest_age_s is not None for run in runs)
    if at_rest:
        yield (
            f"in {at_rest} of {len(runs)} runs the zero is the mean at rest less the model's resting force: a wall "
            "stiffer than the model's shifts these forces alike"
        )
    if factor > 1.5:
        yield f"repeats scatter {factor:.2g} times as much as noise and 2 % of stiffness explain; the errors hold that"


def _direction_remarks(ways: Sequence[Sequence[SpeedGroup]]) -> Iterator[str]:
    if len(ways) > 1:
        name = "forward" if ways[0][0].point.speed_mm_s > 0 else "backward"
        yield f"law and boundary are those of the {len(ways[0])} {name} speeds"


def _law_remarks(points: Sequence[SpeedPoint], law: LogLaw | None) -> Iterator[str]:
    if law is None:
        yield f"a law in ln v takes at least three speeds; these are {len(points)}"
    elif law.lack_of_fit_p is not None and law.lack_of_fit_p < SIGNIFICANCE:
        bend = _law_boundary(points, law)
        where = "" if bend is None or bend.speed_mm_s is None else f"; they bend away at {bend.speed_mm_s:.3g} mm/s"
        if bend is not None and bend.interval is not None:
            where += f" (95 %: {bend.interval[0]:.3g} to {bend.interval[1]:.3g})"
        yield f"the forces do not lie on a straight line in ln v (p = {law.lack_of_fit_p:.2g}){where}"


def _law_boundary(points: Sequence[SpeedPoint], law: LogLaw) -> SpeedBoundary | None:
    at = np.array([abs(point.speed_mm_s) for point in points])
    force = np.array([point.force.value for point in points], dtype=float)
    error = np.array([point.force.standard_error for point in points], dtype=float)
    line = law.intercept.value + law.slope.value * np.log(at)
    return find_boundary(ForceDeviation(at, force - line, error, np.empty((0, len(at)))), "measurement and law")
