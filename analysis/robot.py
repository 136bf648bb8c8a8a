"""The reach of a capsule robot: its steady walk, the fastest drive, the weight of assumptions, the price of effects."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import exp, log
from types import MappingProxyType

import numpy as np

from dragrig.analysis import Progress, no_progress
from dragrig.config import Fixture, FrictionModelSettings, RobotDrive, RobotSettings, SettingsError, Specimen
from dragrig.rig import Acquisition, Contact, FloatArray, MotionProfile
from dragrig.sim_backend.effects import ActiveEffect, active_effects, gut_run_state
from dragrig.sim_backend.friction import RecordedMotion
from dragrig.sim_backend.robot import AddedForce, Period, Resistance, Walker, energy_error, gut, hard_ground

HARD_DRIVE, GUT_DRIVE, OWN_DRIVE = "best on the hard surface", "chosen for the gut", "as given"
SLIP_POINTS = 13
"""Times of a panel by which a walk becomes a motion of the effects."""
MIN_STEP_S = 1e-8
ADDED_POINTS = 24
"""Times at which the force of effects is known."""
MEAN_MM = 20.0
"""Travel over which the force of a periodic effect is averaged at the end of a walk."""
FIRST_S = 2e-6
"""Begin and end of a slip that are left out, since the motion is at rest there."""
EXACT_SIGN_MM_S = 1e-6
"""Speed over which Coulomb friction changes sign in the effects: the robot's has its exact sign."""
MAX_RELAXATIONS, UNDAMPED = 15, 3
"""Iterations between effects and walk, and how many are undamped."""

