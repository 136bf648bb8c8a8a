"""Steady drag run by run, and averaged over the runs at each speed."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import hypot, log

import numpy as np

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.noise import Noise
from dragrig.analysis.identification.nominal_drag import Setup, parts, resting_force
from dragrig.analysis.identification.results import LeftOut, SpeedPoint
from dragrig.analysis.identification.sliding import along, difference, rest_mean, sliding
from dragrig.analysis.nominal.capsule_parameters import VARIATIONS
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.phases import at_rest
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Fixture

STIFFNESS, FRICTION = (one.sd for one in VARIATIONS)
SAME_SPEED = 1.03
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
    setup: Setup
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
class AtSpeed:
    """A speed with its runs."""

    runs: tuple[DragRun, ...]
    point: SpeedPoint


def drag_runs(
    experiments: Iterable[Experiment],
    model: FrictionModelSettings,
    zeros: Mapping[str, Estimate],
    noise: Callable[[], Noise],
) -> tuple[list[DragRun], list[LeftOut]]:
    """Measure runs, and say why others cannot be; the noise is asked for by those whose zero is not given."""
    found, left_out = list[DragRun](), list[LeftOut]()
    for experiment in experiments:
        try:
            found.append(_measured(experiment, model, zeros.get(experiment.file), noise))
        except (AnalysisError, SettingsError) as fault:
            left_out.append(LeftOut(experiment.file, str(fault).removeprefix(f"{experiment.file}: ")))
    return found, left_out


def at_speeds(runs: Sequence[DragRun], model: FrictionModelSettings) -> tuple[list[AtSpeed], float]:
    """Average the runs at each speed and direction, forward before backward and slow before fast.

    Returns
    -------
    The speeds, and by what factor repeats scatter more than their errors say; 1 where they do not.
    """
    groups = _grouped(runs)
    squares, degrees = 0.0, 0
    for group in groups:
        mean, weights = _mean(group)
        values = np.array([run.force.value for run in group], dtype=float)
        squares += float(weights @ (values - mean) ** 2)
        degrees += len(group) - 1
    factor = max(1.0, (squares / degrees) ** 0.5) if degrees else 1.0
    return [AtSpeed(tuple(group), _point(group, model, factor)) for group in groups], factor


def _measured(
    experiment: Experiment, model: FrictionModelSettings, zero: Estimate | None, noise: Callable[[], Noise]
) -> DragRun:
    if experiment.fixture is not Fixture.FOAM:
        raise AnalysisError(
            f"its fixture is {experiment.fixture.value}, not foam: the gut does not close on the capsule"
        )
    setup = Setup.of(experiment)
    seen = sliding(experiment)
    age, held, along_mN = None, 0.0, 0.0
    if zero is None:
        age = _rest_age(experiment)
        held = resting_force(setup, model, age)
        force = _raised(difference(seen.steady, rest_mean(experiment, seen.direction, noise())), held)
    else:
        along_mN = _goes_along(zero, resting_force(setup, model, _rest_age(experiment)))
        own = Estimate(zero.value, ((zero.standard_error or 0.0) ** 2 - along_mN**2) ** 0.5)
        force = difference(seen.steady, along(own, seen.direction))
    if force.value is None:
        raise AnalysisError(force.reason)
    by_model = parts(setup, model, np.array([seen.speed_mm_s]))
    # A run whose wall is stiffer presses harder at rest too, which goes off with the rest.
    stiff = STIFFNESS * (float(by_model.wall[0]) - held) - along_mN
    scatter = hypot(stiff, FRICTION * float(by_model.f_c[0]))
    return DragRun(experiment.file, setup, seen.direction, seen.speed_mm_s, force, scatter, age)


def _goes_along(zero: Estimate, resting_mN: float) -> float:
    """Return which part of a zero's error goes along with the steady force's scatter, one standard deviation.

    Where a fit tells the zero, it does so from the rest, and is in doubt by how hard the run's own wall presses there.
    """
    return min(zero.standard_error or 0.0, STIFFNESS * abs(resting_mN))


def _raised(force: Estimate, by_mN: float) -> Estimate:
    return force if force.value is None else Estimate(force.value + by_mN, force.standard_error)


def _rest_age(experiment: Experiment) -> float:
    """Return the noted age of the contact in the middle of the rest."""
    still = experiment.time_s[at_rest(experiment.run.trace)]
    return experiment.insertion_dwell_s + (0.5 * float(still[0] + still[-1]) if still.size else 0.0)


def _grouped(runs: Sequence[DragRun]) -> list[list[DragRun]]:
    groups: list[list[DragRun]] = []
    rising = sorted(runs, key=lambda run: (-run.direction, run.speed_mm_s))
    for _, one_way in groupby(rising, key=lambda run: run.direction):
        previous = 0.0
        for run in one_way:
            if previous and log(run.speed_mm_s / previous) < log(SAME_SPEED):
                groups[-1].append(run)
            else:
                groups.append([run])
            previous = run.speed_mm_s
    return groups


def _mean(group: Sequence[DragRun]) -> "tuple[float, np.ndarray[tuple[int], np.dtype[np.float64]]]":
    weights = np.array([1 / run.variance for run in group])
    values = np.array([run.force.value for run in group], dtype=float)
    return float(weights @ values / weights.sum()), weights


def _point(group: Sequence[DragRun], model: FrictionModelSettings, factor: float) -> SpeedPoint:
    mean, weights = _mean(group)
    speed = float(np.mean([run.speed_mm_s for run in group]))
    by_model = parts(group[0].setup, model, np.array([speed]))
    error = factor * float(weights.sum()) ** -0.5
    return SpeedPoint(
        speed_mm_s=group[0].direction * speed,
        runs=len(group),
        force=Estimate(mean, error),
        f_e_mN=float(by_model.f_e[0]),
        f_v_mN=float(by_model.f_v[0]),
        f_c_mN=float(by_model.f_c[0]),
    )
