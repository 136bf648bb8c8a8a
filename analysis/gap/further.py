"""Further effects beside those that explain most of a gap."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.doubting import doubting
from dragrig.analysis.gap.explanation import Explanation, explained, refitted, with_free_phases
from dragrig.analysis.gap.findings import Findings, Step
from dragrig.analysis.gap.nameless import nameless
from dragrig.analysis.gap.ranking import Ranked, rank
from dragrig.analysis.gap.refit import Point
from dragrig.analysis.gap.solving import NUISANCES, project

MOST_EFFECTS = 3
LEAST_GAIN = 11.0
"""Half squares below this are noise beside other effects."""
NEAR_SECOND = 0.2
"""Beside the best further effect, one of another kind is tried that takes away this share of what it does."""


def further_steps(found: Findings) -> list[Step]:
    """Take up one effect after another beside the best single one."""
    steps: list[Step] = []
    before: Explanation | None = found.singles[0]
    while before is not None and len(before.effects) < MOST_EFFECTS:
        tried = _steps(found, before)
        steps += tried
        before = tried[0].together if tried else None
    return steps


def _steps(found: Findings, before: Explanation) -> list[Step]:
    """Try the best further effect beside those before, and the best of those that act on something else."""
    point = before.point
    _, design, taken = explained(found.study, point, found.nominal, before.design, everything=True)
    doubted = doubting(design)
    projected = project(doubted, doubted.total(), *NUISANCES)
    for number in range(len(taken)):
        projected = projected.without((taken[number],))
    own = {one.effect.id for one in point.candidates}
    everything = with_free_phases(doubted, rank(projected, doubted.shapes))
    ranked = [one for one in everything if one.effect not in own]
    steps = []
    for one in (*ranked[:1], *_of_another_kind(ranked, doubted, point)):
        rival = max((each.gain for each in ranked if each is not one), default=0.0)
        together = refitted(found.study, design, one, found.nominal) if one.gain > LEAST_GAIN else None
        steps.append(Step(one.effect, one.gain, rival, projected.squares, (), together))
    if all(one.together is None for one in steps):
        return steps
    beside = np.sort(np.concatenate((doubted.of(*NUISANCES), doubted.of(Part.SHAPE)[list(taken)])))
    laws = nameless(doubted, found.study.sights, beside=beside)
    return [replace(one, laws=laws) for one in steps]


def _of_another_kind(ranked: Sequence[Ranked], design: Design, point: Point) -> tuple[Ranked, ...]:
    """Return the best of what is neither a function of the same as the best one nor as those before."""
    domains = {one.effect.id: one.effect.domain for one in design.shapes}
    seen = {one.effect.domain for one in point.candidates} | {domains[one.effect] for one in ranked[:1]}
    others = [one for one in ranked[1:] if domains[one.effect] not in seen]
    return tuple(one for one in others[:1] if one.gain > NEAR_SECOND * ranked[0].gain)
