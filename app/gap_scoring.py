"""How often a gap diagnosis is right, from campaigns whose hidden effects are known, with Wilson intervals."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dragrig.config.errors import AnalysisError

if TYPE_CHECKING:
    from rich.table import Table

POSITION = frozenset({"servo_lag", "velocity_ripple", "encoder_scale"})
"""Effects that show in the position channel."""
EITHER = frozenset({"channel_latency"})
"""Effects that show between the channels, so that either is right."""
NAMED, SURE = 0.5, 0.8
SMALL = 0.2
"""Below this size an effect may be too small to see, and `no_gap` is right too."""

Verdict = Literal["effect", "several", "no_gap", "unknown"]


class Answer(BaseModel):
    """What is hidden in a campaign; an entry of `answers.json`."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    verdict: Verdict
    effects: tuple[str, ...] = ()
    truth: str = ""
    form: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    nominal_slightly_wrong: bool = False

    @property
    def least(self) -> float:
        """The smallest size of its effects; 1 where sizes are not told."""
        return min(self.size, default=1.0)


class Ranked(BaseModel):
    """A hypothesis and its probability."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    hypothesis: str
    probability: float = Field(ge=0, le=1 + 1e-9)


class Where(BaseModel):
    """Where the gap is, as far as it is scored."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    channel: Mapping[str, float] = Field(default_factory=dict)


class Diagnosis(BaseModel):
    """What a diagnosis says, as far as it is scored."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    verdict: Verdict
    effects: tuple[str, ...] = ()
    ranking: tuple[Ranked, ...] = ()
    where: Where = Where()

    @property
    def probability(self) -> float:
        """Probability of the hypothesis that stands first."""
        return max((one.probability for one in self.ranking), default=0.0)

    @property
    def named(self) -> float:
        """Probability of the likeliest hypothesis that is the name of an effect."""
        names = (one.probability for one in self.ranking if one.hypothesis not in {"no_gap", "unknown"})
        return max(names, default=0.0)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign with its answer and what was said of it."""

    name: str
    answer: Answer
    said: Diagnosis

    @property
    def found(self) -> bool:
        """Whether every hidden effect is named."""
        return bool(self.answer.effects) and set(self.answer.effects) <= set(self.said.effects)

    @property
    def right(self) -> bool:
        """Whether the verdict is right: all effects named, or `no_gap` or `unknown` where that is the answer."""
        if not self.answer.effects:
            return self.said.verdict == self.answer.verdict
        return self.found or (self.said.verdict == "no_gap" and self.answer.least < SMALL)

    @property
    def wrong(self) -> bool:
        """Whether the verdict misleads: not right, and not one of several effects named with no wrong one beside it."""
        part = bool(self.said.effects) and set(self.said.effects) <= set(self.answer.effects)
        return not self.right and not part

    @property
    def channel(self) -> bool:
        """Whether the channel with the largest share is the effect's."""
        shares = self.said.where.channel
        if not shares or not any(shares.values()):
            return False
        effect = self.answer.effects[0]
        return effect in EITHER or max(shares, key=lambda name: shares[name]) == (
            "position" if effect in POSITION else "force"
        )


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of cases with its 95 % interval (Wilson); NaN where there are no cases."""

    name: str
    held: int
    count: int
    share: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Score:
    """Rates, in the order of the table, and the cases whose verdict is not right."""

    rates: tuple[Rate, ...]
    missed: tuple[Case, ...]

    def __getitem__(self, name: str) -> Rate:
        """Return the rate of that name."""
        return next(one for one in self.rates if one.name == name)

    def tables(self) -> tuple["Table", "Table"]:
        """Return the rates, and what was said where it was not right, as tables for a console."""
        from rich.table import Table

        rates = Table("", "held", "share", "95 % interval", title="How often the diagnosis is right")
        for one in self.rates:
            bounds = f"{one.low:.2f} to {one.high:.2f}"
            told = (f"{one.share:.2f}", bounds) if one.count else ("", "")
            rates.add_row(one.name, f"{one.held} of {one.count}", *told)
        missed = Table("case", "truth", "form", "size", "said", "probability", title="Not right")
        for case in self.missed:
            said = "+".join(case.said.effects) or case.said.verdict
            sizes = ", ".join(f"{size:.2g}" for size in case.answer.size)
            told_p = f"{case.said.probability:.2f}"
            missed.add_row(case.name, case.answer.truth, ", ".join(case.answer.form), sizes, said, told_p)
        return rates, missed


def score(pairs: Iterable[tuple[str, Mapping[str, object], Mapping[str, object]]]) -> Score:
    """Score diagnoses against what was hidden.

    Parameters
    ----------
    pairs
        Name of the campaign, its answer, and the diagnosis as `dragrig gap diagnose --json` prints it.

    Raises
    ------
    AnalysisError
        When an answer or a diagnosis lacks what is scored.
    """
    cases = [Case(name, _read(Answer, answer, name), _read(Diagnosis, said, name)) for name, answer, said in pairs]
    rates = tuple(_rate(name, [held(one) for one in cases if counts(one)]) for name, counts, held in _RATES)
    return Score(rates, tuple(one for one in cases if not one.right))


_Read = TypeVar("_Read", Answer, Diagnosis)


def _read(kind: type[_Read], given: Mapping[str, object], name: str) -> _Read:
    try:
        return kind.model_validate(given)
    except ValidationError as fault:
        first = fault.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise AnalysisError(
            f"{name}: the {kind.__name__.lower()} cannot be scored because {place} is not as the report's format has "
            f"it ({first['msg'].lower()}); make it anew"
        ) from fault


def _rate(name: str, held: Sequence[bool]) -> Rate:
    from scipy.stats import binomtest

    if not held:
        return Rate(name, 0, 0, float("nan"), float("nan"), float("nan"))
    interval = binomtest(sum(held), len(held)).proportion_ci(method="wilson")
    return Rate(name, sum(held), len(held), sum(held) / len(held), float(interval.low), float(interval.high))


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
    ("full size, right channel", _single(0.9, _ANY), lambda case: case.channel),
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
