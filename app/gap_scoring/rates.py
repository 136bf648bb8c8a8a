"""Rates with Wilson intervals: how often what was said is right, kind of campaign by kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dragrig.gap_scoring.records import SMALL, Case, Verdict

NAMED, SURE = 0.5, 0.8
CHANNEL = "full size, right channel"


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of cases with its 95 % interval (Wilson); NaN where there are no cases."""

    name: str
    held: int
    count: int
    share: float
    low: float
    high: float


def rate(name: str, held: Sequence[bool]) -> Rate:
    """Return how often something held."""
    from scipy.stats import binomtest

    if not held:
        return Rate(name, 0, 0, float("nan"), float("nan"), float("nan"))
    interval = binomtest(sum(held), len(held)).proportion_ci(method="wilson")
    return Rate(name, sum(held), len(held), sum(held) / len(held), float(interval.low), float(interval.high))


def rates(cases: Sequence[Case]) -> tuple[Rate, ...]:
    """Return all rates of an exam, in the order of its table."""
    return tuple(rate(name, [held(one) for one in cases if counts(one)]) for name, counts, held in _RATES)


def verdict_rates(cases: Sequence[Case]) -> tuple[Rate, ...]:
    """Return the rates that ask for nothing but a verdict with its probabilities."""
    return tuple(one for one in rates(cases) if one.name != CHANNEL)


def _single(low: float, high: float, *, rough: bool = False) -> Callable[[Case], bool]:
    def counts(case: Case) -> bool:
        one = case.answer
        return len(one.effects) == 1 and low <= one.least < high and one.nominal_slightly_wrong == rough

    return counts


def _without(verdict: Verdict, *, rough: bool = False) -> Callable[[Case], bool]:
    return lambda case: case.answer.verdict == verdict and case.answer.nominal_slightly_wrong == rough


_ANY = float("inf")
_RATES: tuple[tuple[str, Callable[[Case], bool], Callable[[Case], bool]], ...] = (
    ("full size, right name", _single(0.9, _ANY), lambda case: case.found),
    ("full size, right name alone", _single(0.9, _ANY), lambda case: case.answer.effects == case.said.effects),
    (CHANNEL, _single(0.9, _ANY), lambda case: case.channel),
    ("a third, right name", _single(SMALL, 0.9), lambda case: case.found),
    ("a tenth, right name or no gap", _single(0.0, SMALL), lambda case: case.right),
    ("none, no gap", _without("no_gap"), lambda case: case.right),
    ("outside, unknown", _without("unknown"), lambda case: case.right),
    (
        "outside, a name above 0.5",
        _without("unknown"),
        lambda case: bool(case.said.effects) and case.said.named > NAMED,
    ),
    ("pair, both named", lambda case: len(case.answer.effects) > 1, lambda case: case.found),
    ("pair, one named", lambda case: len(case.answer.effects) > 1, lambda case: not case.wrong),
    ("rough, right name", _single(0.0, _ANY, rough=True), lambda case: case.found),
    ("rough, none, no gap", _without("no_gap", rough=True), lambda case: case.right),
    ("all, wrong above 0.8", lambda _: True, lambda case: case.wrong and case.said.probability > SURE),
    ("above 0.8, right", lambda case: case.said.probability > SURE, lambda case: case.right),
)
