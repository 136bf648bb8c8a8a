"""How often a gap diagnosis is right, scored on campaigns whose hidden effects are known."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from statistics import median
from typing import TYPE_CHECKING, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dragrig.config.errors import AnalysisError
from dragrig.sim_backend.effects.base import confusable_effects

if TYPE_CHECKING:
    from rich.table import Table


POSITION_EFFECTS = frozenset({"servo_lag", "velocity_ripple", "encoder_scale"})
"""Effects that show in the position channel."""
EITHER_CHANNEL_EFFECTS = frozenset({"channel_latency"})
"""Effects that show between the channels, so that either is right."""
MIN_DETECTABLE_SIZE = 0.2
"""Below this size an effect may be too small to see, and `no_gap` is right too."""

VerdictName = Literal["effect", "several", "no_gap", "unknown"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class AnswerKey(_Record):
    """What is hidden in a campaign; an entry of `answers.json`."""

    verdict: VerdictName
    effects: tuple[str, ...] = ()
    truth: str = ""
    form: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    nominal_slightly_wrong: bool = False

    @property
    def least(self) -> float:
        """The smallest size of its effects; 1 where sizes are not told."""
        return min(self.size, default=1.0)

    @property
    def accepted(self) -> frozenset[str]:
        """Hypotheses that are right: an effect that is too small to see may pass for no gap."""
        name = "+".join(sorted(self.effects)) if self.effects else self.verdict
        return frozenset({name, "no_gap"} if self.effects and self.least < MIN_DETECTABLE_SIZE else {name})


class ScoredHypothesis(_Record):
    """A hypothesis and its probability."""

    hypothesis: str
    probability: float = Field(ge=0, le=1 + 1e-9)

    @property
    def name(self) -> str:
        """Its id, several in the order of the alphabet."""
        return "+".join(sorted(self.hypothesis.split("+")))


class ScoredWhere(_Record):
    """Where the gap is, as far as it is scored."""

    channel: Mapping[str, float] = Field(default_factory=dict)


class ScoredShrink(_Record):
    """How far a gap shrinks, as far as it is scored."""

    closed: float | None = None
    closed_95ci: tuple[float, float] | None = None


class ScoredDiagnosis(_Record):
    """What a diagnosis says, as far as it is scored."""

    verdict: VerdictName
    effects: tuple[str, ...] = ()
    ranking: tuple[ScoredHypothesis, ...] = ()
    confusable_with: tuple[str, ...] = ()
    where: ScoredWhere = ScoredWhere()
    shrink: ScoredShrink | None = None

    @property
    def probability(self) -> float:
        """Probability of the hypothesis that stands first."""
        return max((one.probability for one in self.ranking), default=0.0)

    @property
    def named(self) -> float:
        """Probability of the likeliest hypothesis that is the name of an effect."""
        names = (one.probability for one in self.ranking if one.hypothesis not in {"no_gap", "unknown"})
        return max(names, default=0.0)

    @property
    def stated(self) -> float:
        """Probability of the verdict; that of what stands first where the ranking does not have it."""
        name = "+".join(sorted(self.effects)) or self.verdict
        return next((one.probability for one in self.ranking if one.name == name), self.probability)


@dataclass(frozen=True, slots=True)
class ScoredCase:
    """A campaign with its answer and what was said of it.

    Attributes
    ----------
    withheld
        What was said when its own effect was taken out of the catalogue; None where that was not asked.
    achieved
        How far the amended model closes the gap on fresh runs; None where there is none.
    amount
        d′ of the hidden effect; None where it was not measured.
    """

    name: str
    answer: AnswerKey
    said: ScoredDiagnosis
    withheld: ScoredDiagnosis | None = None
    achieved: ScoredShrink | None = None
    amount: float | None = None

    @property
    def found(self) -> bool:
        """Whether every hidden effect is named."""
        return bool(self.answer.effects) and set(self.answer.effects) <= set(self.said.effects)

    @property
    def right(self) -> bool:
        """Whether the verdict is right: all effects named, or `no_gap` or `unknown` where that is the answer."""
        if not self.answer.effects:
            return self.said.verdict == self.answer.verdict
        return self.found or (self.said.verdict == "no_gap" and self.answer.least < MIN_DETECTABLE_SIZE)

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
        return effect in EITHER_CHANNEL_EFFECTS or max(shares, key=lambda name: shares[name]) == (
            "position" if effect in POSITION_EFFECTS else "force"
        )


RECORD_NAMES = {"AnswerKey": "answer", "ScoredDiagnosis": "diagnosis", "ScoredShrink": "shrink"}
RecordT = TypeVar("RecordT", AnswerKey, ScoredDiagnosis, ScoredShrink)


def parse_record(kind: type[RecordT], given: object, name: str) -> RecordT:
    """Return what a file holds of a campaign as far as it is scored; raises `AnalysisError` where it lacks it."""
    try:
        return kind.model_validate(given)
    except ValidationError as fault:
        first = fault.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise AnalysisError(
            f"{name}: the {RECORD_NAMES[kind.__name__]} cannot be scored because {place} is not as the report's format "
            f"has it ({first['msg'].lower()}); make it anew"
        ) from fault


NAMED_ABOVE, SURE_ABOVE = 0.5, 0.8
CHANNEL_RATE = "full size, right channel"


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of cases with its 95 % interval (Wilson); NaN where there are no cases."""

    name: str
    held: int
    count: int
    share: float
    low: float
    high: float


