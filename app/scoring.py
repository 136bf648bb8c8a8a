"""How often a gap diagnosis is right, scored on campaigns whose hidden effects are known."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf, nan
from statistics import median
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dragrig.config import AnalysisError

MIN_DETECTABLE_SIZE = 0.2
"""Below this size an effect may be too small to see, and `no_gap` is right too."""
CLOSED_SHARE = 0.9
"""Share of the gap that must close on fresh runs for an amended model to count as closing it."""
NAMED_ABOVE, SURE_ABOVE = 0.5, 0.8
SEVERAL, UNKNOWN, NO_GAP = "several", "unknown", "no_gap"
CHANNEL_RATE = "full size, right channel"
D_PRIME_EDGES = (0.0, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0, inf)
"""Bins of d′; below 3 an effect cannot be told from noise."""
PROBABILITY_EDGES = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)

VerdictName = Literal["effect", "several", "no_gap", "unknown"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class AnswerKey(_Record):
    """The secret of a campaign; an entry of `answers.json`."""

    verdict: VerdictName
    effects: tuple[str, ...] = ()
    truth: str = ""
    form: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    nominal_slightly_wrong: bool = False
    case: str = ""
    """Kind of the case in its exam's mix."""
    conditions: tuple[str, ...] = ()
    also_right: tuple[str, ...] = ()
    """Names that are no mistake where nothing is hidden: an effect, or `specimen` or `model` as the largest cause."""

    @property
    def smallest_size(self) -> float:
        """The smallest size of its effects; 1 where sizes are not known."""
        return min(self.size, default=1.0)

    @property
    def detectable(self) -> bool:
        """Whether every effect is large enough to be seen."""
        return self.smallest_size >= MIN_DETECTABLE_SIZE

    @property
    def accepted(self) -> frozenset[str]:
        """Hypotheses that are right; for an effect that may be too small to see, `no_gap` too."""
        name = "+".join(sorted(self.effects)) if self.effects else self.verdict
        return frozenset({name, NO_GAP} if self.effects and not self.detectable else {name})


class ScoredHypothesis(_Record):
    """A hypothesis and its probability."""

    hypothesis: str
    probability: float = Field(ge=0, le=1 + 1e-9)

    @property
    def name(self) -> str:
        """Its id, several effects in alphabetical order."""
        return "+".join(sorted(self.hypothesis.split("+")))


class ScoredWhere(_Record):
    """Share of the gap in each channel."""

    channel: Mapping[str, float] = Field(default_factory=dict)


class ScoredShrink(_Record):
    """Share of the gap that closes, with its 95 % interval."""

    closed: float | None = None
    closed_95ci: tuple[float, float] | None = None


class ScoredEvaluation(_Record):
    """The part of an amended model's evaluation on fresh runs that is scored."""

    verdict: str = ""
    shrink: ScoredShrink


class ScoredCause(_Record):
    """A cause of the gap and its share, as a diagnosis states it or as the plant has it."""

    cause: str
    share: float
    channel: str = ""
    """Empty where the diagnosis has one channel."""
    share_95ci: tuple[float, float] | None = None
    not_separable_from: tuple[str, ...] = ()

    @property
    def names(self) -> frozenset[str]:
        """The cause and those that it cannot be told from."""
        return frozenset((*self.cause.split("+"), *self.not_separable_from))


class PlantBudget(_Record):
    """The plant's own shares."""

    budget: tuple[ScoredCause, ...] = ()


class ScoredDiagnosis(_Record):
    """The part of a diagnosis that is scored."""

    verdict: VerdictName
    effects: tuple[str, ...] = ()
    ranking: tuple[ScoredHypothesis, ...] = ()
    confusable_with: tuple[str, ...] = ()
    where: ScoredWhere = ScoredWhere()
    shrink: ScoredShrink | None = None
    budget: tuple[ScoredCause, ...] = ()
    presence: Mapping[str, float] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _likeliest(cls, read: Mapping[str, object]) -> Mapping[str, object]:
        """Score the likeliest hypothesis where a single condition leaves the verdict open."""
        likeliest = read.get("likeliest")
        return {**read, **likeliest} if isinstance(likeliest, Mapping) else read

    @property
    def largest_cause(self) -> str:
        """The cause with the largest share; empty where the diagnosis has no budget."""
        return max(self.budget, key=lambda part: part.share).cause if self.budget else ""

    @property
    def probability(self) -> float:
        """Probability of the most likely hypothesis."""
        return max((ranked.probability for ranked in self.ranking), default=0.0)

    @property
    def effect_probability(self) -> float:
        """Probability of the most likely hypothesis that names an effect."""
        named = (ranked.probability for ranked in self.ranking if ranked.hypothesis not in {NO_GAP, UNKNOWN})
        return max(named, default=0.0)

    @property
    def stated_probability(self) -> float:
        """Probability of the verdict; that of the most likely hypothesis where the ranking lacks the verdict."""
        name = "+".join(sorted(self.effects)) or self.verdict
        return next((ranked.probability for ranked in self.ranking if ranked.name == name), self.probability)


