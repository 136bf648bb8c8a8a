"""What was promised of the gap's shrinking, against what fresh runs show."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from dragrig.gap_scoring.rates import Rate, rate
from dragrig.gap_scoring.records import SMALL, Case

ENOUGH = 0.9


@dataclass(frozen=True, slots=True)
class Kept:
    """A promise and what came of it: the share of the gap that closes on held-out runs and on fresh ones."""

    case: str
    promised: float
    interval: tuple[float, float] | None
    achieved: float
    right: bool


@dataclass(frozen=True, slots=True)
class Promises:
    """All promises.

    Attributes
    ----------
    kept
        Campaigns whose diagnosis named an effect, with a gap to close on its own and on the fresh runs.
    difference
        Median of the absolute differences; NaN where there are none.
    right_difference
        The same over right names alone.
    within
        How many fresh runs lie in the promised 95 % interval. It is over the runs of one session: what differs between
        sessions and speeds comes on top.
    closed
        How many right names at full size and at a third close 90 % of the gap on fresh runs.
    """

    kept: tuple[Kept, ...]
    difference: float
    right_difference: float
    within: Rate
    closed: Rate


def promises(cases: Sequence[Case]) -> Promises:
    """Compare promises with fresh runs."""
    kept = tuple(found for one in cases if (found := _kept(one)) is not None)
    large = {one.name for one in cases if one.answer.least >= SMALL}
    covered = [one.interval[0] <= one.achieved <= one.interval[1] for one in kept if one.interval is not None]
    closed = [one.achieved >= ENOUGH for one in kept if one.right and one.case in large]
    return Promises(
        kept,
        _median_difference(kept),
        _median_difference([one for one in kept if one.right]),
        rate("achieved within the promised interval", covered),
        rate("right name, 90 % closed on fresh runs", closed),
    )


def _kept(case: Case) -> Kept | None:
    promised = None if case.said.shrink is None or not case.said.effects else case.said.shrink
    if promised is None or promised.closed is None or case.achieved is None or case.achieved.closed is None:
        return None
    return Kept(case.name, promised.closed, promised.closed_95ci, case.achieved.closed, case.found)


def _median_difference(kept: Sequence[Kept]) -> float:
    return median(abs(one.promised - one.achieved) for one in kept) if kept else float("nan")
