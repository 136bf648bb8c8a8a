"""Spending rig time until a gap is settled: when to stop, how long the next batch of runs may be, the decisions."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal

from pydantic import AwareDatetime, Field

from dragrig.analysis.gap.candidate_runs import DEFAULT_HANDS_MIN, ExperimentBudget, RigLimits
from dragrig.analysis.gap.diagnosis import Diagnosis
from dragrig.config import Plan, Settings

MIN_BATCH_MIN, BATCH_SHARE = 5.0, 0.5
"""A batch takes at least so many minutes, or this share of the time that is left: long enough for a change of fixture
to pay, short enough that what it shows changes what follows."""
MAX_BATCH_RUNS = 12
SHORTEST_RUN_MIN = 0.5
"""With less rig time left there is no batch."""
DEFAULT_UNTIL = 0.95
SETTLE_FILE = "settle.json"
"""Where the decisions stand in the campaign's folder."""
MIN_KEPT_PRESENCE = 0.001


class Ending(StrEnum):
    """Why no further run is made."""

    SETTLED = "settled"
    TIME = "time"
    NO_RUN = "no run helps"


def verdict_probability(diagnosis: Diagnosis) -> float:
    """Return the probability of the verdict."""
    return max((hypothesis.probability for hypothesis in diagnosis.ranking), default=0.0)


def surest_causes(diagnosis: Diagnosis) -> float:
    """Return the probability of the most likely set of causes, sizes included that nobody could see yet."""
    return 1.0 if diagnosis.open_causes is None else diagnosis.open_causes.surest


def batch_budget(left_min: float, limits: RigLimits | None, hands_min: float = DEFAULT_HANDS_MIN) -> ExperimentBudget:
    """Return the limits of the next batch of runs, given the rig time that is left and the cost of hands."""
    minutes = min(max(MIN_BATCH_MIN, BATCH_SHARE * left_min), left_min)
    return ExperimentBudget(max(minutes, 0.0), MAX_BATCH_RUNS, limits, hands_min=hands_min)


def ending_of(diagnosis: Diagnosis, until: float, left_min: float) -> Ending | None:
    """Return why to stop after a diagnosis; None to go on with the runs that it recommends.

    The gap is settled where verdict and causes are both at least as probable as `until`.
    """
    if min(verdict_probability(diagnosis), surest_causes(diagnosis)) >= until:
        return Ending.SETTLED
    if left_min < SHORTEST_RUN_MIN:
        return Ending.TIME
    return Ending.NO_RUN if diagnosis.next_experiment is None else None


class Batch(Settings):
    """Runs that are made together, and why."""

    plan: Plan
    minutes: float
    """Rig time."""
    runs: tuple[str, ...] = ()
    """The runs in words; of the first batch, its plan tells them."""
    reason: str = ""
    gain_bits: float | None = None
    """Information that they were expected to give; None for the first, and for motions that nothing was known of."""


class SettleStep(Settings):
    """The diagnosis after a batch."""

    runs: int
    """Number of runs that it was made of."""
    spent_min: float
    """Rig time so far."""
    verdict: str
    effects: tuple[str, ...] = ()
    probability: float
    """Of the verdict."""
    presence: Mapping[str, float]
    """Probability of each effect by the diagnosis, next to impossible ones left out."""
    surest: float
    """Probability of the most likely set of causes, sizes included that these runs cannot show."""
    open_bits: float | None = None


class SettleRecord(Settings):
    """The decisions so far, as `settle.json` in the campaign's folder."""

    format_version: Literal[1] = 1
    plan: str
    begun_at: AwareDatetime
    minutes: float
    until: float
    hands_min: float = Field(DEFAULT_HANDS_MIN, ge=0, allow_inf_nan=False)
    """Minutes of a person at a change of fixture or capsule."""
    batches: tuple[Batch, ...]
    steps: tuple[SettleStep, ...] = ()
    ending: Ending | None = None

    @property
    def planned_min(self) -> float:
        """Rig time of all batches."""
        return sum(batch.minutes for batch in self.batches)

    @property
    def left_min(self) -> float:
        """Rig time that is left after all batches."""
        return max(self.minutes - self.planned_min, 0.0)


def settle_step(diagnosis: Diagnosis, record: SettleRecord) -> SettleStep:
    """Return the step of a diagnosis after the latest batch of runs."""
    presence = {} if diagnosis.budget is None else diagnosis.budget.presence
    open_causes = diagnosis.open_causes
    return SettleStep(
        runs=diagnosis.runs,
        spent_min=record.planned_min,
        verdict=diagnosis.verdict.value,
        effects=diagnosis.effects,
        probability=verdict_probability(diagnosis),
        presence={name: value for name, value in presence.items() if value >= MIN_KEPT_PRESENCE},
        surest=surest_causes(diagnosis),
        open_bits=None if open_causes is None else open_causes.bits,
    )
