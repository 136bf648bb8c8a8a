"""The next run after a diagnosis: for effects on the position, for motions not yet covered, or for the force.

Position errors are explained by free-form model classes scored on held-out runs, as in a diagnosis. Errors of further
runs are predicted with each leading effect as it was fitted, each in turn assumed to be true.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Self

import numpy as np

from dragrig.analysis.gap.candidate_runs import (
    DECIDED_LOG_ODDS,
    FIXTURE_CHANGE_MIN,
    CandidateRun,
    ExperimentBudget,
    PairSeparation,
    campaign_specimen,
    candidate_experiments,
    greedy_search,
    motion_grid,
)
from dragrig.analysis.gap.candidates import Candidate
from dragrig.analysis.gap.classifier import MIN_POSITION_SHARE, POSITION_RIVAL_SLOPE, UNKNOWN, Classification
from dragrig.analysis.gap.design import Study
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun, Verdict
from dragrig.analysis.gap.diagnosis_text import display_name, join_names, run_subject
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.isolability import DETECTABLE_D_PRIME
from dragrig.analysis.gap.next_run_force import (
    LEADING_HYPOTHESES,
    MIN_PAIR_WEIGHT,
    limits_of_campaign,
    marginal_probability,
    next_experiment_of,
    recommend_force_run,
)
from dragrig.analysis.gap.position_channel import (
    PositionAnalysis,
    PositionErrors,
    PositionModelClass,
    fit_position_effect,
    position_errors,
    predicted_position_error,
    score_model_classes,
)
from dragrig.analysis.gap.spectral_lines import MAINS_HUM
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import EncoderEffect, MotorEffect, catalogue

MIN_LOG_DISTANCE = log(1.5)
"""A run whose speed, acceleration and travel differ by less from those of another shows nothing else."""
ACCELERATION_FROM, ACCELERATION_TO = 0.1, 0.9
"""Parts of the highest speed between which an acceleration is taken."""
MOTION_ASPECTS = ("speed", "acceleration", "travel", "direction")
NO_NEW_MOTION = (
    "No further run would show more of how the position strays: those made already have speeds, accelerations and "
    "travels like all that were compared."
)


def search_new_motions(
    position: PositionAnalysis, tried: Sequence[tuple[CandidateRun, PositionErrors]], budget: ExperimentBudget
) -> NextExperiment | None:
    """Return the runs furthest beyond those so far per minute of rig time, each after those before.

    None where the runs so far move the stage in all ways that are tried.
    """
    covered = [motion_features(one) for one in position.runs]
    contest = _current_pair(position)
    chosen: list[NextRun] = []
    first = ""
    spent = 0.0
    while len(chosen) < budget.runs:
        beyond = [(_distance_to_nearest(motion_features(seen), covered), trial, seen) for trial, seen in tried]
        fitting = [
            one
            for one in beyond
            if float(one[0].max()) >= MIN_LOG_DISTANCE and spent + one[1].minutes <= budget.minutes
        ]
        if not fitting:
            break
        by, trial, seen = max(fitting, key=lambda one: float(one[0].max()) / (one[1].minutes + FIXTURE_CHANGE_MIN))
        first = first or _coverage_reason(trial, by, len(tried))
        chosen.append(NextRun(trial.step, trial.minutes, contest, contest))
        covered.append(motion_features(seen))
        spent += trial.minutes
    return NextExperiment(tuple(chosen), len(tried), first) if chosen else None


def motion_features(one: PositionErrors) -> FloatArray:
    """Return the logarithms of a run's speed, acceleration and travel, and of how many ways it goes, shape `(4,)`."""
    time = one.experiment.time_s
    command = np.asarray(one.experiment.run.trace.command, dtype=np.float64)
    speed = np.abs(np.gradient(command, time))
    top = float(speed.max())
    begin, end = int(np.argmax(speed > ACCELERATION_FROM * top)), int(np.argmax(speed > ACCELERATION_TO * top))
    acceleration = (
        (ACCELERATION_TO - ACCELERATION_FROM) * top / max(float(time[end] - time[begin]), float(time[1] - time[0]))
    )
    ways = 2.0 if one.velocity_mm_s.min() < 0 < one.velocity_mm_s.max() else 1.0
    return np.log(np.maximum((top, acceleration, np.ptp(command), ways), 1e-6))


def _distance_to_nearest(motion: FloatArray, covered: Sequence[FloatArray]) -> FloatArray:
    """Return by how much a run differs from the one that is most like it, in each aspect."""
    return min((np.abs(motion - one) for one in covered), key=lambda one: float(one.max()))


def _current_pair(position: PositionAnalysis) -> ModelPair:
    """Return what the best form leaves of what strays."""
    left = 1.0 - max((one.held_out for one in position.families), default=0.0)
    seen = max(one.rms_mm / one.least_mm for one in position.runs)
    return ModelPair(UNKNOWN, "", DETECTABLE_D_PRIME * seen * float(np.sqrt(min(left, 1.0))), min(left, 1.0))


