"""The next run where the position strays: what further motions would say of the effects that it may be.

As a diagnosis does, errors are explained by free forms of every effect, judged on runs that took no part. The errors of
further runs are predicted with each leading effect as it was fitted, one after the other taken for true.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Self

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.judging import LEAST_POSITION, POSITION_RIVAL, UNKNOWN
from dragrig.analysis.gap.planning.coverage import search_uncovered
from dragrig.analysis.gap.planning.imagined import experiments_after, specimen_of
from dragrig.analysis.gap.planning.recommend import LEADING, LEAST_WEIGHT, chance_of, experiment_of, limits_of
from dragrig.analysis.gap.planning.results import Contest, NextExperiment
from dragrig.analysis.gap.planning.search import ENOUGH, Answer, Budget, search
from dragrig.analysis.gap.planning.trials import moves
from dragrig.analysis.gap.position.errors import PositionErrors, position_errors
from dragrig.analysis.gap.position.families import Family, families
from dragrig.analysis.gap.position.finding import PositionFinding, fitted, strayed
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import EncoderEffect, MotorEffect
from dragrig.sim_backend.effects.catalogue import catalogue

LEAST_LEFT = 0.0025
"""A rival that leaves less of the errors than this is told from the truth by chance alone."""
LEAST_TAKEN = 0.5
"""An effect of which the catalogue's form takes less of the errors than this is not what strays."""
MOST_MOTIONS, MOST_RUNS = 6, 3
"""So many motions of a campaign are taken for all of it, and so many further ones recommended at most."""
EVERY = 3
"""One block of so many is looked at: more cost time and tell nothing more here."""
CLEAR = 0.9
"""An effect that explains so much of the errors is named without doubt."""


