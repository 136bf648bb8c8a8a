"""The search for the runs that answer most per minute: one by one, the best of a grid each time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self, TypeVar

from dragrig.analysis.gap.planning.results import Contest, NextRun
from dragrig.analysis.gap.planning.trials import Limits, Trial
from dragrig.config.specimen import Fixture

ENOUGH = 12.0
"""Log odds beyond which nothing more is wanted."""
LEAST_GAIN = 1e-3
"""Less than this, in log odds, is nothing."""
UNBOUNDED = float("inf")
HANDS_MIN = 2.0
"""What changing to another fixture counts beside the rig time."""

SeenT_contra = TypeVar("SeenT_contra", contravariant=True)


@dataclass(frozen=True, slots=True)
class Answer:
    """How far a contest is decided: how sure a diagnosis can be of its truth, and how much that matters."""

    contest: Contest
    log_odds: float
    weight: float

    def worth(self, enough: float) -> float:
        """Return what it counts; what is certain enough counts no further."""
        return self.weight * min(self.log_odds, enough)


class Field(Protocol[SeenT_contra]):
    """Runs with the questions that are asked of them; `SeenT_contra` is what is seen of a run."""

    def with_run(self, seen: SeenT_contra) -> Self:
        """Add a run."""
        ...

    def answers(self) -> Sequence[Answer]:
        """Return how far each question is answered, in their order."""
        ...


@dataclass(frozen=True, slots=True)
class Budget:
    """How much rig time, how many runs, and when nothing more is wanted.

    Attributes
    ----------
    enough
        Log odds beyond which a contest is decided.
    spent_whole
        Whether time that is left once all is decided is spent on making it surer.
    limits
        Of the rig; what the campaign's own runs say unless given.
    """

    minutes: float = float("inf")
    runs: int = 1
    enough: float = ENOUGH
    spent_whole: bool = False
    limits: Limits | None = None


def search(
    field: Field[SeenT_contra], tried: Sequence[tuple[Trial, SeenT_contra]], budget: Budget
) -> tuple[NextRun, ...]:
    """Return the runs that answer most, each the best after those before.

    Parameters
    ----------
    field
        The campaign, with at least one question.
    tried
        Runs that may be made, each with what would be seen of it.
    """
    found = _chosen(field, tried, budget)
    if not found and all(one.log_odds >= budget.enough for one in field.answers()):
        # All is answered well enough already; what would make it surer still is told all the same.
        more = _gathered(_chosen(field, tried, replace(budget, enough=UNBOUNDED)))
        return tuple(replace(one, surer=True) for one in more)
    return _gathered(found)


def _chosen(
    field: Field[SeenT_contra], tried: Sequence[tuple[Trial, SeenT_contra]], budget: Budget
) -> list[tuple[Trial, Contest, Contest]]:
    chosen: list[tuple[Trial, Contest, Contest]] = []
    spent, fitted, enough = 0.0, set[Fixture](), budget.enough
    now = field.answers()
    while len(chosen) < budget.runs:
        best, most = None, 0.0
        for trial, seen in tried:
            if spent + trial.minutes > budget.minutes:
                continue
            after = field.with_run(seen)
            then = after.answers()
            gain = sum(_gains(now, then, enough))
            by_hand = 0.0 if trial.run.fixture in fitted else HANDS_MIN
            if gain > LEAST_GAIN and gain / (trial.minutes + by_hand) > most:
                best, most = (trial, after, then), gain / (trial.minutes + by_hand)
        if best is None and budget.spent_whole and enough < UNBOUNDED:
            enough = UNBOUNDED
            continue
        if best is None:
            break
        trial, field, then = best
        chosen.append((trial, *_decided(now, then, enough)))
        now, spent = then, spent + trial.minutes
        fitted.add(trial.run.fixture)
    return chosen


def _gains(before: Sequence[Answer], after: Sequence[Answer], enough: float) -> list[float]:
    return [then.worth(enough) - now.worth(enough) for now, then in zip(before, after, strict=True)]


def _decided(before: Sequence[Answer], after: Sequence[Answer], enough: float) -> tuple[Contest, Contest]:
    """Return the contest that a run decides most, before and after."""
    gains = _gains(before, after, enough)
    place = gains.index(max(gains))
    return before[place].contest, after[place].contest


def _gathered(chosen: Sequence[tuple[Trial, Contest, Contest]]) -> tuple[NextRun, ...]:
    """Make repeats of what was chosen several times."""
    found: dict[int, NextRun] = {}
    for trial, before, after in chosen:
        known = found.get(id(trial))
        if known is None:
            found[id(trial)] = NextRun(trial.step, trial.minutes, before, after)
            continue
        step = known.step.model_copy(update={"repeats": known.step.repeats + trial.step.repeats})
        found[id(trial)] = replace(known, step=step, minutes=known.minutes + trial.minutes, after=after)
    return tuple(found.values())
