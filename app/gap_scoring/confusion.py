"""What was said against what was hidden."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from dragrig.gap_scoring.records import Case

SEVERAL, UNKNOWN, NO_GAP = "several", "unknown", "no_gap"


@dataclass(frozen=True, slots=True)
class Confusion:
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


def confusion(cases: Sequence[Case]) -> Confusion:
    """Count what was said of what."""
    met = Counter((_name(one.answer.effects, one.answer.verdict), _name(one.said.effects, one.said.verdict))
                  for one in cases)  # fmt: skip
    hidden = _in_order({row for row, _ in met})
    said = _in_order({column for _, column in met} | set(hidden))
    return Confusion(hidden, said, tuple(tuple(met[row, column] for column in said) for row in hidden))


def _name(effects: Sequence[str], verdict: str) -> str:
    if len(effects) > 1:
        return SEVERAL
    return effects[0] if effects else verdict


def _in_order(names: set[str]) -> tuple[str, ...]:
    last = (SEVERAL, UNKNOWN, NO_GAP)
    return (*sorted(names - set(last)), *(one for one in last if one in names))