@dataclass(frozen=True, slots=True)
class ScoredCase:
    """A campaign with its answer and its diagnosis."""

    name: str
    answer: AnswerKey
    diagnosis: ScoredDiagnosis
    without_true: ScoredDiagnosis | None = None
    """Diagnosis with its own effect removed from the catalogue; None where that was not made."""
    achieved: ScoredEvaluation | None = None
    """How far the amended model closes the gap on fresh runs; None where there is none."""
    d_prime: float | None = None
    """d′ of the hidden effect; None where it was not computed."""
    budget: tuple[ScoredCause, ...] = ()
    """The plant's own shares; empty where nothing is hidden, or they were not computed."""

    @property
    def single(self) -> bool:
        """Whether a single effect is hidden."""
        return len(self.answer.effects) == 1

    @property
    def all_named(self) -> bool:
        """Whether every hidden effect is named."""
        return bool(self.answer.effects) and set(self.answer.effects) <= set(self.diagnosis.effects)

    @property
    def right(self) -> bool:
        """Whether the verdict is right: all effects named, or `no_gap` or `unknown` where that is the answer."""
        if not self.answer.effects:
            found = set(self.diagnosis.effects) or {self.diagnosis.largest_cause}
            return self.diagnosis.verdict == self.answer.verdict or found <= set(self.answer.also_right)
        return self.all_named or (self.diagnosis.verdict == NO_GAP and not self.answer.detectable)

    @property
    def misleading(self) -> bool:
        """Whether the verdict misleads: not right, and not some of the hidden effects without a wrong one."""
        partly = bool(self.diagnosis.effects) and set(self.diagnosis.effects) <= set(self.answer.effects)
        return not self.right and not partly

    @property
    def right_channel(self) -> bool:
        """Whether the channel with the largest share of the gap shows the effect."""
        from dragrig.sim_backend.effects import catalogue

        shares = self.diagnosis.where.channel
        if not shares or not any(shares.values()):
            return False
        effect = catalogue().get(self.answer.effects[0])
        channels = ("force",) if effect is None else effect.channels
        return len(channels) > 1 or max(shares, key=lambda name: shares[name]) == channels[0]

    @property
    def right_without_true(self) -> bool:
        """Whether the diagnosis without the true effect is right.

        That is `unknown`; an effect that the true one is confused with, with a probability below 0.5 or a second
        candidate; and `no_gap` for an effect that is too small to see.
        """
        from dragrig.sim_backend.effects import confusable_effects

        diagnosis = self.without_true
        if diagnosis is None or diagnosis.verdict == UNKNOWN:
            return diagnosis is not None
        if diagnosis.verdict == NO_GAP:
            return not self.answer.detectable
        confusable = set(diagnosis.effects) <= confusable_effects(self.answer.effects[0])
        return confusable and (diagnosis.stated_probability < NAMED_ABOVE or bool(diagnosis.confusable_with))


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of cases with its 95 % interval (Wilson); NaN where there are no cases."""

    name: str
    held: int
    count: int
    share: float
    low: float
    high: float


def wilson_rate(name: str, outcomes: Sequence[bool]) -> Rate:
    """Return the share of true outcomes."""
    from scipy.stats import binomtest

    if not outcomes:
        return Rate(name, 0, 0, nan, nan, nan)
    held, count = sum(outcomes), len(outcomes)
    interval = binomtest(held, count).proportion_ci(method="wilson")
    return Rate(name, held, count, held / count, float(interval.low), float(interval.high))


def exam_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return all rates of an exam, in the order of its table."""
    met = tuple(rate for rate in _CONDITION_RATES if any(rate[1](case) for case in cases))
    return tuple(
        wilson_rate(name, [holds(case) for case in cases if counts(case)]) for name, counts, holds in (*_RATES, *met)
    )