def _coverage_reason(trial: CandidateRun, by: FloatArray, tried: int) -> str:
    differs = [name for name, value in zip(MOTION_ASPECTS, by.tolist(), strict=True) if value >= MIN_LOG_DISTANCE]
    return (
        f"{run_subject(trial.step)} goes furthest per minute of rig time beyond how the stage has moved: no "
        f"run so far comes near its {join_names(differs)}. How the position strays has no name yet, and where it has "
        f"not been looked at most of it can show. {trial.minutes:.1f} min of rig time; {tried} runs were compared."
    )


CHANCE_SHARE = 0.0025
"""A rival that leaves less of the errors than this is told from the truth by chance alone."""
MIN_FITTED_SHARE = 0.5
"""An effect of which the catalogue's form takes less of the errors than this is not what strays."""
MAX_MOTIONS, MAX_NEXT_RUNS = 6, 3
"""So many motions of a campaign are taken for all of it, and so many further ones recommended at most."""
BLOCK_STRIDE = 3
"""One block of so many is looked at: more cost time and tell nothing more here."""
CLEAR_SHARE = 0.9
"""An effect that explains so much of the errors is named without doubt."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedPositionEffect:
    """An effect of the position as it was fitted: of the catalogue, or the command at another time."""

    effect: str
    candidate: Candidate | None
    latency_s: float

    def error_of(self, one: PositionErrors) -> FloatArray:
        """Return what it makes of a run, shape `(B,)` [mm]."""
        if self.candidate is not None:
            return predicted_position_error(self.candidate, one)
        return one.from_zero(one.delayed(self.latency_s) - one.delayed(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PositionSeparation:
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
    truths: tuple[AssumedPositionEffect, ...]
    weights: Mapping[tuple[str, str], float]

    def with_run(self, seen: Sequence[PositionErrors]) -> Self:
        """Add a run by its motion, as often as it is made."""
        return replace(self, runs=(*self.runs, *seen))

    def answers(self) -> tuple[PairSeparation, ...]:
        """Return how far each truth would be set apart from each rival if it were what strays."""
        return tuple(answer for truth in self.truths for answer in self._of(truth))

    def _of(self, truth: AssumedPositionEffect) -> Iterator[PairSeparation]:
        rivals = [other for one, other in self.weights if one == truth.effect]
        runs = [replace(one, error_mm=truth.error_of(one)) for one in self.runs]
        size = float(np.sqrt(sum(np.mean(one.error_mm**2) for one in runs)))
        explained = {one.effect: one.held_out for one in score_model_classes(runs, (truth.effect, *rivals))}
        for rival in rivals:
            left = min(max(explained[truth.effect] - explained[rival], 0.0), 1.0)
            contest = ModelPair(
                truth.effect, rival, DETECTABLE_D_PRIME * size / self.runs[0].least_mm * float(np.sqrt(left)), left
            )
            yield PairSeparation(
                contest, _position_log_odds(contest, explained[truth.effect]), self.weights[truth.effect, rival]
            )


def _position_log_odds(one: ModelPair, explained: float) -> float:
    """Return about how sure a diagnosis can be of the truth, which explains a share of the errors by its free form."""
    against = POSITION_RIVAL_SLOPE * max(one.left - CHANCE_SHARE, 0.0)
    named = DECIDED_LOG_ODDS * (explained - MIN_POSITION_SHARE) / (CLEAR_SHARE - MIN_POSITION_SHARE)
    sure = min(against, named)
    return sure if sure < DECIDED_LOG_ODDS else DECIDED_LOG_ODDS + log(max(one.d_prime, 1.0))


def recommend_position_run(
    study: Study, position: PositionAnalysis, probabilities: Mapping[str, float], budget: ExperimentBudget
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
    limits = budget.limits or limits_of_campaign(study)
    trials = [one for one in motion_grid(campaign_specimen(study), whole=budget.runs > 1) if limits.allow(one)]
    last = position.runs[-1]
    seen = position_errors(candidate_experiments(last.experiment, trials))
    tried = list(zip(trials, (replace(one, session_s=last.session_s) for one in seen), strict=True))
    chances = {one.effect: marginal_probability(one.effect, probabilities) for one in position.families}
    if not tried:
        return None
    if max(chances.values(), default=0.0) <= probabilities.get(UNKNOWN, 0.0):
        return search_new_motions(position, tried, budget)
    leading = {one.effect: _assumed_position_effect(position, one) for one in position.families[:LEADING_HYPOTHESES]}
    truths = tuple(one for one in leading.values() if one is not None)
    matter = {name: max(chances[name], MIN_PAIR_WEIGHT) for name in leading}
    pairs = [(one.effect, rival) for one in truths for rival in leading if rival != one.effect]
    made = tuple(map(_thinned_blocks, _distinct_motions(position.runs)))
    field = PositionSeparation(made, truths, {pair: matter[pair[0]] * matter[pair[1]] for pair in pairs})
    may_see = [(trial, (_thinned_blocks(one),) * trial.step.repeats) for trial, one in tried]
    within = replace(budget, runs=min(budget.runs, MAX_NEXT_RUNS))
    return next_experiment_of(greedy_search(field, may_see, within), len(tried))


def _assumed_position_effect(position: PositionAnalysis, family: PositionModelClass) -> AssumedPositionEffect | None:
    """Return an effect as it was fitted; None where it cannot be what strays, for it takes hardly any of it."""
    effect = catalogue()[family.effect]
    by_form = isinstance(effect, MotorEffect | EncoderEffect)
    runs = _distinct_motions(position.runs)
    candidate = position.candidate
    if candidate is None or candidate.effect.id != family.effect:
        candidate = fit_position_effect(runs, effect, family)[0] if by_form else None
    found = AssumedPositionEffect(family.effect, candidate, family.shape)
    left = [
        float(np.mean((one.error_mm - found.error_of(one)) ** 2)) / (one.rms_mm + one.count_mm) ** 2 for one in runs
    ]
    whole = [float(np.mean(one.error_mm**2)) / (one.rms_mm + one.count_mm) ** 2 for one in runs]
    return found if sum(left) < (1.0 - MIN_FITTED_SHARE) * sum(whole) else None


def _thinned_blocks(one: PositionErrors) -> PositionErrors:
    """Return a run with the blocks that are looked at."""
    return replace(
        one,
        time_s=one.time_s[::BLOCK_STRIDE],
        command_mm=one.command_mm[::BLOCK_STRIDE],
        velocity_mm_s=one.velocity_mm_s[::BLOCK_STRIDE],
        error_mm=one.error_mm[::BLOCK_STRIDE],
        force_mN=one.force_mN[::BLOCK_STRIDE],
    )


def _distinct_motions(runs: Sequence[PositionErrors]) -> list[PositionErrors]:
    """Return runs of different motions, for repeats say nothing new; of many, some from the slowest to the fastest."""

    def motion(one: PositionErrors) -> tuple[float, ...]:
        lasted = float(one.time_s[-1] - one.time_s[0])
        return tuple(
            round(each, 2) for each in (one.top_speed_mm_s, one.command_mm.min(), one.command_mm.max(), lasted)
        )

    found = {motion(one): one for one in reversed(runs)}
    kept = np.unique(np.linspace(0, len(found) - 1, min(MAX_MOTIONS, len(found))).round().astype(int)).tolist()
    ordered = sorted(found)
    return [found[ordered[place]] for place in kept]


def recommend_next_run(
    study: Study,
    found: ForceSearchResult,
    position: PositionAnalysis,
    judged: Classification,
    of_force: Classification,
    budget: ExperimentBudget,
) -> NextExperiment | None:
    """Recommend the run to make next; `of_force` is the verdict as if only the force had been looked at.

    Where an effect of the force is named beside one of the position, the run is for the more doubtful one.
    """
    if position.present:
        beside = set(judged.effects) & set(of_force.effects) - {MAINS_HUM}
        if not beside or 1.0 - of_force.probabilities["+".join(of_force.effects)] <= _position_doubt(judged, position):
            return recommend_position_run(study, position, judged.probabilities, budget)
        judged = of_force
    gap = judged.verdict is not Verdict.NO_GAP
    return recommend_force_run(study, found.nominal, found.ranked, judged.probabilities, budget, gap=gap)


def reasons_for_no_run(
    study: Study, position: PositionAnalysis, judged: Classification, found: NextExperiment | None
) -> Iterator[str]:
    """Say why no run is recommended where the position strays and what it is is in doubt."""
    if not position.present or found is not None or not isinstance(study, CapsuleStudy):
        return
    families = {one.effect for one in position.families}
    rivals = [one for one in judged.confusable_with if one in families]
    if judged.verdict is Verdict.UNKNOWN:
        yield NO_NEW_MOTION
    elif rivals:
        named = [one for one in judged.effects if one in families]
        apart = f"{display_name('+'.join(named))} from {display_name('+'.join(rivals))}"
        yield f"No run that was compared would tell {apart} either."


def _position_doubt(judged: Classification, position: PositionAnalysis) -> float:
    """Return how doubtful the effect of the position is that was named, whatever is named beside it."""
    families = {one.effect for one in position.families}
    named = {one for one in judged.effects if one in families}
    return 1.0 - sum(each for one, each in judged.probabilities.items() if named & set(one.split("+")))
