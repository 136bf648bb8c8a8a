"""The measures of two runs side by side."""

from collections.abc import Iterator
from math import sqrt

from dragrig.analysis.comparison.conditions import Condition
from dragrig.analysis.comparison.measured import ABOVE_REST, HOLD, PEAK, REST, SPEED, STEADY, Difference
from dragrig.analysis.comparison.spread import FORCE_FREE_AT_REST, relative_spread
from dragrig.analysis.estimates import Estimate
from dragrig.analysis.measures import RunMeasures

Measured = tuple[RunMeasures, RunMeasures]


def differences(measured: Measured, condition: Condition, zero_mN: float, recorded: int) -> tuple[Difference, ...]:
    """Subtract the measures of A from those of B.

    Parameters
    ----------
    zero_mN
        Standard deviation of a sensor's unknown zero, allowed for where the rest does not show it.
    recorded
        How many of the two were recorded, 2 or 1: what the model says scatters by nothing.
    """
    return tuple(_differences(measured, condition, zero_mN, sqrt(recorded)))


def _differences(measured: Measured, condition: Condition, zero_mN: float, factor: float) -> Iterator[Difference]:
    one, other = measured
    free = condition.kind in FORCE_FREE_AT_REST
    share = relative_spread(condition)
    rests = one.rest_offset, other.rest_offset
    for name, a, b in (
        (STEADY, one.steady_force, other.steady_force),
        (PEAK, one.peak_force, other.peak_force),
        (HOLD, one.hold_force, other.hold_force),
    ):
        # Nothing slides in a relaxation, and the extreme of a blank run is that of its noise.
        if (condition.kind, name) in {("relaxation", STEADY), ("blank", PEAK)}:
            continue
        yield _force(name, (a, b), rests if free else None, share, zero_mN, factor)
    if not free:
        yield _force(ABOVE_REST, (one.steady_force, other.steady_force), rests, share, zero_mN, factor)
    yield _force(REST, rests, None, 0.0 if free else share, zero_mN, factor)
    yield _difference(SPEED, "mm/s", (one.speed, other.speed), 0.0)


def _force(
    name: str,
    values: tuple[Estimate, Estimate],
    rests: tuple[Estimate, Estimate] | None,
    share: float,
    zero_mN: float,
    factor: float,
) -> Difference:
    if rests is None or any(rest.value is None for rest in rests):
        return _difference(name, "mN", values, factor * _spread(values, share, zero_mN))
    return _difference(name, "mN", values, factor * _spread(_less(values, rests), share, 0.0), rests)


def _spread(values: tuple[Estimate, Estimate], share: float, zero_mN: float) -> float:
    size = sum(abs(one.value or 0.0) for one in values) / 2
    return sqrt((share * size) ** 2 + zero_mN**2)


def _less(values: tuple[Estimate, Estimate], rests: tuple[Estimate, Estimate]) -> tuple[Estimate, Estimate]:
    a, b = (
        Estimate(None if one.value is None else one.value - (rest.value or 0.0))
        for one, rest in zip(values, rests, strict=True)
    )
    return a, b


def _difference(
    name: str,
    unit: str,
    values: tuple[Estimate, Estimate],
    spread: float,
    rests: tuple[Estimate, Estimate] | None = None,
) -> Difference:
    a, b = values
    zero_a, zero_b = ((rest.value or 0.0) for rest in rests) if rests is not None else (0.0, 0.0)
    zeros = (zero_a, zero_b) if rests is not None else None
    if a.value is None or b.value is None:
        lacking = [f"{side}: {one.reason}" for side, one in (("A", a), ("B", b)) if one.value is None]
        return Difference(name, unit, a, b, zeros, spread=spread, reason="; ".join(lacking))
    value = (b.value - zero_b) - (a.value - zero_a)
    errors = [one.standard_error for one in (*values, *(rests or ()))]
    known = [error for error in errors if error is not None]
    if len(known) < len(errors):
        return Difference(name, unit, a, b, zeros, value, None, spread, "the error of one of them is not known")
    return Difference(name, unit, a, b, zeros, value, sqrt(sum(error**2 for error in known)), spread)