@dataclass(frozen=True, slots=True, eq=False)
class Straying:
    """An effect of the position as it was fitted: of the catalogue, or the command at another time."""

    effect: str
    candidate: Candidate | None
    latency_s: float

    def error_of(self, one: PositionErrors) -> FloatArray:
        """Return what it makes of a run, shape `(B,)` [mm]."""
        if self.candidate is not None:
            return strayed(self.candidate, one)
        return one.from_zero(one.delayed(self.latency_s) - one.delayed(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PositionField:
    """Motions that were made, and which effects of the position they are to set apart.

    Attributes
    ----------
    runs
        Runs with different motions; their errors are not looked at.
    truths
        Effects that may be there.
    weights
        How much it matters to set a truth apart from a rival.
    """

    runs: tuple[PositionErrors, ...]
    truths: tuple[Straying, ...]
    weights: Mapping[tuple[str, str], float]

    def with_run(self, seen: Sequence[PositionErrors]) -> Self:
        """Add a run by its motion, as often as it is made."""
        return replace(self, runs=(*self.runs, *seen))

    def answers(self) -> tuple[Answer, ...]:
        """Return how far each truth would be set apart from each rival if it were what strays."""
        return tuple(answer for truth in self.truths for answer in self._of(truth))

    def _of(self, truth: Straying) -> Iterator[Answer]:
        rivals = [other for one, other in self.weights if one == truth.effect]
        runs = [replace(one, error_mm=truth.error_of(one)) for one in self.runs]
        size = float(np.sqrt(sum(np.mean(one.error_mm**2) for one in runs)))
        explained = {one.effect: one.held_out for one in families(runs, (truth.effect, *rivals))}
        for rival in rivals:
            left = min(max(explained[truth.effect] - explained[rival], 0.0), 1.0)
            contest = Contest(truth.effect, rival, SEEN * size / self.runs[0].least_mm * float(np.sqrt(left)), left)
            yield Answer(contest, _log_odds(contest, explained[truth.effect]), self.weights[truth.effect, rival])


def _log_odds(one: Contest, explained: float) -> float:
    """Return about how sure a diagnosis can be of the truth, which explains a share of the errors by its free form."""
    against = POSITION_RIVAL * max(one.left - LEAST_LEFT, 0.0)
    named = ENOUGH * (explained - LEAST_POSITION) / (CLEAR - LEAST_POSITION)
    sure = min(against, named)
    return sure if sure < ENOUGH else ENOUGH + log(max(one.d_prime, 1.0))


def recommend_in_position(
    study: Study, position: PositionFinding, probabilities: Mapping[str, float], budget: Budget
) -> NextExperiment | None:
    """Recommend the run that best separates the leading effects of the position per minute of rig time, or several.

    Where no effect is likelier than `unknown`, it is the run that goes furthest beyond how the stage has moved so far.

    Parameters
    ----------
    position
        What strays.
    probabilities
        Of hypotheses; several effects joined with `+`.

    Returns
    -------
    None where the nominal model is not the friction model, or no run would help.
    """
    if not isinstance(study, CapsuleStudy):
        return None
    limits = budget.limits or limits_of(study)
    trials = [one for one in moves(specimen_of(study), whole=budget.runs > 1) if limits.allow(one)]
    last = position.runs[-1]
    seen = position_errors(experiments_after(last.experiment, trials))
    tried = list(zip(trials, (replace(one, session_s=last.session_s) for one in seen), strict=True))
    chances = {one.effect: chance_of(one.effect, probabilities) for one in position.families}
    if not tried:
        return None
    if max(chances.values(), default=0.0) <= probabilities.get(UNKNOWN, 0.0):
        return search_uncovered(position, tried, budget)
    leading = {one.effect: _straying(position, one) for one in position.families[:LEADING]}
    truths = tuple(one for one in leading.values() if one is not None)
    matter = {name: max(chances[name], LEAST_WEIGHT) for name in leading}
    pairs = [(one.effect, rival) for one in truths for rival in leading if rival != one.effect]
    made = tuple(map(_thinned, _distinct(position.runs)))
    field = PositionField(made, truths, {pair: matter[pair[0]] * matter[pair[1]] for pair in pairs})
    may_see = [(trial, (_thinned(one),) * trial.step.repeats) for trial, one in tried]
    within = replace(budget, runs=min(budget.runs, MOST_RUNS))
    return experiment_of(search(field, may_see, within), len(tried))


def _straying(position: PositionFinding, family: Family) -> Straying | None:
    """Return an effect as it was fitted; None where it cannot be what strays, for it takes hardly any of it."""
    effect = catalogue()[family.effect]
    by_form = isinstance(effect, MotorEffect | EncoderEffect)
    runs = _distinct(position.runs)
    candidate = position.candidate
    if candidate is None or candidate.effect.id != family.effect:
        candidate = fitted(runs, effect, family)[0] if by_form else None
    found = Straying(family.effect, candidate, family.shape)
    left = [
        float(np.mean((one.error_mm - found.error_of(one)) ** 2)) / (one.rms_mm + one.count_mm) ** 2 for one in runs
    ]
    whole = [float(np.mean(one.error_mm**2)) / (one.rms_mm + one.count_mm) ** 2 for one in runs]
    return found if sum(left) < (1.0 - LEAST_TAKEN) * sum(whole) else None


def _thinned(one: PositionErrors) -> PositionErrors:
    """Return a run with the blocks that are looked at."""
    return replace(
        one,
        time_s=one.time_s[::EVERY],
        command_mm=one.command_mm[::EVERY],
        velocity_mm_s=one.velocity_mm_s[::EVERY],
        error_mm=one.error_mm[::EVERY],
        force_mN=one.force_mN[::EVERY],
    )


def _distinct(runs: Sequence[PositionErrors]) -> list[PositionErrors]:
    """Return runs of different motions, for repeats say nothing new; of many, some from the slowest to the fastest."""

    def motion(one: PositionErrors) -> tuple[float, ...]:
        lasted = float(one.time_s[-1] - one.time_s[0])
        return tuple(
            round(each, 2) for each in (one.top_speed_mm_s, one.command_mm.min(), one.command_mm.max(), lasted)
        )

    found = {motion(one): one for one in reversed(runs)}
    kept = np.unique(np.linspace(0, len(found) - 1, min(MOST_MOTIONS, len(found))).round().astype(int)).tolist()
    ordered = sorted(found)
    return [found[ordered[place]] for place in kept]