MIN_SHARE = 0.005
"""Least acceleration that the optimisation tries, over the actuator's greatest."""
MIN_STROKE = 0.05
"""Least stroke that it tries, over the greatest."""
MIN_PAUSE_S = 1e-3
"""A shorter pause is none."""
MAX_PERIODS = 400
MAX_SEARCH_PERIODS = 30
"""Longest walk, and the longest while a drive is sought."""
STEADY_MM = 7.0
"""Travel after which the wall under the leading hemisphere is the walk's own."""
STEADY_CHANGE, SEARCH_CHANGE = 1e-5, 1e-3
"""Relative change of the travel from period to period at the end of a walk, and while a drive is sought."""
UNSTEADY_WORTH = 0.5
"""Worth of a speed whose periods are not alike: it hangs on the rule for reversals, which no measurement supports."""
SOBOL_POINTS, STRONGEST_POINTS, BEST_PLACES = 16, 10, 1
"""Drives that a search begins with: of all kinds, the strongest, and how many of the best it goes on from."""
EVALUATIONS, LOCAL_EVALUATIONS = 60, 12
AT_LIMIT = 1e-3
"""Distance in the unit cube at which a drive is at a limit."""


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
    max_periods: int = MAX_PERIODS,
    further_mm: float = 0.0,
) -> SteadyWalk:
    """Walk from rest until the periods are alike, and `further_mm` more."""
    resistance = surface()
    walker = Walker(robot, drive, resistance, added)
    settle_mm = 0.0 if resistance.constant else STEADY_MM
    last: tuple[Period, ...] = ()
    converged = False
    for number in range(max_periods):
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
    while converged and last[0].travel_mm and abs(walker.position_mm - last[0].end_mm) < further_mm:
        if len(walker.periods) >= max_periods:
            break
        walker.period()
    if not last:
        last = tuple(walker.periods[-len(walker.periods) // 3 :])
    travel_mm = last[-1].end_mm - last[0].begin_mm
    loss = sum(period.loss_uJ for period in last)
    return SteadyWalk(
        drive=drive,
        walker=walker,
        speed_mm_s=travel_mm / (len(last) * drive.period_s),
        loss_uJ_mm=loss / abs(travel_mm) if abs(travel_mm) > 1e-6 else np.inf,
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
    pause_s = robot.max_pause_s * pause**3
    return RobotDrive(
        slow_mm_s2=slow_mm_s2,
        fast_mm_s2=fast_mm_s2,
        stroke_mm=min(stroke_mm, fastest),
        pause_s=pause_s if pause_s >= MIN_PAUSE_S else 0.0,
    )


def place_of(robot: RobotSettings, drive: RobotDrive) -> FloatArray:
    """Return where in the unit cube a drive is, the inverse of `drive_within`."""
    most = robot.max_acceleration_mm_s2
    slow, fast = (1 - log(value / most) / log(MIN_SHARE) for value in (drive.slow_mm_s2, drive.fast_mm_s2))
    stroke = (drive.stroke_mm / robot.max_stroke_mm - MIN_STROKE) / (1 - MIN_STROKE)
    pause = (drive.pause_s / robot.max_pause_s) ** (1 / 3) if robot.max_pause_s else 0.0
    return np.asarray(np.clip([slow, fast, stroke, pause], 0.0, 1.0))


def fastest_drive(
    robot: RobotSettings,
    surface: Callable[[], Resistance],
    seed: int,
    start: FloatArray | None = None,
    added: AddedForce | None = None,
) -> RobotDrive:
    """Return the drive within the limits that is fastest on a surface.

    Parameters
    ----------
    seed
        Of the Sobol points from whose best the search goes on, by Nelder and Mead's method.
    start
        Where in the unit cube the search begins that is local: a value at a limit of the actuator there stays at it.
    added
        Force of effects.
    """
    from scipy.optimize import minimize

    def slowness(place: FloatArray) -> float:
        drive = drive_within(robot, place)
        walk = steady_walk(robot, drive, surface, added, SEARCH_CHANGE, MAX_SEARCH_PERIODS)
        return -walk.speed_mm_s * (1.0 if walk.converged else UNSTEADY_WORTH)

    def search(place: FloatArray, free: Sequence[bool], evaluations: int) -> tuple[float, FloatArray]:
        def whole(values: FloatArray) -> FloatArray:
            found = place.copy()
            found[list(free)] = values
            return found

        def objective(values: FloatArray) -> float:
            return slowness(whole(values))

        found = minimize(
            objective,
            place[list(free)],
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * sum(free),
            options={"xatol": 1e-3, "fatol": 1e-4, "maxfev": evaluations},
        )
        return float(found.fun), whole(np.asarray(found.x, dtype=np.float64))

    if start is not None:
        inside = [AT_LIMIT < value < 1 - AT_LIMIT for value in start]
        return drive_within(robot, search(start, inside if any(inside) else [True] * 4, LOCAL_EVALUATIONS)[1])
    from scipy.stats import qmc

    everywhere = qmc.Sobol(4, rng=seed).random(SOBOL_POINTS)
    strongest = [np.array([slow, 1.0, 1.0, 0.0]) for slow in np.linspace(0.05, 1.0, STRONGEST_POINTS)]
    places = sorted((*everywhere, *strongest), key=slowness)[:BEST_PLACES]
    _, best = min((search(place, [True] * 4, EVALUATIONS) for place in places), key=lambda found: found[0])
    return drive_within(robot, best)


@dataclass(frozen=True, slots=True)
class RelaxedWalk:
    """A walk with effects: their force along the walk and the walk under their force, until both agree."""

    walk: SteadyWalk
    added: AddedForce | None
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class RobotInGut:
    """A robot in the gut of a specimen, as a model without effects has it."""

    robot: RobotSettings
    model: FrictionModelSettings
    specimen: Specimen

    def surface(self) -> Resistance:
        """Return a gut through which nothing has gone."""
        return gut(self.robot, self.model, self.specimen.wall_thickness_mm)

    def walk(self, drive: RobotDrive, effects: Sequence[ActiveEffect]) -> RelaxedWalk:
        """Walk with effects: simulate, compute their force along the motion, simulate with it, until both agree."""
        periodic = any(active.effect.period is not None for active in effects)
        further_mm = MEAN_MM if periodic else 0.0
        walk = steady_walk(self.robot, drive, self.surface, further_mm=further_mm)
        if not effects:
            return RelaxedWalk(walk, None, 0, converged=True)
        added: AddedForce | None = None
        tolerance = max(1e-3 * abs(walk.speed_mm_s), 1e-4)
        for number in range(1, MAX_RELAXATIONS + 1):
            fresh = added_force(walk, effects, self.model, self.specimen)
            if fresh is None:
                return RelaxedWalk(walk, added, number, converged=True)
            added = fresh if added is None or number <= UNDAMPED else _mean_force(added, fresh)
            before, walk = walk.speed_mm_s, steady_walk(self.robot, drive, self.surface, added, further_mm=further_mm)
            if abs(walk.speed_mm_s - before) < tolerance:
                return RelaxedWalk(walk, added, number, converged=True)
        return RelaxedWalk(walk, added, MAX_RELAXATIONS, converged=False)


def added_force(
    walk: SteadyWalk, effects: Sequence[ActiveEffect], model: FrictionModelSettings, specimen: Specimen
) -> AddedForce | None:
    """Return the mean force of effects over the slips at the end of a walk; None where nothing slips.

    Effects periodic in position or in the session's clock enter by its mean over these slips. A direction in which
    nothing slips has the force of the other.
    """
    walker = walk.walker
    if not walker.slips:
        return None
    robot = walker.robot
    times = [np.linspace(slip.start_s, slip.end_s, SLIP_POINTS) for slip in walker.slips]
    time_s = np.unique(np.concatenate((*times, [0.0, walker.time_s])))
    time_s = time_s[np.append(True, np.diff(time_s) > MIN_STEP_S)]
    motion = RecordedMotion.computed(time_s, walker.sample(time_s)[0])
    begin_s = walk.last[0].begin_s
    starts = {(slip.since_s, slip.direction): slip.end_s for slip in walker.slips if slip.since_s >= begin_s}
    if not starts:
        return None
    longest = max(end - since for (since, _), end in starts.items())
    since_s = longest * np.linspace(0.0, 1.0, ADDED_POINTS) ** 2
    forces: dict[int, FloatArray] = {}
    exact = model.model_copy(update={"regularisation_mm_s": EXACT_SIGN_MM_S})
    acquisition = Acquisition(
        run_id="robot",
        order=0,
        kind="robot",
        profile=MotionProfile.from_pieces(()),
        capsule=robot.capsule,
        specimen=specimen,
        fixture=Fixture.FOAM,
        contact=Contact.SLIDING,
        insertion_dwell_s=robot.insertion_dwell_s,
    )
    for direction in (1, -1):
        slips = [(since, end) for (since, sign), end in starts.items() if sign == direction]
        if not slips:
            continue
        at = np.concatenate([np.minimum(since + FIRST_S + since_s, end - FIRST_S) for since, end in slips])
        rising, back = np.unique(at, return_inverse=True)
        run = gut_run_state(acquisition, exact, motion, rising)
        force = sum((active.effect.added_force(run, active.values) for active in effects), np.zeros_like(rising))
        forces[direction] = direction * force[back].reshape(len(slips), -1).mean(axis=0)
    forwards = forces.get(1, forces.get(-1))
    backwards = forces.get(-1, forwards)
    if forwards is None or backwards is None:
        return None
    return AddedForce(since_s, forwards, backwards)


def _mean_force(before: AddedForce, after: AddedForce) -> AddedForce:
    """Return the mean of two forces, which damps a relaxation that swings."""
    time = after.time_s
    return AddedForce(
        time,
        0.5 * (before.resistance(1, time) + after.forwards_mN),
        0.5 * (before.resistance(-1, time) + after.backwards_mN),
    )


@dataclass(frozen=True, slots=True, eq=False)
class DrivenRobot:
    """A drive on the hard surface and in the gut."""

    name: str
    hard: SteadyWalk
    gut: SteadyWalk
    iterations: int = 0
    converged: bool = True
    """`iterations`, `converged`: of the force of effects in the gut."""


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """The three speeds [mm/s] at the ends of an assumption's range: on the hard surface, its drive in the gut, best."""

    key: str
    value: float
    low: float
    high: float
    at_low: tuple[float, float, float]
    at_high: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Price:
    """The price of an effect: speed and work per mm of the drive chosen for the gut, beside those without it."""

    effect: str
    speed_mm_s: float | None
    speed_change_mm_s: float | None
    speed_error_mm_s: float | None
    """Standard error, from that of the effect's size; None where that is not known."""
    work_change_uJ_mm: float | None
    note: str = ""
    """Why it has no price, or what there is to say of it."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotStudy:
    """The reach of a robot, and its dependence on the assumptions."""

    robot: RobotSettings
    model: FrictionModelSettings
    seed: int
    drives: tuple[DrivenRobot, ...]
    """The drives best on the hard surface and best in the gut, or the one that was given; prices are of the last."""
    static_mN: float
    """Static resistance in the gut when the robot starts."""
    sensitivities: tuple[Sensitivity, ...]
    prices: tuple[Price, ...]
    effects: tuple[str, ...]


def study_robot(
    robot: RobotSettings,
    model: FrictionModelSettings,
    specimen: Specimen,
    *,
    drive: RobotDrive | None = None,
    diagnosed: FrictionModelSettings | None = None,
    errors: Mapping[str, float] = MappingProxyType({}),
    sensitivity: bool = True,
    seed: int = 1,
    progress: Progress = no_progress,
) -> RobotStudy:
    """Study a robot in a model.

    Parameters
    ----------
    drive
        To simulate; without it the best ones are sought.
    diagnosed
        Model with the effects that are priced; their base is the same model without them.
    errors
        Standard errors of the sizes of its effects, by id.
    sensitivity
        Whether to vary the assumptions.

    Raises
    ------
    SettingsError
        For a drive beyond the actuator's limits, or a model that the robot cannot have.
    AnalysisError
        Where a motion cannot be integrated.
    """
    if drive is not None and (reason := robot.why_not(drive)):
        raise SettingsError(f"{reason}; choose a weaker drive or a stronger actuator.")
    base = (model if diagnosed is None else diagnosed).model_copy(update={"effects": ()})
    acting = [active for active in active_effects(model) if active.effect.belongs_to_gut]
    hard, inside = partial(hard_ground, robot), RobotInGut(robot, base, specimen)
    varied = robot.ranges if sensitivity and drive is None else {}
    priced = () if diagnosed is None else active_effects(diagnosed)
    steps = 2 + len(varied) + len(priced)
    if drive is None:
        hard_drive = fastest_drive(robot, hard, seed)
        progress(1, steps)
        gut_drive = fastest_drive(robot, inside.surface, seed)
        if acting:
            added = inside.walk(gut_drive, acting).added
            gut_drive = fastest_drive(robot, inside.surface, seed, place_of(robot, gut_drive), added)
        chosen = {HARD_DRIVE: hard_drive, GUT_DRIVE: gut_drive}
    else:
        chosen = {OWN_DRIVE: drive}
    progress(2, steps)
    drives = []
    for name, of in chosen.items():
        relaxed = inside.walk(of, acting)
        drives.append(
            DrivenRobot(name, steady_walk(robot, of, hard), relaxed.walk, relaxed.iterations, relaxed.converged)
        )
    sensitivities = []
    places = [place_of(robot, driven.gut.drive) for driven in drives]
    for number, (key, (low, high)) in enumerate(varied.items()):
        others = (replace(inside, robot=robot.model_copy(update={key: value})) for value in (low, high))
        ends = [_speeds(other, places) for other in others]
        sensitivities.append(Sensitivity(key, float(getattr(robot, key)), low, high, ends[0], ends[1]))
        progress(3 + number, steps)
    prices = []
    without = steady_walk(robot, drives[-1].gut.drive, inside.surface) if acting else drives[-1].gut
    for number, active in enumerate(priced):
        prices.append(_price(without, inside, active, errors.get(active.effect.id)))
        progress(3 + len(varied) + number, steps)
    slips = [active for active in priced if active.effect.belongs_to_gut]
    if len(slips) > 1:
        together = inside.walk(drives[-1].gut.drive, slips)
        prices.append(_difference("all of them together", without, together, None))
    return RobotStudy(
        robot=robot,
        model=model,
        seed=seed,
        drives=tuple(drives),
        static_mN=inside.surface().at_rest()(0.0),
        sensitivities=tuple(sensitivities),
        prices=tuple(prices),
        effects=tuple(active.effect.id for active in acting),
    )


def _speeds(inside: RobotInGut, places: Sequence[FloatArray]) -> tuple[float, float, float]:
    """Return the three speeds of another robot, whose drives are sought near the same share of its limits."""
    robot, hard = inside.robot, partial(hard_ground, inside.robot)
    best_hard = fastest_drive(robot, hard, 1, places[0])
    best_gut = fastest_drive(robot, inside.surface, 1, places[1])
    return (
        steady_walk(robot, best_hard, hard).speed_mm_s,
        steady_walk(robot, best_hard, inside.surface).speed_mm_s,
        steady_walk(robot, best_gut, inside.surface).speed_mm_s,
    )


def _price(without: SteadyWalk, inside: RobotInGut, active: ActiveEffect, error: float | None) -> Price:
    effect = active.effect
    if not effect.belongs_to_gut:
        return Price(effect.id, None, None, None, None, "belongs to the rig, not to the robot: no price")
    relaxed = inside.walk(without.drive, [active])
    spread = None
    if error:
        sizes = [active.values[effect.size.name] + sign * error for sign in (-1, 1)]
        resized = (ActiveEffect(effect, {**active.values, effect.size.name: size}) for size in sizes)
        ends = [inside.walk(without.drive, [other]).walk.speed_mm_s for other in resized]
        spread = 0.5 * abs(ends[1] - ends[0])
    return _difference(effect.id, without, relaxed, spread)


def _difference(name: str, without: SteadyWalk, relaxed: RelaxedWalk, spread: float | None) -> Price:
    walk = relaxed.walk
    moves = np.isfinite(walk.loss_uJ_mm) and np.isfinite(without.loss_uJ_mm)
    notes = []
    if not relaxed.converged:
        notes.append(f"not settled after {relaxed.iterations} iterations: the last is told")
    if walk.speed_mm_s == 0:
        notes.append("the robot does not move with it")
    if walk.speed_mm_s < 0:
        notes.append("the robot moves backwards with it")
    return Price(
        effect=name,
        speed_mm_s=walk.speed_mm_s,
        speed_change_mm_s=walk.speed_mm_s - without.speed_mm_s,
        speed_error_mm_s=spread,
        work_change_uJ_mm=walk.loss_uJ_mm - without.loss_uJ_mm if moves else None,
        note="; ".join(notes),
    )
