"""Detection against size: how often an effect of some d′ is seen, and how often it is named rightly."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf

from dragrig.gap_scoring.rates import Rate, rate
from dragrig.gap_scoring.records import Case

EDGES = (0.0, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0, inf)
"""Of d′; below 3 nobody can see an effect."""


@dataclass(frozen=True, slots=True)
class Detection:
    """Single effects whose d′ lies from `low` to below `high`: any gap seen, the right name, and a misleading verdict.

    The campaigns with a nominal model that is slightly wrong are not among them.
    """

    low: float
    high: float
    seen: Rate
    named: Rate
    misled: Rate


def detection(cases: Sequence[Case]) -> tuple[Detection, ...]:
    """Return the bins that have cases."""
    single = [one for one in cases if len(one.answer.effects) == 1 and not one.answer.nominal_slightly_wrong]
    made = []
    for low, high in pairwise(EDGES):
        there = [one for one in single if one.amount is not None and low <= one.amount < high]
        if there:
            seen = rate("a gap is seen", [one.said.verdict != "no_gap" for one in there])
            named = rate("the right name", [one.found for one in there])
            # What is not seen, and rightly so because it is too small, misleads nobody.
            misled = rate("a wrong name", [bool(one.said.effects) and one.wrong for one in there])
            made.append(Detection(low, high, seen, named, misled))
    return tuple(made)
