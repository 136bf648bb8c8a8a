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
from dragrig.analysis.gap.spectral_lines import hum_effect
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Channel, catalogue

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
    covered = [motion_features(run) for run in position.runs]
    contest = _current_pair(position)
    chosen: list[NextRun] = []
    first = ""
    spent = 0.0
    while len(chosen) < budget.runs:
        beyond = [(_distance_to_nearest(motion_features(seen), covered), trial, seen) for trial, seen in tried]
        fitting = [
            pair
            for pair in beyond
            if float(pair[0].max()) >= MIN_LOG_DISTANCE and spent + pair[1].minutes <= budget.minutes
        ]
        if not fitting:
            break
        by, trial, seen = max(fitting, key=lambda pair: float(pair[0].max()) / (pair[1].minutes + FIXTURE_CHANGE_MIN))
        first = first or _coverage_reason(trial, by, len(tried))
        chosen.append(NextRun(trial.step, trial.minutes, contest, contest))
        covered.append(motion_features(seen))
        spent += trial.minutes
    return NextExperiment(tuple(chosen), len(tried), first) if chosen else None


def motion_features(run: PositionErrors) -> FloatArray:
    """Return the logarithms of a run's speed, acceleration and travel, and of how many ways it goes, shape `(4,)`."""
    time = run.experiment.time_s
    command = np.asarray(run.experiment.run.trace.command, dtype=np.float64)
    speed = np.abs(np.gradient(command, time))
    top = float(speed.max())
    begin, end = int(np.argmax(speed > ACCELERATION_FROM * top)), int(np.argmax(speed > ACCELERATION_TO * top))
    acceleration = (
        (ACCELERATION_TO - ACCELERATION_FROM) * top / max(float(time[end] - time[begin]), float(time[1] - time[0]))
    )
    ways = 2.0 if run.velocity_mm_s.min() < 0 < run.velocity_mm_s.max() else 1.0
    return np.log(np.maximum((top, acceleration, np.ptp(command), ways), 1e-6))


def _distance_to_nearest(motion: FloatArray, covered: Sequence[FloatArray]) -> FloatArray:
    """Return by how much a run differs from the one that is most like it, in each aspect."""
    return min((np.abs(motion - values) for values in covered), key=lambda values: float(values.max()))