def verdict_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return the rates that need only the verdict and its probabilities."""
    return tuple(rate for rate in exam_rates(cases) if rate.name != CHANNEL_RATE)


_Condition = Callable[[ScoredCase], bool]


def _hidden(low: float, high: float = inf, *, rough: bool = False) -> _Condition:
    """Select single effects of a size from `low` to below `high`, in campaigns without conditions."""
    return lambda case: (
        case.single
        and low <= case.answer.smallest_size < high
        and case.answer.nominal_slightly_wrong == rough
        and not case.answer.conditions
    )


def _answer(verdict: VerdictName, *, rough: bool = False) -> _Condition:
    return lambda case: (
        case.answer.verdict == verdict and case.answer.nominal_slightly_wrong == rough and not case.answer.conditions
    )


_RATES: tuple[tuple[str, _Condition, _Condition], ...] = (
    ("full size, right name", _hidden(0.9), lambda case: case.all_named),
    ("full size, right name alone", _hidden(0.9), lambda case: case.answer.effects == case.diagnosis.effects),
    (CHANNEL_RATE, _hidden(0.9), lambda case: case.right_channel),
    ("a third, right name", _hidden(MIN_DETECTABLE_SIZE, 0.9), lambda case: case.all_named),
    ("a tenth, right name or no gap", _hidden(0.0, MIN_DETECTABLE_SIZE), lambda case: case.right),
    ("none, no gap", _answer("no_gap"), lambda case: case.right),
    ("outside, unknown", _answer("unknown"), lambda case: case.right),
    (
        "outside, a name above 0.5",
        _answer("unknown"),
        lambda case: bool(case.diagnosis.effects) and case.diagnosis.effect_probability > NAMED_ABOVE,
    ),
    ("pair, both named", lambda case: len(case.answer.effects) > 1, lambda case: case.all_named),
    ("pair, one named", lambda case: len(case.answer.effects) > 1, lambda case: not case.misleading),
    ("rough, right name", _hidden(0.0, rough=True), lambda case: case.all_named),
    ("rough, none, no gap", _answer("no_gap", rough=True), lambda case: case.right),
    ("all, wrong above 0.8", lambda _: True, lambda case: case.misleading and case.diagnosis.probability > SURE_ABOVE),
    ("above 0.8, right", lambda case: case.diagnosis.probability > SURE_ABOVE, lambda case: case.right),
)
"""Each rate: its name, the cases that count, and what holds of them."""
_CONDITION_RATES = tuple(
    (name, lambda case, kind=kind: case.answer.case == kind, lambda case: case.right)
    for condition in ("incomplete", "programme", "exchanged", "model off", "noise", "motion")
    for name, kind in (
        (f"{condition}, right name", condition),
        (f"{condition}, none, no gap", f"{condition} none"),
        *(
            (f"{condition}, {size}, right", f"{condition} {size}")
            for size in ("third", "tenth")
            if condition == "motion"
        ),
    )
)
"""The same of campaigns under conditions, where an exam has such."""

SHARE_TOLERANCE = 0.1
PRESENCE_EDGES = (0.0, 0.1, 0.3, 0.5, 0.8, 0.95, 1.0)
UNEXPLAINED = "unexplained"


def budget_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return how often stated shares are the plant's own, and how often effects are there by their stated presence.

    A cause that is no effect of the catalogue should be `unexplained`; of inseparable causes the sum counts.
    """
    from dragrig.sim_backend.effects import catalogue

    known = {*catalogue(), "specimen", "model"}
    close, covered = [], []
    for case in cases:
        for stated in case.diagnosis.budget if case.budget else ():
            true_share = sum(
                part.share
                for part in case.budget
                if (part.cause if part.cause in known else UNEXPLAINED) in stated.names
                and stated.channel in {"", part.channel}
            )
            close.append(abs(stated.share - true_share) <= SHARE_TOLERANCE)
            if stated.share_95ci is not None:
                covered.append(stated.share_95ci[0] <= true_share <= stated.share_95ci[1])
    present = [
        (probability, name in case.answer.effects or name in case.answer.also_right)
        for case in cases
        for name, probability in case.diagnosis.presence.items()
    ]
    rates = [
        wilson_rate(f"budget, share within {SHARE_TOLERANCE:g}", close),
        wilson_rate("budget, share in its 95 % interval", covered),
    ]
    for low, high in pairwise(PRESENCE_EDGES):
        inside = [there for probability, there in present if low < probability <= high or probability == low == 0]
        rates.append(wilson_rate(f"presence {low:g} to {high:g}, there", inside))
    return tuple(rate for rate in rates if rate.count)


