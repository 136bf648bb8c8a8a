"""What the pairs of one condition say together."""

from collections.abc import Iterable, Sequence
from math import sqrt

import numpy as np

from dragrig.analysis.comparison.conditions import Condition
from dragrig.analysis.comparison.measured import Difference, main_measures
from dragrig.analysis.comparison.results import GroupDifference, Pair

FEWEST_FOR_SCATTER = 3
"""Pairs whose own scatter says something of the error of their mean."""
CLEARLY = 3.0
"""Standard errors that a force must have for a difference to be told as a share of it."""


def grouped(pairs: Iterable[Pair]) -> tuple[GroupDifference, ...]:
    """Average the main measures of the pairs of one condition; the largest differences, in standard errors, first."""
    groups: list[list[Pair]] = []
    for pair in pairs:
        home = next((one for one in groups if not one[0].condition.differs_from(pair.condition)), None)
        if home is None:
            groups.append([pair])
        else:
            home.append(pair)
    found = [one for group in groups for one in _of_group(group)]
    return tuple(sorted(found, key=lambda one: one.times_error, reverse=True))


def _of_group(group: Sequence[Pair]) -> list[GroupDifference]:
    squares = [(one.samples, one.rms_mN) for pair in group for one in pair.phases if one.phase == "all"]
    samples = sum(count for count, _ in squares)
    rms = sqrt(sum(count * value**2 for count, value in squares) / samples) if samples else None
    condition = group[0].condition
    found = []
    for name in main_measures(condition.kind):
        told = [one for pair in group for one in pair.differences if one.measure == name and one.noise is not None]
        if told:
            found.append(_mean(condition, told, rms))
    return found


def _mean(condition: Condition, told: Sequence[Difference], rms_mN: float | None) -> GroupDifference:
    count = len(told)
    values = np.array([one.value or 0.0 for one in told])
    noise = sqrt(sum((one.noise or 0.0) ** 2 for one in told)) / count
    error = sqrt(sum((one.error or 0.0) ** 2 for one in told)) / count
    if count >= FEWEST_FOR_SCATTER:
        error = max(error, float(values.std(ddof=1)) / sqrt(count))
    a = float(np.mean([one.compared[0] or 0.0 for one in told]))
    mean = float(values.mean())
    return GroupDifference(
        condition=condition,
        measure=told[0].measure,
        pairs=count,
        a=a,
        b=a + mean,
        value=mean,
        noise=noise,
        error=error,
        relative=mean / abs(a) if abs(a) > CLEARLY * error else None,
        rms_mN=rms_mN,
    )