def _current_pair(position: PositionAnalysis) -> ModelPair:
    """Return what the best form leaves of what strays."""
    left = 1.0 - max((model_class.held_out_share for model_class in position.model_classes), default=0.0)
    seen = max(run.rms_mm / run.detectable_mm for run in position.runs)
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

    def error_in(self, run: PositionErrors) -> FloatArray:
        """Return what it makes of a run, shape `(B,)` [mm]."""
        if self.candidate is not None:
            return predicted_position_error(self.candidate, run)
        return run.zeroed(run.delayed_command(self.latency_s) - run.delayed_command(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PositionSeparation:
    """Motions that were made, and which effects of the position they are to set apart.

    Attributes
    ----------
    runs
        Runs with different motions; their errors are not looked at.
    assumed_effects
        Effects that may be there.
    weights
        How much it matters to set a truth apart from a rival.
    """

    runs: tuple[PositionErrors, ...]
    assumed_effects: tuple[AssumedPositionEffect, ...]
    weights: Mapping[tuple[str, str], float]

    def with_run(self, observation: Sequence[PositionErrors]) -> Self:
        """Add a run by its motion, as often as it is made."""
        return replace(self, runs=(*self.runs, *observation))

    def separations(self) -> tuple[PairSeparation, ...]:
        """Return how far each truth would be set apart from each rival if it were what strays."""
        return tuple(answer for truth in self.assumed_effects for answer in self._separations_of(truth))

    def _separations_of(self, truth: AssumedPositionEffect) -> Iterator[PairSeparation]:
        rivals = [name for label, name in self.weights if label == truth.effect]
        runs = [replace(run, error_mm=truth.error_in(run)) for run in self.runs]
        size = float(np.sqrt(sum(np.mean(run.error_mm**2) for run in runs)))
        explained = {
            model_class.effect: model_class.held_out_share
            for model_class in score_model_classes(runs, (truth.effect, *rivals))
        }
        for rival in rivals:
            left = min(max(explained[truth.effect] - explained[rival], 0.0), 1.0)
            contest = ModelPair(
                truth.effect, rival, DETECTABLE_D_PRIME * size / self.runs[0].detectable_mm * float(np.sqrt(left)), left
            )
            yield PairSeparation(
                contest, _position_log_odds(contest, explained[truth.effect]), self.weights[truth.effect, rival]
            )


def _position_log_odds(pair: ModelPair, explained: float) -> float:
    """Return about how sure a diagnosis can be of the truth, which explains a share of the errors by its free form."""
    against = POSITION_RIVAL_SLOPE * max(pair.remaining_share - CHANCE_SHARE, 0.0)
    named = DECIDED_LOG_ODDS * (explained - MIN_POSITION_SHARE) / (CLEAR_SHARE - MIN_POSITION_SHARE)
    sure = min(against, named)
    return sure if sure < DECIDED_LOG_ODDS else DECIDED_LOG_ODDS + log(max(pair.d_prime, 1.0))


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
    trials = [
        candidate
        for candidate in motion_grid(campaign_specimen(study), whole=budget.runs > 1)
        if limits.allow(candidate)
    ]
    last = position.runs[-1]
    seen = position_errors(candidate_experiments(last.experiment, trials))
    tried = list(zip(trials, (replace(run, session_s=last.session_s) for run in seen), strict=True))
    chances = {
        model_class.effect: marginal_probability(model_class.effect, probabilities)
        for model_class in position.model_classes
    }
    if not tried:
        return None
    if max(chances.values(), default=0.0) <= probabilities.get(UNKNOWN, 0.0):
        return search_new_motions(position, tried, budget)
    leading = {
        model_class.effect: _assumed_position_effect(position, model_class)
        for model_class in position.model_classes[:LEADING_HYPOTHESES]
    }
    truths = tuple(assumed for assumed in leading.values() if assumed is not None)
    matter = {name: max(chances[name], MIN_PAIR_WEIGHT) for name in leading}
    pairs = [(assumed.effect, rival) for assumed in truths for rival in leading if rival != assumed.effect]
    made = tuple(map(_thinned_blocks, _distinct_motions(position.runs)))
    field = PositionSeparation(made, truths, {pair: matter[pair[0]] * matter[pair[1]] for pair in pairs})
    may_see = [(trial, (_thinned_blocks(run),) * trial.step.repeats) for trial, run in tried]
    within = replace(budget, runs=min(budget.runs, MAX_NEXT_RUNS))
    return next_experiment_of(greedy_search(field, may_see, within), len(tried))


def _assumed_position_effect(position: PositionAnalysis, family: PositionModelClass) -> AssumedPositionEffect | None:
    """Return an effect as it was fitted; None where it cannot be what strays, for it takes hardly any of it."""
    effect = catalogue()[family.effect]
    by_form = effect.channel is Channel.POSITION
    runs = _distinct_motions(position.runs)
    candidate = position.candidate
    if candidate is None or candidate.effect.id != family.effect:
        candidate = fit_position_effect(runs, effect, family)[0] if by_form else None
    assumed = AssumedPositionEffect(family.effect, candidate, family.shape_value)
    left = [
        float(np.mean((run.error_mm - assumed.error_in(run)) ** 2)) / (run.rms_mm + run.encoder_count_mm) ** 2
        for run in runs
    ]
    whole = [float(np.mean(run.error_mm**2)) / (run.rms_mm + run.encoder_count_mm) ** 2 for run in runs]
    return assumed if sum(left) < (1.0 - MIN_FITTED_SHARE) * sum(whole) else None


def _thinned_blocks(run: PositionErrors) -> PositionErrors:
    """Return a run with the blocks that are looked at."""
    return replace(
        run,
        time_s=run.time_s[::BLOCK_STRIDE],
        command_mm=run.command_mm[::BLOCK_STRIDE],
        velocity_mm_s=run.velocity_mm_s[::BLOCK_STRIDE],
        error_mm=run.error_mm[::BLOCK_STRIDE],
        force_mN=run.force_mN[::BLOCK_STRIDE],
    )


def _distinct_motions(runs: Sequence[PositionErrors]) -> list[PositionErrors]:
    """Return runs of different motions, for repeats say nothing new; of many, some from the slowest to the fastest."""

    def motion(run: PositionErrors) -> tuple[float, ...]:
        lasted = float(run.time_s[-1] - run.time_s[0])
        return tuple(
            round(each, 2) for each in (run.top_speed_mm_s, run.command_mm.min(), run.command_mm.max(), lasted)
        )

    distinct = {motion(run): run for run in reversed(runs)}
    kept = np.unique(np.linspace(0, len(distinct) - 1, min(MAX_MOTIONS, len(distinct))).round().astype(int)).tolist()
    ordered = sorted(distinct)
    return [distinct[ordered[place]] for place in kept]


def recommend_next_run(
    study: Study,
    search: ForceSearchResult,
    position: PositionAnalysis,
    classification: Classification,
    of_force: Classification,
    budget: ExperimentBudget,
) -> NextExperiment | None:
    """Recommend the run to make next; `of_force` is the verdict as if only the force had been looked at.

    Where an effect of the force is named beside one of the position, the run is for the more doubtful one.
    """
    if position.has_position_error:
        beside = set(classification.effects) & set(of_force.effects) - {hum_effect().id}
        if not beside or 1.0 - of_force.probabilities["+".join(of_force.effects)] <= _position_doubt(
            classification, position
        ):
            return recommend_position_run(study, position, classification.probabilities, budget)
        classification = of_force
    gap = classification.verdict is not Verdict.NO_GAP
    return recommend_force_run(study, search.nominal, search.ranked, classification.probabilities, budget, gap=gap)


def reasons_for_no_run(
    study: Study, position: PositionAnalysis, classification: Classification, next_experiment: NextExperiment | None
) -> Iterator[str]:
    """Say why no run is recommended where the position strays and what it is is in doubt."""
    if not position.has_position_error or next_experiment is not None or not isinstance(study, CapsuleStudy):
        return
    families = {model_class.effect for model_class in position.model_classes}
    rivals = [name for name in classification.confusable_with if name in families]
    if classification.verdict is Verdict.UNKNOWN:
        yield NO_NEW_MOTION
    elif rivals:
        named = [name for name in classification.effects if name in families]
        apart = f"{display_name('+'.join(named))} from {display_name('+'.join(rivals))}"
        yield f"No run that was compared would tell {apart} either."


def _position_doubt(classification: Classification, position: PositionAnalysis) -> float:
    """Return how doubtful the effect of the position is that was named, whatever is named beside it."""
    families = {model_class.effect for model_class in position.model_classes}
    named = {name for name in classification.effects if name in families}
    return 1.0 - sum(value for name, value in classification.probabilities.items() if named & set(name.split("+")))