def withheld_rates(cases: Sequence[ScoredCase]) -> tuple[Rate, ...]:
    """Return how often the diagnosis is right when the true effect is removed from the catalogue."""
    single = [(case, case.without_true) for case in cases if case.without_true is not None and case.single]
    large = [(case, diagnosis) for case, diagnosis in single if case.answer.detectable]
    named = [bool(diagnosis.effects) and diagnosis.stated_probability > NAMED_ABOVE for _, diagnosis in large]
    small = [case.right_without_true for case, _ in single if not case.answer.detectable]
    return (
        wilson_rate("withheld, unknown, or its near-alias with doubt", [case.right_without_true for case, _ in large]),
        wilson_rate("withheld, unknown", [diagnosis.verdict == UNKNOWN for _, diagnosis in large]),
        wilson_rate("withheld, a name above 0.5", named),
        wilson_rate("withheld, a tenth: that, or no gap", small),
    )


@dataclass(frozen=True, slots=True)
class ConfusionMatrix:
    """Counts of campaigns."""

    hidden: tuple[str, ...]
    """Names of the rows: effects, then `several`, `unknown` (an effect that the catalogue does not have) and `no_gap`,
    as far as they occur.
    """
    predicted: tuple[str, ...]
    """Names of the columns, the diagnoses, likewise."""
    counts: tuple[tuple[int, ...], ...]
    """A row for each of `hidden`."""


def confusion_matrix(cases: Sequence[ScoredCase]) -> ConfusionMatrix:
    """Count the diagnoses of each answer."""
    counts = Counter((_class_name(case.answer), _class_name(case.diagnosis)) for case in cases)
    hidden = _effects_first({row for row, _ in counts})
    predicted = _effects_first({column for _, column in counts} | set(hidden))
    return ConfusionMatrix(
        hidden, predicted, tuple(tuple(counts[row, column] for column in predicted) for row in hidden)
    )


def _class_name(record: AnswerKey | ScoredDiagnosis) -> str:
    if len(record.effects) > 1:
        return SEVERAL
    return record.effects[0] if record.effects else record.verdict


def _effects_first(names: set[str]) -> tuple[str, ...]:
    last = (SEVERAL, UNKNOWN, NO_GAP)
    return (*sorted(names - set(last)), *(name for name in last if name in names))


@dataclass(frozen=True, slots=True)
class DetectionBin:
    """Single effects whose d′ lies from `low` to below `high`: any gap seen, the right name, and a misleading verdict.

    Campaigns whose nominal model is slightly wrong are left out.
    """

    low: float
    high: float
    seen: Rate
    named: Rate
    misled: Rate


