"""What a capsule robot reaches: its steady walk, the drive that is fastest within its actuator's limits."""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, log

import numpy as np

from dragrig.config import RobotDrive, RobotSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.robot import AddedForce, Period, Resistance, Walker, energy_error

MIN_SHARE = 0.005
"""Least acceleration that the optimisation tries, over the actuator's greatest."""
MIN_STROKE = 0.05
"""Least stroke that it tries, over the greatest."""
MAX_PERIODS = 400
STEADY_MM = 7.0
"""Travel after which the wall under the leading hemisphere is the walk's own."""
STEADY_CHANGE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class SteadyWalk:
    """A walk that repeats itself from period to period."""

    drive: RobotDrive
    walker: Walker
    speed_mm_s: float
    loss_uJ_mm: float
    """Mechanical work per travel; infinite where it does not move."""
    last: tuple[Period, ...]
    """The periods that speed and work are averages of."""
    converged: bool
    """Whether the last periods are alike."""
    energy_error: float
    """Work that is neither lost to friction nor kinetic, over the loss, of the whole walk."""


def steady_walk(
    robot: RobotSettings,
    drive: RobotDrive,
    surface: Callable[[], Resistance],
    added: AddedForce | None = None,
    change: float = STEADY_CHANGE,
) -> SteadyWalk:
    """Walk from rest until the periods are alike."""
    resistance = surface()
    walker = Walker(robot, drive, resistance, added)
    settle_mm = 0.0 if resistance.constant else STEADY_MM
    last: tuple[Period, ...] = ()
    converged = False
    for number in range(MAX_PERIODS):
        made = walker.period()
        if made.forwards_mm == made.backwards_mm == 0.0 and number >= 2:
            last, converged = (made,), True
            break
        if abs(made.end_mm) < settle_mm or number < 3:
            continue
        recent = walker.periods[-3:]
        travel = np.array([period.travel_mm for period in recent])
        if np.ptp(travel) <= change * max(abs(float(travel.mean())), made.forwards_mm * 0.01):
            last, converged = (made,), True
            break
    if not last:
        last = tuple(walker.periods[-len(walker.periods) // 3 :])
    travel_mm = last[-1].end_mm - last[0].begin_mm
    loss = sum(period.loss_uJ for period in last)
    return SteadyWalk(
        drive=drive,
        walker=walker,
        speed_mm_s=travel_mm / (len(last) * drive.period_s),
        loss_uJ_mm=loss / abs(travel_mm) if travel_mm else np.inf,
        last=last,
        converged=converged,
        energy_error=energy_error(walker.periods),
    )


def drive_within(robot: RobotSettings, place: FloatArray) -> RobotDrive:
    """Return the drive at a place of the unit cube: slow, fast, stroke, pause; no limit of the actuator is exceeded."""
    slow, fast, stroke, pause = (min(max(float(value), 0.0), 1.0) for value in place)
    most = robot.max_acceleration_mm_s2
    slow_mm_s2, fast_mm_s2 = (most * exp((1 - share) * log(MIN_SHARE)) for share in (slow, fast))
    stroke_mm = robot.max_stroke_mm * (MIN_STROKE + (1 - MIN_STROKE) * stroke)
    fastest = 0.5 * robot.max_relative_speed_mm_s**2 * (1 / slow_mm_s2 + 1 / fast_mm_s2)
    return RobotDrive(
        slow_mm_s2=slow_mm_s2,
        fast_mm_s2=fast_mm_s2,
        stroke_mm=min(stroke_mm, fastest),
        pause_s=robot.max_pause_s * pause**3,
    )


def place_of(robot: RobotSettings, drive: RobotDrive) -> FloatArray:
    """Return where in the unit cube a drive is, the inverse of `drive_within`."""
    most = robot.max_acceleration_mm_s2
    slow, fast = (1 - log(value / most) / log(MIN_SHARE) for value in (drive.slow_mm_s2, drive.fast_mm_s2))
    stroke = (drive.stroke_mm / robot.max_stroke_mm - MIN_STROKE) / (1 - MIN_STROKE)
    pause = (drive.pause_s / robot.max_pause_s) ** (1 / 3) if robot.max_pause_s else 0.0
    return np.clip([slow, fast, stroke, pause], 0.0, 1.0)


def fastest_drive(
    robot: RobotSettings, surface: Callable[[], Resistance], seed: int, start: RobotDrive | None = None
) -> RobotDrive:
    """Return the drive within the limits that is fastest on a surface.

    Parameters
    ----------
    seed
        Of the global search, differential evolution.
    start
        A drive near the best, from which the search is local.
    """
    from scipy.optimize import differential_evolution, minimize

    def slowness(place: FloatArray) -> float:
        return -steady_walk(robot, drive_within(robot, place), surface, change=1e-3).speed_mm_s

    bounds = [(0.0, 1.0)] * 4
    if start is None:
        found = differential_evolution(
            slowness, bounds, popsize=8, maxiter=25, tol=1e-3, seed=seed, polish=False, init="sobol"
        )
        place = found.x
    else:
        place = place_of(robot, start)
    result = minimize(
        slowness, place, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3, "fatol": 1e-4, "maxfev": 150}
    )
    return drive_within(robot, result.x)