def wilson_rate(name: str, held: Sequence[bool]) -> Rate:
    """Return how often something held."""
    from scipy.stats import binomtest

    if not held:
        return Rate(name, 0, 0, float("nan"), float("nan"), float("nan"))
    interval = binomtest(sum(held), len(held)).proportion_ci(method="wilson")
    return Rate(name, sum(held), len(held), sum(held) / len(held), float(interval.low), float(interval.high))


def exam_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return all rates of an exam, in the order of its table."""
    return tuple(
        wilson_rate(name, [held(one) for one in cases if counts(one)]) for name, counts, held in _RATE_DEFINITIONS
    )


def verdict_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return the rates that ask for nothing but a verdict with its probabilities."""
    return tuple(one for one in exam_rates(cases) if one.name != CHANNEL_RATE)


def _is_single_effect(low: float, high: float, *, rough: bool = False) -> Callable[[ScoredCase], bool]:
    def counts(case: ScoredCase) -> bool:
        one = case.answer
        return len(one.effects) == 1 and low <= one.least < high and one.nominal_slightly_wrong == rough

    return counts


def _is_without_effect(verdict: VerdictName, *, rough: bool = False) -> Callable[[ScoredCase], bool]:
    return lambda case: case.answer.verdict == verdict and case.answer.nominal_slightly_wrong == rough


_ANY_SIZE = float("inf")
_RATE_DEFINITIONS: tuple[tuple[str, Callable[[ScoredCase], bool], Callable[[ScoredCase], bool]], ...] = (
    ("full size, right name", _is_single_effect(0.9, _ANY_SIZE), lambda case: case.found),
    (
        "full size, right name alone",
        _is_single_effect(0.9, _ANY_SIZE),
        lambda case: case.answer.effects == case.said.effects,
    ),
    (CHANNEL_RATE, _is_single_effect(0.9, _ANY_SIZE), lambda case: case.channel),
    ("a third, right name", _is_single_effect(MIN_DETECTABLE_SIZE, 0.9), lambda case: case.found),
    ("a tenth, right name or no gap", _is_single_effect(0.0, MIN_DETECTABLE_SIZE), lambda case: case.right),
    ("none, no gap", _is_without_effect("no_gap"), lambda case: case.right),
    ("outside, unknown", _is_without_effect("unknown"), lambda case: case.right),
    (
        "outside, a name above 0.5",
        _is_without_effect("unknown"),
        lambda case: bool(case.said.effects) and case.said.named > NAMED_ABOVE,
    ),
    ("pair, both named", lambda case: len(case.answer.effects) > 1, lambda case: case.found),
    ("pair, one named", lambda case: len(case.answer.effects) > 1, lambda case: not case.wrong),
    ("rough, right name", _is_single_effect(0.0, _ANY_SIZE, rough=True), lambda case: case.found),
    ("rough, none, no gap", _is_without_effect("no_gap", rough=True), lambda case: case.right),
    ("all, wrong above 0.8", lambda _: True, lambda case: case.wrong and case.said.probability > SURE_ABOVE),
    ("above 0.8, right", lambda case: case.said.probability > SURE_ABOVE, lambda case: case.right),
)