def detection_bins(cases: Sequence[ScoredCase]) -> tuple[DetectionBin, ...]:
    """Return the bins that have cases."""
    single = [case for case in cases if case.single and not case.answer.nominal_slightly_wrong]
    bins = []
    for low, high in pairwise(D_PRIME_EDGES):
        inside = [case for case in single if case.d_prime is not None and low <= case.d_prime < high]
        if inside:
            seen = wilson_rate("a gap is seen", [case.diagnosis.verdict != NO_GAP for case in inside])
            named = wilson_rate("the right name", [case.all_named for case in inside])
            # An effect that is missed because it is too small misleads nobody.
            misled = wilson_rate("a wrong name", [bool(case.diagnosis.effects) and case.misleading for case in inside])
            bins.append(DetectionBin(low, high, seen, named, misled))
    return tuple(bins)


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Verdicts whose probability lies from `low` to `high`."""

    low: float
    high: float
    count: int
    right: int
    """`count`, `right`: number of verdicts, and how many of them are right."""
    probability: float
    """Mean stated probability."""
    band: tuple[float, float]
    """Share of right verdicts in 95 % of exams like this if every probability were true (binomial)."""
    share: float
    """Share that is right."""


@dataclass(frozen=True, slots=True)
class ProbabilityCalibration:
    """How good the probabilities are."""

    brier: float
    brier_base_rate: float
    brier_skill: float
    """`brier`, `brier_base_rate`, `brier_skill`: Brier score over all hypotheses; that of always stating how often each
    hypothesis is true in this exam; and `1 - brier / brier_base_rate`. NaN where there is nothing to compare.
    """
    verdict_brier: float
    verdict_brier_base_rate: float
    verdict_brier_skill: float
    """`verdict_brier`, `verdict_brier_base_rate`, `verdict_brier_skill`: the same of the verdict's own probability
    against always stating the share of right verdicts, which is the harder to beat the better a diagnosis is.
    """
    reliability: tuple[ReliabilityBin, ...]
    """The reliability diagram."""


def probability_calibration(cases: Sequence[ScoredCase]) -> ProbabilityCalibration:
    """Compare the probabilities of an exam with its outcomes."""
    truths = [case.answer.accepted for case in cases]
    # Where no_gap is accepted too, the hidden effect counts.
    hypotheses = Counter(sorted(truth - {NO_GAP} or truth)[0] for truth in truths)
    base_rates = {name: count / len(truths) for name, count in hypotheses.items()}
    stated = [{ranked.name: ranked.probability for ranked in case.diagnosis.ranking} for case in cases]
    brier = _mean([_brier_error(probabilities, truth) for probabilities, truth in zip(stated, truths, strict=True)])
    brier_base = _mean([_brier_error(base_rates, truth) for truth in truths])
    right = [case.right for case in cases]
    verdict_probabilities = [case.diagnosis.stated_probability for case in cases]
    share = _mean([float(holds) for holds in right])
    verdict_brier = _mean(
        [(probability - holds) ** 2 for probability, holds in zip(verdict_probabilities, right, strict=True)]
    )
    verdict_base = _mean([(share - holds) ** 2 for holds in right])
    return ProbabilityCalibration(
        brier,
        brier_base,
        1.0 - brier / brier_base if brier_base > 0 else nan,
        verdict_brier,
        verdict_base,
        1.0 - verdict_brier / verdict_base if verdict_base > 0 else nan,
        tuple(_reliability_bins(verdict_probabilities, right)),
    )


def _brier_error(probabilities: Mapping[str, float], truth: frozenset[str]) -> float:
    """Return the squared error over all hypotheses; those that are right count as one."""
    true_probability = sum(probability for name, probability in probabilities.items() if name in truth)
    false_squares = sum(probability**2 for name, probability in probabilities.items() if name not in truth)
    return (1.0 - true_probability) ** 2 + false_squares


def _reliability_bins(probabilities: Sequence[float], right: Sequence[bool]) -> Iterable[ReliabilityBin]:
    from scipy.stats import binom

    for low, high in pairwise(PROBABILITY_EDGES):
        inside = [
            (min(probability, 1.0), holds)
            for probability, holds in zip(probabilities, right, strict=True)
            if low < min(probability, 1.0) <= high or (probability <= 0 == low)
        ]
        if inside:
            count, mean = len(inside), _mean([probability for probability, _ in inside])
            band = (float(binom.ppf(0.025, count, mean)) / count, float(binom.ppf(0.975, count, mean)) / count)
            right_count = sum(holds for _, holds in inside)
            yield ReliabilityBin(low, high, count, right_count, mean, band, right_count / count)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else nan


@dataclass(frozen=True, slots=True)
class PromiseOutcome:
    """Share of the gap promised to close (from held-out runs), and the share that closes on fresh runs."""

    case: str
    promised: float
    interval: tuple[float, float] | None
    achieved: float
    right: bool


@dataclass(frozen=True, slots=True)
class PromiseScore:
    """All promises."""

    outcomes: tuple[PromiseOutcome, ...]
    """Campaigns whose diagnosis named an effect, with a gap to close on their own and on the fresh runs."""
    difference: float
    """Median of the absolute differences; NaN where there are none."""
    right_difference: float
    """The same over right names alone."""
    within: Rate
    """How many fresh runs lie in the promised 95 % interval. It is over the runs of one session: what differs between
    sessions and speeds comes on top.
    """
    closed: Rate
    """How many right names at full size and at a third close 90 % of the gap on fresh runs."""
    kept: Rate
    """How many right names at full size and at a third keep their promise on fresh runs."""


def promise_score(cases: Sequence[ScoredCase]) -> PromiseScore:
    """Compare promises with fresh runs."""
    outcomes, covered, closed, kept = [], [], [], []
    for case in cases:
        shrink, evaluation = case.diagnosis.shrink, case.achieved
        if not case.diagnosis.effects or evaluation is None:
            continue
        if case.all_named and case.answer.detectable and evaluation.verdict:
            kept.append(evaluation.verdict == "KEPT")
        achieved = evaluation.shrink
        if shrink is None or shrink.closed is None or achieved.closed is None:
            continue
        interval = shrink.closed_95ci
        outcomes.append(PromiseOutcome(case.name, shrink.closed, interval, achieved.closed, case.all_named))
        if interval is not None:
            covered.append(interval[0] <= achieved.closed <= interval[1])
        if case.all_named and case.answer.detectable:
            closed.append(achieved.closed >= CLOSED_SHARE)
    return PromiseScore(
        tuple(outcomes),
        _median_difference(outcomes),
        _median_difference([outcome for outcome in outcomes if outcome.right]),
        wilson_rate("achieved within the promised interval", covered),
        wilson_rate("right name, 90 % closed on fresh runs", closed),
        wilson_rate("right name, promise KEPT on fresh runs", kept),
    )


def _median_difference(outcomes: Sequence[PromiseOutcome]) -> float:
    return median(abs(outcome.promised - outcome.achieved) for outcome in outcomes) if outcomes else nan


@dataclass(frozen=True, slots=True)
class ExamScore:
    """How often a diagnosis is right."""

    rates: tuple[Rate, ...]
    """In the order of the table."""
    missed: tuple[ScoredCase, ...]
    """The cases whose verdict is not right."""
    confusion: ConfusionMatrix
    detection: tuple[DetectionBin, ...]
    calibration: ProbabilityCalibration
    promises: PromiseScore
    withheld: tuple[Rate, ...]
    """Rates where the true effect is removed from the catalogue."""

    def __getitem__(self, name: str) -> Rate:
        """Return the rate of that name."""
        return next(rate for rate in (*self.rates, *self.withheld) if rate.name == name)


def score_exam(
    pairs: Iterable[tuple[str, Mapping[str, object], Mapping[str, object]]],
    *,
    withheld: Mapping[str, Mapping[str, object]] | None = None,
    achieved: Mapping[str, Mapping[str, object]] | None = None,
    amounts: Mapping[str, float] | None = None,
    budgets: Mapping[str, Mapping[str, object]] | None = None,
) -> ExamScore:
    """Score diagnoses against the secrets.

    Parameters
    ----------
    pairs
        Name of the campaign, its answer, and the diagnosis as `dragrig gap diagnose --json` prints it.
    withheld
        Diagnoses without the true effect, by the campaign's name.
    achieved
        The output of `dragrig gap evaluate --json` on fresh runs, by the campaign's name.
    amounts
        d′ of the hidden effects, by the campaign's name.
    budgets
        The plant's own shares, by the campaign's name: `budget` with `cause`, `channel` and `share` of each cause.

    Raises
    ------
    AnalysisError
        When an answer or a diagnosis lacks a scored part.
    """
    without_true, fresh, d_primes = withheld or {}, achieved or {}, amounts or {}
    cases = [
        ScoredCase(
            name,
            _parse(AnswerKey, answer, name, "answer"),
            _parse(ScoredDiagnosis, diagnosis, name, "diagnosis"),
            _parse(ScoredDiagnosis, without_true[name], name, "diagnosis") if name in without_true else None,
            _parse(ScoredEvaluation, fresh[name], name, "evaluation") if name in fresh else None,
            d_primes.get(name),
            _parse(PlantBudget, (budgets or {}).get(name, {}), name, "budget").budget,
        )
        for name, answer, diagnosis in pairs
    ]
    return ExamScore(
        (*exam_rates(cases), *budget_rates(cases)),
        tuple(case for case in cases if not case.right),
        confusion_matrix(cases),
        detection_bins(cases),
        probability_calibration(cases),
        promise_score(cases),
        withheld_rates(cases),
    )


RecordT = TypeVar("RecordT", AnswerKey, PlantBudget, ScoredDiagnosis, ScoredEvaluation)


def _parse(kind: type[RecordT], content: object, name: str, noun: str) -> RecordT:
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise AnalysisError(
            f"{name}: the {noun} cannot be scored because {place} is not as the report's format has it "
            f"({first['msg'].lower()}); make it anew"
        ) from error
