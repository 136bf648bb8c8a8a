"""What is said of an effect that was taken out of the catalogue."""

from collections.abc import Sequence

from dragrig.gap_scoring.rates import NAMED, Rate, rate
from dragrig.gap_scoring.records import SMALL, Case
from dragrig.sim_backend.effects.catalogue import near_aliases


def withheld_rates(cases: Sequence[Case]) -> tuple[Rate, ...]:
    """Return how often that is right, and how often another effect is named without doubt."""
    asked = [one for one in cases if one.withheld is not None and len(one.answer.effects) == 1]
    large = [one for one in asked if one.answer.least >= SMALL]
    return (
        rate("withheld, unknown, or its near-alias with doubt", [doubted(one) for one in large]),
        rate("withheld, unknown", [one.withheld is not None and one.withheld.verdict == "unknown" for one in large]),
        rate("withheld, a name above 0.5", [_named(one) for one in large]),
        rate("withheld, a tenth: that, or no gap", [doubted(one) for one in asked if one.answer.least < SMALL]),
    )


def doubted(case: Case) -> bool:
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
        return case.answer.least < SMALL
    alias = set(said.effects) <= near_aliases(case.answer.effects[0])
    return alias and (said.stated < NAMED or bool(said.confusable_with))


def _named(case: Case) -> bool:
    return case.withheld is not None and bool(case.withheld.effects) and case.withheld.stated > NAMED
