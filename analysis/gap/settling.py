"""Spending rig time until a gap is settled: when to stop, and how long the next batch of runs may be."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from dragrig.analysis.gap.candidate_runs import ExperimentBudget, RigLimits
from dragrig.analysis.gap.diagnosis import Diagnosis, NextRun, OpenCauses, Verdict

MIN_BATCH_MIN, BATCH_SHARE = 5.0, 0.5
"""A batch takes at least so many minutes, or this share of the time that is left: long enough for a change of fixture
to pay, short enough that what it shows changes what follows."""
MAX_BATCH_RUNS = 12
DEFAULT_UNTIL = 0.95


class Ending(StrEnum):
    """Why no further run is made."""

    SETTLED = "settled"
    TIME = "time"
    NO_RUN = "no run helps"


@dataclass(frozen=True, slots=True)
class SettleStep:
    """A diagnosis on the way, and what was decided after it.

    Attributes
    ----------
    runs
        Number of runs so far.
    spent_min
        Rig time so far.
    verdict, effects, probability
        Verdict of the diagnosis with its probability.
    presence
        Probability of each effect by the diagnosis.
    open_causes
        What is open about the causes, sizes included that the runs so far cannot show.
    next_runs
        Runs that are made next; none at the end.
    reason
        Why these, or why none.
    """

    runs: int
    spent_min: float
    verdict: Verdict
    effects: tuple[str, ...]
    probability: float
    presence: Mapping[str, float]
    open_causes: OpenCauses | None
    next_runs: tuple[NextRun, ...] = ()
    reason: str = ""


def top_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the verdict."""
    return max((hypothesis.probability for hypothesis in diagnosis.ranking), default=0.0)


def is_settled(diagnosis: Diagnosis, until: float) -> bool:
    """Whether verdict and set of causes are both at least this probable, sizes included that nobody could see yet."""
    open_causes = diagnosis.open_causes
    return top_probability(diagnosis) >= until and (open_causes is None or open_causes.surest >= until)


def batch_budget(left_min: float, limits: RigLimits | None) -> ExperimentBudget:
    """Return the limits of the next batch of runs, given the rig time that is left."""
    minutes = min(max(MIN_BATCH_MIN, BATCH_SHARE * left_min), left_min)
    return ExperimentBudget(minutes, MAX_BATCH_RUNS, limits)


def ending_of(diagnosis: Diagnosis, until: float, left_min: float, shortest_run_min: float) -> Ending | None:
    """Return why to stop after a diagnosis; None to go on with the runs that it recommends."""
    if is_settled(diagnosis, until):
        return Ending.SETTLED
    if diagnosis.next_experiment is None:
        return Ending.TIME if left_min < shortest_run_min else Ending.NO_RUN
    return None