def withheld_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return how often that is right, and how often another effect is named without doubt."""
    asked = [one for one in cases if one.withheld is not None and len(one.answer.effects) == 1]
    large = [one for one in asked if one.answer.least >= MIN_DETECTABLE_SIZE]
    return (
        wilson_rate(
            "withheld, unknown, or its near-alias with doubt", [is_right_without_true_effect(one) for one in large]
        ),
        wilson_rate(
            "withheld, unknown", [one.withheld is not None and one.withheld.verdict == "unknown" for one in large]
        ),
        wilson_rate("withheld, a name above 0.5", [_names_other_effect(one) for one in large]),
        wilson_rate(
            "withheld, a tenth: that, or no gap",
            [is_right_without_true_effect(one) for one in asked if one.answer.least < MIN_DETECTABLE_SIZE],
        ),
    )


def is_right_without_true_effect(case: ScoredCase) -> bool:
    """Whether what is said without the true effect is right.

    That is `unknown`; a near-alias of the true effect, with its probability below 0.5 or another that cannot be told
    from it; and `no_gap` for an effect that is too small to see.
    """
    said = case.withheld
    if said is None:
        return False
    if said.verdict == "unknown":
        return True
    if said.verdict == "no_gap":
        return case.answer.least < MIN_DETECTABLE_SIZE
    alias = set(said.effects) <= confusable_effects(case.answer.effects[0])
    return alias and (said.stated < NAMED_ABOVE or bool(said.confusable_with))


def _names_other_effect(case: ScoredCase) -> bool:
    return case.withheld is not None and bool(case.withheld.effects) and case.withheld.stated > NAMED_ABOVE


SEVERAL, UNKNOWN, NO_GAP = "several", "unknown", "no_gap"


@dataclass(frozen=True, slots=True)
class ConfusionMatrix:
    """Counts of campaigns.

    Attributes
    ----------
    hidden
        Names of the rows: effects, then `several`, `unknown` (an effect that the catalogue does not have) and
        `no_gap`, as far as they occur.
    said
        Names of the columns, likewise.
    counts
        A row for each hidden.
    """

    hidden: tuple[str, ...]
    said: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]


def confusion_matrix(cases: Sequence[ScoredCase]) -> ConfusionMatrix:
    """Count what was said of what."""
    met = Counter((_row_name(one.answer.effects, one.answer.verdict), _row_name(one.said.effects, one.said.verdict))
                  for one in cases)  # fmt: skip
    hidden = _effects_first({row for row, _ in met})
    said = _effects_first({column for _, column in met} | set(hidden))
    return ConfusionMatrix(hidden, said, tuple(tuple(met[row, column] for column in said) for row in hidden))


def _row_name(effects: Sequence[str], verdict: str) -> str:
    if len(effects) > 1:
        return SEVERAL
    return effects[0] if effects else verdict


def _effects_first(names: set[str]) -> tuple[str, ...]:
    last = (SEVERAL, UNKNOWN, NO_GAP)
    return (*sorted(names - set(last)), *(one for one in last if one in names))


D_PRIME_EDGES = (0.0, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0, inf)
"""Of d′; below 3 nobody can see an effect."""


@dataclass(frozen=True, slots=True)
class DetectionBin:
    """Single effects whose d′ lies from `low` to below `high`: any gap seen, the right name, and a misleading verdict.

    The campaigns with a nominal model that is slightly wrong are not among them.
    """

    low: float
    high: float
    seen: Rate
    named: Rate
    misled: Rate


def detection_bins(cases: Sequence[ScoredCase]) -> tuple[DetectionBin, ...]:
    """Return the bins that have cases."""
    single = [one for one in cases if len(one.answer.effects) == 1 and not one.answer.nominal_slightly_wrong]
    made = []
    for low, high in pairwise(D_PRIME_EDGES):
        there = [one for one in single if one.amount is not None and low <= one.amount < high]
        if there:
            seen = wilson_rate("a gap is seen", [one.said.verdict != "no_gap" for one in there])
            named = wilson_rate("the right name", [one.found for one in there])
            # What is not seen, and rightly so because it is too small, misleads nobody.
            misled = wilson_rate("a wrong name", [bool(one.said.effects) and one.wrong for one in there])
            made.append(DetectionBin(low, high, seen, named, misled))
    return tuple(made)


PROBABILITY_EDGES = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Verdicts whose probability lies from `low` to `high`.

    Attributes
    ----------
    count, right
        How many there are, and how many of them are right.
    probability
        Mean of what was stated.
    band
        Share that would be right in 95 % of exams like this if every probability were true (binomial).
    """

    low: float
    high: float
    count: int
    right: int
    probability: float
    band: tuple[float, float]

    @property
    def share(self) -> float:
        """Share that is right."""
        return self.right / self.count


