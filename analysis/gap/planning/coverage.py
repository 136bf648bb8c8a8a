"""The next run where the position strays as no effect of the catalogue does: how the stage has not moved yet."""

from collections.abc import Sequence
from math import log

import numpy as np

from dragrig.analysis.gap.judging import UNKNOWN
from dragrig.analysis.gap.planning.results import Contest, NextExperiment, NextRun
from dragrig.analysis.gap.planning.search import HANDS_MIN, Budget
from dragrig.analysis.gap.planning.trials import Trial
from dragrig.analysis.gap.planning.words import subject
from dragrig.analysis.gap.position.errors import PositionErrors
from dragrig.analysis.gap.position.finding import PositionFinding
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.gap.sentences import listed
from dragrig.rig.arrays import FloatArray

LEAST_BEYOND = log(1.5)
"""A run whose speed, acceleration and travel differ by less from those of another shows nothing else."""
LOW, HIGH = 0.1, 0.9
"""Parts of the highest speed between which an acceleration is taken."""
ASPECTS = ("speed", "acceleration", "travel", "direction")
NOTHING_FURTHER = (
    "No further run would show more of how the position strays: those made already have speeds, accelerations and "
    "travels like all that were compared."
)


def search_uncovered(
    position: PositionFinding, tried: Sequence[tuple[Trial, PositionErrors]], budget: Budget
) -> NextExperiment | None:
    """Return the runs furthest beyond those so far per minute of rig time, each after those before.

    None where the runs so far move the stage in all ways that are tried.
    """
    covered = [motion_of(one) for one in position.runs]
    contest = _now(position)
    chosen: list[NextRun] = []
    first = ""
    spent = 0.0
    while len(chosen) < budget.runs:
        beyond = [(_beyond(motion_of(seen), covered), trial, seen) for trial, seen in tried]
        fitting = [
            one for one in beyond if float(one[0].max()) >= LEAST_BEYOND and spent + one[1].minutes <= budget.minutes
        ]
        if not fitting:
            break
        by, trial, seen = max(fitting, key=lambda one: float(one[0].max()) / (one[1].minutes + HANDS_MIN))
        first = first or _why(trial, by, len(tried))
        chosen.append(NextRun(trial.step, trial.minutes, contest, contest))
        covered.append(motion_of(seen))
        spent += trial.minutes
    return NextExperiment(tuple(chosen), len(tried), first) if chosen else None


def motion_of(one: PositionErrors) -> FloatArray:
    """Return the logarithms of a run's speed, acceleration and travel, and of how many ways it goes, shape `(4,)`."""
    time = one.experiment.time_s
    command = np.asarray(one.experiment.run.trace.command, dtype=np.float64)
    speed = np.abs(np.gradient(command, time))
    top = float(speed.max())
    begin, end = int(np.argmax(speed > LOW * top)), int(np.argmax(speed > HIGH * top))
    acceleration = (HIGH - LOW) * top / max(float(time[end] - time[begin]), float(time[1] - time[0]))
    ways = 2.0 if one.velocity_mm_s.min() < 0 < one.velocity_mm_s.max() else 1.0
    return np.log(np.maximum((top, acceleration, np.ptp(command), ways), 1e-6))


def _beyond(motion: FloatArray, covered: Sequence[FloatArray]) -> FloatArray:
    """Return by how much a run differs from the one that is most like it, in each aspect."""
    return min((np.abs(motion - one) for one in covered), key=lambda one: float(one.max()))


def _now(position: PositionFinding) -> Contest:
    """Return what the best form leaves of what strays."""
    left = 1.0 - max((one.held_out for one in position.families), default=0.0)
    seen = max(one.rms_mm / one.least_mm for one in position.runs)
    return Contest(UNKNOWN, "", SEEN * seen * float(np.sqrt(min(left, 1.0))), min(left, 1.0))


def _why(trial: Trial, by: FloatArray, tried: int) -> str:
    differs = [name for name, value in zip(ASPECTS, by.tolist(), strict=True) if value >= LEAST_BEYOND]
    return (
        f"{subject(trial.step)} goes furthest per minute of rig time beyond how the stage has moved: no "
        f"run so far comes near its {listed(differs)}. How the position strays has no name yet, and where it has not "
        f"been looked at most of it can show. {trial.minutes:.1f} min of rig time; {tried} runs were compared."
    )
