"""Runs that may be made next: a fixed grid of sensible ones."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product

from dragrig.config.plan import Plan, Step, WayBack
from dragrig.config.specimen import Specimen
from dragrig.rig.programme import PlannedRun, Programme, build

START_MM = 0.0
USUAL_MM, SHORT_MM = 40.0, 20.0
SLOW_MM_S = 2.0
"""Up to this speed a shorter stroke is tried too, which takes half the time."""
DRAGS_MM_S = (0.5, 1.0, 2.0, 3.5, 7.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0)
COULOMBS_MM_S = (0.5, 1.0, 2.0, 5.0, 15.0, 40.0)
STRAINS = (0.5, 1.0, 1.5, 2.0)
HOLDS_S = (20.0, 60.0)
BLANKS = ((5.0, 400.0), (40.0, 100.0), (40.0, 400.0), (40.0, 2000.0))
DWELLS_S = (10.0, 300.0)
DWELT_MM_S = (2.0, 20.0)
REVERSALS_MM_S = (2.0, 20.0)
LONG_MM, TWICE = 80.0, 2
FEW_MOVES = ((2.0, 400.0), (20.0, 400.0), (60.0, 400.0), (20.0, 2000.0), (60.0, 2000.0), (40.0, 100.0))
MOVED_MM_S, MOVED_MM_S2, MOVED_MM = (2.0, 20.0, 60.0), (100.0, 400.0, 2000.0), (USUAL_MM, LONG_MM)


@dataclass(frozen=True, eq=False)
class Trial:
    """One run with its way back, or some like it, as a step of a plan."""

    step: Step
    specimen: Specimen

    @cached_property
    def programme(self) -> Programme:
        """What is done."""
        plan = Plan(name="next", steps=(self.step,))
        return build(plan, self.specimen, START_MM, "the run that is tried")

    @property
    def run(self) -> PlannedRun:
        """The run itself, the first of some that are alike."""
        return self.programme.runs[0]

    @property
    def minutes(self) -> float:
        """Rig time with the rest before it and the way back."""
        return self.programme.duration_s / 60


@dataclass(frozen=True, slots=True)
class Limits:
    """What the rig can do; strokes go up from where they begin."""

    travel_mm: float = USUAL_MM
    speed_mm_s: float = 60.0
    accel_mm_s2: float = 2000.0
    kinds: tuple[str, ...] = ()
    """Kinds of run that can be made; all unless some are named."""

    def allow(self, trial: Trial) -> bool:
        """Whether a trial keeps within them."""
        found = trial.run.profile.extremes()
        return (
            found.highest_mm <= self.travel_mm + 1e-6
            and found.lowest_mm >= -1e-6
            and found.speed_mm_s <= self.speed_mm_s * (1 + 1e-9)
            and found.acceleration_mm_s2 <= self.accel_mm_s2 * (1 + 1e-9)
            and (not self.kinds or trial.step.kind in self.kinds)
        )


def few(specimen: Specimen) -> tuple[Trial, ...]:
    """Return a dozen runs that differ much from each other."""
    steps = [
        _stroke("drag", 1.0, SHORT_MM),
        *(_stroke("drag", speed, USUAL_MM) for speed in (5.0, 20.0, 60.0)),
        _stroke("coulomb", 1.0, SHORT_MM),
        _stroke("coulomb", 15.0, USUAL_MM),
        _relaxation(2.0, 20.0),
        _stroke("blank", 40.0, USUAL_MM, accel_mm_s2=2000.0),
        _reversal(20.0),
    ]
    return _trials(steps, specimen)


def many(specimen: Specimen) -> tuple[Trial, ...]:
    """Return the whole grid: speed, travel, strain, hold, rest before the run, acceleration and reversal."""
    steps = [
        *(_stroke("drag", speed, USUAL_MM) for speed in DRAGS_MM_S),
        *(_stroke("drag", speed, SHORT_MM) for speed in DRAGS_MM_S if speed <= SLOW_MM_S),
        *(_stroke("drag", speed, USUAL_MM, wait_s=wait) for speed in DWELT_MM_S for wait in DWELLS_S),
        *(_stroke("coulomb", speed, SHORT_MM if speed <= SLOW_MM_S else USUAL_MM) for speed in COULOMBS_MM_S),
        *(_relaxation(strain, hold) for hold in HOLDS_S for strain in STRAINS),
        *(_stroke("blank", speed, USUAL_MM, accel_mm_s2=accel) for speed, accel in BLANKS),
        *(_reversal(speed) for speed in REVERSALS_MM_S),
    ]
    return _trials(steps, specimen)


def moves(specimen: Specimen, *, whole: bool = False) -> tuple[Trial, ...]:
    """Return runs that differ in how the stage moves: blanks, which need no rest and no specimen, and a reversal.

    Eight of them, or the whole grid of speed, acceleration and travel. Each is made twice: what one motion alone shows
    cannot be judged on runs that took no part.
    """
    if whole:
        tried = product(MOVED_MM_S, MOVED_MM_S2, MOVED_MM)
        grid = [one for one in tried if one[0] ** 2 / one[1] < one[2]]
    else:
        grid = [*((*one, USUAL_MM) for one in FEW_MOVES), (20.0, 400.0, SHORT_MM)]
    steps = [_stroke("blank", speed, travel, accel_mm_s2=accel) for speed, accel, travel in grid]
    return _trials([one.model_copy(update={"repeats": TWICE}) for one in (*steps, _reversal(20.0))], specimen)


def _trials(steps: Iterable[Step], specimen: Specimen) -> tuple[Trial, ...]:
    return tuple(Trial(step, specimen) for step in steps)


def _stroke(
    kind: str, speed_mm_s: float, travel_mm: float, *, wait_s: float | None = None, accel_mm_s2: float = 400.0
) -> Step:
    usual = {"drag": 60.0, "coulomb": 30.0, "blank": 5.0}[kind]
    settings = {"speed_mm_s": speed_mm_s, "travel_mm": travel_mm, "accel_mm_s2": accel_mm_s2}
    return Step(kind=kind, wait_s=usual if wait_s is None else wait_s, parameters=settings)


def _relaxation(strain: float, hold_s: float) -> Step:
    return Step(kind="relaxation", wait_s=60.0, parameters={"shear_strain": strain, "hold_s": hold_s})


def _reversal(speed_mm_s: float) -> Step:
    """There and back at one speed, as one record with a pause at the turn."""
    there: Mapping[str, float] = {"travel_mm": USUAL_MM, "speed_mm_s": speed_mm_s, "pause_s": 1.0}
    back: Mapping[str, float] = {"travel_mm": -USUAL_MM, "speed_mm_s": speed_mm_s}
    return Step(kind="motion", way_back=WayBack.STAY, wait_s=60.0, parameters={"strokes": [there, back]})