@dataclass(frozen=True, slots=True)
class ProbabilityCalibration:
    """How good the probabilities are.

    Attributes
    ----------
    brier, brier_base, skill
        Mean squared error of the probabilities of all hypotheses; that of always stating how often each hypothesis is
        true in this exam; and `1 - brier / brier_base`. NaN where there is nothing to compare.
    verdict_brier, verdict_base, verdict_skill
        The same of the verdict's own probability against always stating the share of right verdicts, which is the
        harder the better a diagnosis is.
    bins
        The reliability diagram.
    """

    brier: float
    brier_base: float
    skill: float
    verdict_brier: float
    verdict_base: float
    verdict_skill: float
    bins: tuple[ReliabilityBin, ...]


def probability_calibration(cases: Sequence[ScoredCase]) -> ProbabilityCalibration:
    """Judge the probabilities of an exam."""
    truths = [one.answer.accepted for one in cases]
    base = _base_rates(truths)
    told = [{each.name: each.probability for each in one.said.ranking} for one in cases]
    brier = _mean_or_nan([_brier_error(one, truth) for one, truth in zip(told, truths, strict=True)])
    brier_base = _mean_or_nan([_brier_error(base, truth) for truth in truths])
    right = [one.right for one in cases]
    stated = [one.said.stated for one in cases]
    share = _mean_or_nan([float(one) for one in right])
    verdict = _mean_or_nan([(each - held) ** 2 for each, held in zip(stated, right, strict=True)])
    verdict_base = _mean_or_nan([(share - held) ** 2 for held in right])
    bins = tuple(_reliability_bins(stated, right))
    return ProbabilityCalibration(brier, brier_base, _skill_score(brier, brier_base), verdict, verdict_base,
                       _skill_score(verdict, verdict_base), bins)  # fmt: skip


def _base_rates(truths: Sequence[frozenset[str]]) -> dict[str, float]:
    """Return how often each hypothesis is true; one that is right beside another counts for what is hidden."""
    names = Counter(sorted(one - {"no_gap"} or one)[0] for one in truths)
    return {name: count / len(truths) for name, count in names.items()}


def _brier_error(told: dict[str, float], truth: frozenset[str]) -> float:
    """Return the squared error over all hypotheses; those that are right count as one."""
    on_truth = sum(probability for name, probability in told.items() if name in truth)
    others = sum(probability**2 for name, probability in told.items() if name not in truth)
    return (1.0 - on_truth) ** 2 + others


def _reliability_bins(stated: Sequence[float], right: Sequence[bool]) -> list[ReliabilityBin]:
    made = []
    for low, high in pairwise(PROBABILITY_EDGES):
        there = [at for at, one in enumerate(stated) if low < min(one, 1.0) <= high or (one <= 0 == low)]
        if there:
            mean = _mean_or_nan([min(stated[at], 1.0) for at in there])
            made.append(
                ReliabilityBin(
                    low, high, len(there), sum(right[at] for at in there), mean, _binomial_band(len(there), mean)
                )
            )
    return made


def _binomial_band(count: int, probability: float) -> tuple[float, float]:
    from scipy.stats import binom

    return tuple(float(binom.ppf(tail, count, probability)) / count for tail in (0.025, 0.975))  # type: ignore[return-value]


def _skill_score(error: float, base: float) -> float:
    return 1.0 - error / base if base > 0 else float("nan")


