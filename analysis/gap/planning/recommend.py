"""The next run after a diagnosis: quick, from a dozen runs and the leading hypotheses."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.design import Design
from dragrig.analysis.gap.judging import NO_GAP, UNKNOWN
from dragrig.analysis.gap.planning.contests import Ground, Question, Truth
from dragrig.analysis.gap.planning.force import search_in_force
from dragrig.analysis.gap.planning.imagined import specimen_of
from dragrig.analysis.gap.planning.results import NextExperiment, NextRun
from dragrig.analysis.gap.planning.search import UNBOUNDED, Budget
from dragrig.analysis.gap.planning.trials import Limits, few, many
from dragrig.analysis.gap.planning.words import why
from dragrig.analysis.gap.ranking import Ranked
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.gap.study import Study

LEADING = 3
SURE = 0.9
"""Below this probability of what is named, runs go on where the contests alone seem decided: these know the catalogue's
forms only."""
LEAST_WEIGHT = 0.05
"""A leading effect counts for so much however improbable it is."""


def recommend(
    study: Study,
    design: Design,
    ranked: Sequence[Ranked],
    probabilities: Mapping[str, float],
    budget: Budget,
    *,
    gap: bool,
) -> NextExperiment | None:
    """Recommend one run, from a dozen, or several from the whole grid.

    Parameters
    ----------
    design
        The campaign's around the nominal model, with the dictionary.
    ranked
        The best shape of each effect.
    probabilities
        Of hypotheses; several effects joined with `+`.
    budget
        How many runs, and how much rig time they may take.
    gap
        Whether there is a gap; if not, the run is one that would show smaller effects.

    Returns
    -------
    None where the nominal model is not the friction model, or no run would help.
    """
    if not isinstance(study, CapsuleStudy):
        return None
    asked = questions(study, design, ranked, probabilities, gap=gap)
    specimen = specimen_of(study)
    grid = few(specimen) if budget.runs == 1 else many(specimen)
    limits = budget.limits or limits_of(study)
    trials = [one for one in grid if limits.allow(one)]
    if not asked or not trials:
        return None
    sure = max((value for name, value in probabilities.items() if name not in (NO_GAP, UNKNOWN)), default=0.0) > SURE
    wanted = replace(budget, spent_whole=not sure) if gap else replace(budget, enough=UNBOUNDED)
    return experiment_of(search_in_force(study, design, asked, trials, wanted), len(trials))


def experiment_of(found: Sequence[NextRun], tried: int) -> NextExperiment | None:
    """Return what was found with its reason; None where nothing was."""
    return NextExperiment(tuple(found), tried, why(found[0], tried)) if found else None


def questions(
    study: Study, design: Design, ranked: Sequence[Ranked], probabilities: Mapping[str, float], *, gap: bool
) -> tuple[Question, ...]:
    """Return what a campaign leaves open between its leading hypotheses."""
    chances = {one.effect: chance_of(one.effect, probabilities) for one in ranked if one.gain > 0 or not gap}
    if gap:
        order = sorted(chances, key=lambda name: -chances[name])[:LEADING]
    else:
        periodic = {one.id for one in study.effects if one.phase is not None}
        order = [name for name in chances if name not in periodic]
    known = {one.effect: one for one in ranked}
    ground = Ground.of(design, [one.id for one in study.effects if one.id in order])
    truths = {name: _truth(ground, design, known[name], gap=gap) for name in order}
    return tuple(_asked(truths, {name: max(chances[name], LEAST_WEIGHT) for name in order}, gap=gap))


def limits_of(study: Study) -> Limits:
    """Return what a campaign's own runs say that the rig can do, the shipped plans' at least."""
    usual = Limits()
    travel = max(float(np.max(one.coordinates.position_mm)) for one in study.sights)
    speed = max(float(np.max(one.coordinates.top_speed_mm_s)) for one in study.sights)
    return Limits(max(usual.travel_mm, travel), max(usual.speed_mm_s, speed), usual.accel_mm_s2)


def _asked(truths: Mapping[str, Truth], weights: Mapping[str, float], *, gap: bool) -> Iterator[Question]:
    if not gap:
        for name, truth in truths.items():
            yield Question(truth, "", weights[name])
        return
    for one, other in permutations(truths, 2):
        yield Question(truths[one], other, weights[one] * weights[other])
    if len(truths) == 1:
        for name, truth in truths.items():
            yield Question(truth, "", weights[name])


def chance_of(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return how probable an effect is, alone or with others."""
    return sum(value for name, value in probabilities.items() if effect in name.split("+"))


def _truth(ground: Ground, design: Design, one: Ranked, *, gap: bool) -> Truth:
    """Return an effect as it was fitted; without a gap, as large as it would just be seen."""
    own = [place for place, shape in enumerate(design.shapes) if shape.effect.id == one.effect]
    before = [place for place, shape in enumerate(ground.shapes) if shape.effect.id == one.effect]
    columns = tuple(before[own.index(place)] for place in one.shapes)
    if gap:
        return Truth(one.effect, columns, one.amplitude)
    amplitude = np.zeros(len(columns))
    amplitude[0] = SEEN / max(one.per_unit, 1e-9)
    return Truth(one.effect, columns, amplitude)
