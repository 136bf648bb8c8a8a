"""Which runs of two sides belong together: those in which the same was done, repeats in order."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dragrig.analysis.comparison.conditions import Condition
from dragrig.analysis.identification.results import LeftOut


@dataclass(frozen=True, slots=True)
class Candidate:
    """A run to be paired: its file, what was done in it, on which specimen."""

    file: str
    condition: Condition
    specimen: str


@dataclass(frozen=True, slots=True)
class Pairing:
    """Places of the runs that belong together, in the order of A, and which have no partner, and why."""

    pairs: tuple[tuple[int, int], ...]
    alone_a: tuple[LeftOut, ...]
    alone_b: tuple[LeftOut, ...]


def pair_up(a: Sequence[Candidate], b: Sequence[Candidate]) -> Pairing:
    """Pair runs of the same condition; a run on the same specimen is preferred, then the one that comes first."""
    partner: dict[int, int] = {}
    _match(a, b, partner, lambda one, other: one.specimen == other.specimen)
    _match(a, b, partner, lambda _one, _other: True)
    taken = set(partner.values())
    return Pairing(
        pairs=tuple(sorted(partner.items())),
        alone_a=tuple(LeftOut(one.file, _why(one, b, "B")) for at, one in enumerate(a) if at not in partner),
        alone_b=tuple(LeftOut(one.file, _why(one, a, "A")) for at, one in enumerate(b) if at not in taken),
    )


def _match(
    a: Sequence[Candidate],
    b: Sequence[Candidate],
    partner: dict[int, int],
    may: Callable[[Candidate, Candidate], bool],
) -> None:
    taken = set(partner.values())
    for at, one in enumerate(a):
        if at in partner:
            continue
        for place, other in enumerate(b):
            if place not in taken and may(one, other) and not one.condition.differs_from(other.condition):
                partner[at] = place
                taken.add(place)
                break


def _why(one: Candidate, others: Sequence[Candidate], side: str) -> str:
    """Say why a run has no partner: no such runs, all of them taken, or what differs in the nearest."""
    if not others:
        return f"{side} has no run that can be compared"
    alike = [(other, one.condition.differs_from(other.condition)) for other in others]
    same = [other for other, differs in alike if not differs]
    if same:
        return f"{side} has only {len(same)} run{'' if len(same) == 1 else 's'} like it, and the others come first"
    nearest, differs = min(alike, key=lambda pair: (pair[0].condition.kind != one.condition.kind, len(pair[1])))
    if nearest.condition.kind != one.condition.kind:
        return f"{side} has no {one.condition.kind} run"
    return f"{side} has no {one.condition} like it; nearest is {nearest.file}: {', '.join(differs)}"