def _mean_or_nan(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else float("nan")


CLOSED_SHARE = 0.9


@dataclass(frozen=True, slots=True)
class PromiseOutcome:
    """A promise and what came of it: the share of the gap that closes on held-out runs and on fresh ones."""

    case: str
    promised: float
    interval: tuple[float, float] | None
    achieved: float
    right: bool


@dataclass(frozen=True, slots=True)
class PromiseScore:
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

    kept: tuple[PromiseOutcome, ...]
    difference: float
    right_difference: float
    within: Rate
    closed: Rate


def promise_score(cases: Sequence[ScoredCase]) -> PromiseScore:
    """Compare promises with fresh runs."""
    kept = tuple(found for one in cases if (found := _promise_outcome(one)) is not None)
    large = {one.name for one in cases if one.answer.least >= MIN_DETECTABLE_SIZE}
    covered = [one.interval[0] <= one.achieved <= one.interval[1] for one in kept if one.interval is not None]
    closed = [one.achieved >= CLOSED_SHARE for one in kept if one.right and one.case in large]
    return PromiseScore(
        kept,
        _median_difference(kept),
        _median_difference([one for one in kept if one.right]),
        wilson_rate("achieved within the promised interval", covered),
        wilson_rate("right name, 90 % closed on fresh runs", closed),
    )


def _promise_outcome(case: ScoredCase) -> PromiseOutcome | None:
    promised = None if case.said.shrink is None or not case.said.effects else case.said.shrink
    if promised is None or promised.closed is None or case.achieved is None or case.achieved.closed is None:
        return None
    return PromiseOutcome(case.name, promised.closed, promised.closed_95ci, case.achieved.closed, case.found)


def _median_difference(kept: Sequence[PromiseOutcome]) -> float:
    return median(abs(one.promised - one.achieved) for one in kept) if kept else float("nan")


@dataclass(frozen=True, slots=True)
class ExamScore:
    """How often a diagnosis is right.

    Attributes
    ----------
    rates
        In the order of the table.
    missed
        The cases whose verdict is not right.
    withheld
        Rates of what is said when the true effect is taken out of the catalogue.
    """

    rates: tuple[Rate, ...]
    missed: tuple[ScoredCase, ...]
    confusion: ConfusionMatrix
    detection: tuple[DetectionBin, ...]
    calibration: ProbabilityCalibration
    promises: PromiseScore
    withheld: tuple[Rate, ...]

    def __getitem__(self, name: str) -> Rate:
        """Return the rate of that name."""
        return next(one for one in (*self.rates, *self.withheld) if one.name == name)

    def tables(self) -> tuple["Table", "Table"]:
        """Return the rates, and what was said where it was not right, as tables for a console."""
        from rich.table import Table

        shown = Table("", "held", "share", "95 % interval", title="How often the diagnosis is right")
        for one in self.rates:
            bounds = f"{one.low:.2f} to {one.high:.2f}"
            told = (f"{one.share:.2f}", bounds) if one.count else ("", "")
            shown.add_row(one.name, f"{one.held} of {one.count}", *told)
        missed = Table("case", "truth", "form", "size", "said", "probability", title="Not right")
        for row in map(missed_cells, self.missed):
            missed.add_row(*row)
        return shown, missed


def missed_cells(case: ScoredCase) -> tuple[str, ...]:
    """Return a case whose verdict is not right as cells: name, truth, form, size, said, probability."""
    said = "+".join(case.said.effects) or case.said.verdict
    sizes = ", ".join(f"{size:.2g}" for size in case.answer.size)
    truth = case.answer.truth or ", ".join(case.answer.effects)
    return case.name, truth, ", ".join(case.answer.form), sizes, said, f"{case.said.probability:.2f}"


def score_exam(
    pairs: Iterable[tuple[str, Mapping[str, object], Mapping[str, object]]],
    *,
    withheld: Mapping[str, Mapping[str, object]] | None = None,
    achieved: Mapping[str, Mapping[str, object]] | None = None,
    amounts: Mapping[str, float] | None = None,
) -> ExamScore:
    """Score diagnoses against what was hidden.

    Parameters
    ----------
    pairs
        Name of the campaign, its answer, and the diagnosis as `dragrig gap diagnose --json` prints it.
    withheld
        Diagnoses without the true effect, by the campaign's name.
    achieved
        What `dragrig gap evaluate --json` prints of fresh runs, by the campaign's name.
    amounts
        d′ of the hidden effects, by the campaign's name.

    Raises
    ------
    AnalysisError
        When an answer or a diagnosis lacks what is scored.
    """
    others, fresh, sizes = withheld or {}, achieved or {}, amounts or {}
    cases = [
        ScoredCase(
            name,
            parse_record(AnswerKey, answer, name),
            parse_record(ScoredDiagnosis, said, name),
            parse_record(ScoredDiagnosis, others[name], name) if name in others else None,
            parse_record(ScoredShrink, fresh[name].get("shrink"), name) if name in fresh else None,
            sizes.get(name),
        )
        for name, answer, said in pairs
    ]
    return ExamScore(
        exam_rates(cases),
        tuple(one for one in cases if not one.right),
        confusion_matrix(cases),
        detection_bins(cases),
        probability_calibration(cases),
        promise_score(cases),
        withheld_rates(cases),
    )
