"""Whether probabilities mean what they say."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from dragrig.gap_scoring.records import Case

EDGES = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class Bin:
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
class Calibration:
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
    bins: tuple[Bin, ...]


def calibration(cases: Sequence[Case]) -> Calibration:
    """Judge the probabilities of an exam."""
    truths = [one.answer.accepted for one in cases]
    base = _base(truths)
    told = [{each.name: each.probability for each in one.said.ranking} for one in cases]
    brier = _mean([_squares(one, truth) for one, truth in zip(told, truths, strict=True)])
    brier_base = _mean([_squares(base, truth) for truth in truths])
    right = [one.right for one in cases]
    stated = [one.said.stated for one in cases]
    share = _mean([float(one) for one in right])
    verdict = _mean([(each - held) ** 2 for each, held in zip(stated, right, strict=True)])
    verdict_base = _mean([(share - held) ** 2 for held in right])
    bins = tuple(_bins(stated, right))
    return Calibration(brier, brier_base, _skill(brier, brier_base), verdict, verdict_base,
                       _skill(verdict, verdict_base), bins)  # fmt: skip


def _base(truths: Sequence[frozenset[str]]) -> dict[str, float]:
    """Return how often each hypothesis is true; one that is right beside another counts for what is hidden."""
    names = Counter(sorted(one - {"no_gap"} or one)[0] for one in truths)
    return {name: count / len(truths) for name, count in names.items()}


def _squares(told: dict[str, float], truth: frozenset[str]) -> float:
    """Return the squared error over all hypotheses; those that are right count as one."""
    on_truth = sum(probability for name, probability in told.items() if name in truth)
    others = sum(probability**2 for name, probability in told.items() if name not in truth)
    return (1.0 - on_truth) ** 2 + others


def _bins(stated: Sequence[float], right: Sequence[bool]) -> list[Bin]:
    made = []
    for low, high in pairwise(EDGES):
        there = [at for at, one in enumerate(stated) if low < min(one, 1.0) <= high or (one <= 0 == low)]
        if there:
            mean = _mean([min(stated[at], 1.0) for at in there])
            made.append(Bin(low, high, len(there), sum(right[at] for at in there), mean, _band(len(there), mean)))
    return made


def _band(count: int, probability: float) -> tuple[float, float]:
    from scipy.stats import binom

    return tuple(float(binom.ppf(tail, count, probability)) / count for tail in (0.025, 0.975))  # type: ignore[return-value]


def _skill(error: float, base: float) -> float:
    return 1.0 - error / base if base > 0 else float("nan")


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else float("nan")
