"""A comparison in the few sentences that a person at the rig needs."""

from collections.abc import Iterable, Iterator, Sequence
from math import sqrt

from dragrig.analysis.comparison.measured import Verdict
from dragrig.analysis.comparison.results import Comparison, Following, GroupDifference, Pair
from dragrig.analysis.comparison.spread import FORCE_FREE_AT_REST
from dragrig.analysis.estimates import NORMAL_95

BY_CHANCE = 0.05
NOTED_LAG_S = 0.0005
NOTED_MM = 0.01
"""Following errors below both are not worth a sentence."""


def sentences_of(comparison: Comparison) -> tuple[str, ...]:
    """Say what was compared, whether it differs, where most, and what each kind of run says."""
    return (
        _how_many(comparison),
        *_judgement(comparison),
        *_largest(comparison.groups),
        *(_of_measure(name, groups) for name, groups in _by_measure(comparison.groups)),
        *_motion(comparison.pairs),
        *_zero(comparison),
    )


def _how_many(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    if comparison.b.is_model:
        return (
            f"{count} run{_s(count)} of A ({comparison.a.name}) against the friction model, on the recorded motion (B)."
        )
    alone = ((comparison.alone_a, "A"), (comparison.alone_b, "B"))
    said = " and ".join(f"{len(found)} of {name}" for found, name in alone if found)
    without = f"; without a partner: {said}" if said else ""
    return f"{count} pair{_s(count)} of runs, A from {comparison.a.name}, B from {comparison.b.name}{without}."


def _judgement(comparison: Comparison) -> Iterator[str]:
    told = [one for pair in comparison.pairs for one in pair.main if one.verdict is not Verdict.UNKNOWN]
    if not told:
        yield "No force of any pair can be told, so that nothing can be said of the difference."
        return
    beyond = sum(one.verdict is Verdict.BEYOND for one in told)
    words = "noise and run-to-run scatter explain"
    names = list(dict.fromkeys(one.measure.removesuffix(" force") for one in told))
    forces = f"{', '.join(names)} force{_s(len(told))}"
    chance = BY_CHANCE * len(told)
    expected = f"; of equal runs about {chance:.0f} would" if chance >= 1 else ""
    if beyond == 0:
        yield f"None of {len(told)} {forces} differs by more than {words}."
    else:
        yield f"{beyond} of {len(told)} {forces} differ{'s' if beyond == 1 else ''} by more than {words}{expected}."


def _largest(groups: Sequence[GroupDifference]) -> Iterator[str]:
    if len(groups) > 1 and groups[0].verdict is Verdict.BEYOND:
        one = groups[0]
        yield (
            f"Clearest: {one.condition}, {one.measure} {one.a:.1f} against {one.b:.1f} mN, "
            f"{one.value:+.1f} ± {NORMAL_95 * one.error:.1f} mN{_percent(one.relative)}."
        )


def _of_measure(name: str, groups: Sequence[GroupDifference]) -> str:
    beyond = [one for one in groups if one.verdict is Verdict.BEYOND]
    mean = sum(one.value for one in groups) / len(groups)
    error = sqrt(sum(one.error**2 for one in groups)) / len(groups)
    level = [one.relative for one in groups if one.relative is not None and abs(one.a) > NORMAL_95 * one.error]
    percent = _percent(sum(level) / len(level)) if level else ""
    if not beyond:
        if abs(mean) > NORMAL_95 * error:
            return f"{name}: no condition differs by itself, but all together B is {_off(mean)} on average{percent}."
        return f"{name}: no difference beyond noise and scatter; on average {mean:+.1f} ± {NORMAL_95 * error:.1f} mN."
    values = [one.value for one in beyond]
    count = f"in {len(beyond)} of {len(groups)} conditions" if len(groups) > 1 else f"{_where(beyond)}"
    if min(values) > 0 or max(values) < 0:
        low, high = sorted(values, key=abs)[0], sorted(values, key=abs)[-1]
        span = f"{abs(high):.1f}" if len(values) == 1 else f"{abs(low):.1f} to {abs(high):.1f}"
        average = f"; {mean:+.1f} mN on average" if len(groups) > 1 else ""
        side = "above" if high > 0 else "below"
        return f"{name}: B lies {side} A {count}, by {span} mN{average}{percent}."
    above, below = ([one for one in beyond if one.value * sign > 0] for sign in (1, -1))
    return (
        f"{name}: B lies above A {_where(above)}, by up to {max(values):.1f} mN, and below it {_where(below)}, "
        f"by up to {-min(values):.1f} mN."
    )


def _where(groups: Sequence[GroupDifference]) -> str:
    """Say at which speeds or strains some conditions lie: at 0.5 to 2 mm/s."""
    strains = [100 * one.condition.shear_strain for one in groups if one.condition.shear_strain is not None]
    speeds = [one.condition.speed_mm_s for one in groups if one.condition.speed_mm_s is not None]
    values, unit = (strains, "%") if strains else (speeds, "mm/s")
    if not values:
        return f"in {len(groups)}"
    low, high = min(values), max(values)
    return f"at {low:.3g} {unit}" if low == high else f"at {low:.3g} to {high:.3g} {unit}"


def _off(mean: float) -> str:
    return f"{abs(mean):.1f} mN {'above' if mean > 0 else 'below'} A"


def _by_measure(groups: Iterable[GroupDifference]) -> Iterator[tuple[str, list[GroupDifference]]]:
    """Gather the groups of one kind and measure, in the order in which the first of them comes."""
    found: dict[str, list[GroupDifference]] = {}
    for one in groups:
        found.setdefault(f"{one.condition.kind}, {one.measure}", []).append(one)
    yield from found.items()


def _motion(pairs: Sequence[Pair]) -> Iterator[str]:
    for name, found in (("A", [pair.motion.a for pair in pairs]), ("B", [pair.motion.b for pair in pairs])):
        followed = [one for one in found if one is not None]
        if followed:
            sentence = _following(name, followed)
            if sentence:
                yield sentence


def _following(name: str, followed: Sequence[Following]) -> str:
    largest = max((one.largest_mm for one in followed), key=abs)
    lags = sorted(one.lag_s for one in followed if one.lag_s is not None)
    lag = lags[len(lags) // 2] if lags else 0.0
    if abs(largest) < NOTED_MM and abs(lag) < NOTED_LAG_S:
        return ""
    late = f" and comes {1e3 * abs(lag):.1f} ms {'late' if lag > 0 else 'early'}" if abs(lag) >= NOTED_LAG_S else ""
    return f"Motion of {name}: the position strays from the command by up to {abs(largest):.3g} mm{late}."


def _zero(comparison: Comparison) -> Iterator[str]:
    kinds = sorted({pair.condition.kind for pair in comparison.pairs} - FORCE_FREE_AT_REST)
    if kinds:
        yield (
            f"Zeros of {' and '.join(kinds)} runs are not taken off, for their rest is not free of force; "
            f"{comparison.zero_mN:.1f} mN a run is allowed for them."
        )


def _percent(relative: float | None) -> str:
    return "" if relative is None else f" ({100 * relative:+.0f} %)"


def _s(count: int) -> str:
    return "" if count == 1 else "s"
