"""The next run after a diagnosis: for effects on the position, for motions not yet covered, or for the force.

Position errors are explained by free-form model classes scored on held-out runs, as in a diagnosis. Errors of further
runs are predicted with each leading effect as it was fitted, each in turn assumed to be true.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Self

import numpy as np

from dragrig.analysis import join_names
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
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun, Verdict, display_name
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.isolability import DETECTABLE_D_PRIME
from dragrig.analysis.gap.next_run_force import (
    LEADING_HYPOTHESES,
    MIN_PAIR_WEIGHT,
    limits_of_campaign,
    marginal_probability,
    next_experiment_of,
    recommend_force_run,
    run_subject,
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
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Channel, catalogue

MIN_LOG_DISTANCE = log(1.5)
"""Smallest log ratio of speed, acceleration or travel for a motion to count as new."""
ACCELERATION_FROM, ACCELERATION_TO = 0.1, 0.9
"""Fractions of the highest speed between which the acceleration is evaluated."""
MOTION_ASPECTS = ("speed", "acceleration", "travel", "direction")
NO_NEW_MOTION = (
    "No further run would show more of the position error: the runs so far cover the speeds, accelerations and "
    "travels of all candidates."
)


def search_new_motions(
    position: PositionAnalysis, observed: Sequence[tuple[CandidateRun, PositionErrors]], budget: ExperimentBudget
) -> NextExperiment | None:
    """Return the runs furthest from all motions so far per minute of rig time; None for no new motion."""
    covered = [motion_features(run) for run in position.runs]
    pair = _current_pair(position)
    selected: list[NextRun] = []
    reason = ""
    minutes = 0.0
    while len(selected) < budget.runs:
        distances = [
            (_distance_to_nearest(motion_features(observation), covered), candidate, observation)
            for candidate, observation in observed
        ]
        candidates = [
            item
            for item in distances
            if float(item[0].max()) >= MIN_LOG_DISTANCE and minutes + item[1].minutes <= budget.minutes
        ]
        if not candidates:
            break
        distance, candidate, observation = max(
            candidates, key=lambda item: float(item[0].max()) / (item[1].minutes + FIXTURE_CHANGE_MIN)
        )
        reason = reason or _coverage_reason(candidate, distance, len(observed))
        selected.append(NextRun(candidate.step, candidate.minutes, pair, pair))
        covered.append(motion_features(observation))
        minutes += candidate.minutes
    return NextExperiment(tuple(selected), len(observed), reason) if selected else None


def motion_features(run: PositionErrors) -> FloatArray:
    """Return log speed, acceleration, travel and number of directions of a run, shape `(4,)`."""
    time = run.experiment.time_s
    command = np.asarray(run.experiment.run.trace.command, dtype=np.float64)
    speed = np.abs(np.gradient(command, time))
    top = float(speed.max())
    begin, end = int(np.argmax(speed > ACCELERATION_FROM * top)), int(np.argmax(speed > ACCELERATION_TO * top))
    acceleration = (
        (ACCELERATION_TO - ACCELERATION_FROM) * top / max(float(time[end] - time[begin]), float(time[1] - time[0]))
    )
    directions = 2.0 if run.velocity_mm_s.min() < 0 < run.velocity_mm_s.max() else 1.0
    return np.log(np.maximum((top, acceleration, np.ptp(command), directions), 1e-6))


def _distance_to_nearest(motion: FloatArray, covered: Sequence[FloatArray]) -> FloatArray:
    """Return the difference to the most similar motion, in each aspect."""
    return min((np.abs(motion - distance) for distance in covered), key=lambda distance: float(distance.max()))


def _current_pair(position: PositionAnalysis) -> ModelPair:
    """Return the share of the errors that the best model class leaves."""
    remaining = 1.0 - max((model_class.held_out_share for model_class in position.model_classes), default=0.0)
    error_ratio = max(run.rms_mm / run.detectable_mm for run in position.runs)
    return ModelPair(
        UNKNOWN, "", DETECTABLE_D_PRIME * error_ratio * float(np.sqrt(min(remaining, 1.0))), min(remaining, 1.0)
    )


def _coverage_reason(candidate: CandidateRun, distance: FloatArray, tried: int) -> str:
    aspects = [name for name, value in zip(MOTION_ASPECTS, distance.tolist(), strict=True) if value >= MIN_LOG_DISTANCE]
    return (
        f"{run_subject(candidate.step)} is the most novel motion per minute of rig time: no "
        f"run so far comes near its {join_names(aspects)}. The position error has no known cause yet, and unexplored "
        f"motions can show most of it. {candidate.minutes:.1f} min of rig time; {tried} candidate runs."
    )


CHANCE_SHARE = 0.0025
"""Differences in held-out share below this are chance."""
MIN_FITTED_SHARE = 0.5
"""An effect whose catalogue form explains less of the errors than this is not assumed."""
MAX_MOTIONS, MAX_NEXT_RUNS = 6, 3
"""Number of a campaign's motions that represent all of it, and of runs that are recommended."""
BLOCK_STRIDE = 3
"""Only every third block is evaluated, which suffices here."""
CLEAR_SHARE = 0.9
"""Held-out share above which an effect is named with certainty."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedPositionEffect:
    """A fitted effect on the position: a candidate of the catalogue, or a latency."""

    effect: str
    candidate: Candidate | None
    latency_s: float

    def error_in(self, run: PositionErrors) -> FloatArray:
        """Return its error in a run, shape `(B,)` [mm]."""
        if self.candidate is not None:
            return predicted_position_error(self.candidate, run)
        return run.zeroed(run.delayed_command(self.latency_s) - run.delayed_command(0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PositionSeparation:
    """Separation of effects on the position by the motions of runs."""

    runs: tuple[PositionErrors, ...]
    """Runs with different motions; their errors are not used."""
    assumed_effects: tuple[AssumedPositionEffect, ...]
    """Effects that may be present."""
    weights: Mapping[tuple[str, str], float]
    """Weight of each pair of assumed effect and rival."""

    def with_run(self, observation: Sequence[PositionErrors]) -> Self:
        """Add a run by its motion, repeats included."""
        return replace(self, runs=(*self.runs, *observation))

    def separations(self) -> tuple[PairSeparation, ...]:
        """Return the separation of each assumed effect from each rival."""
        return tuple(separation for assumed in self.assumed_effects for separation in self._separations_of(assumed))

    def _separations_of(self, assumed: AssumedPositionEffect) -> Iterator[PairSeparation]:
        rivals = [name for assumed_name, name in self.weights if assumed_name == assumed.effect]
        runs = [replace(run, error_mm=assumed.error_in(run)) for run in self.runs]
        rms_mm = float(np.sqrt(sum(np.mean(run.error_mm**2) for run in runs)))
        shares = {
            model_class.effect: model_class.held_out_share
            for model_class in score_model_classes(runs, (assumed.effect, *rivals))
        }
        for rival in rivals:
            remaining = min(max(shares[assumed.effect] - shares[rival], 0.0), 1.0)
            pair = ModelPair(
                assumed.effect,
                rival,
                DETECTABLE_D_PRIME * rms_mm / self.runs[0].detectable_mm * float(np.sqrt(remaining)),
                remaining,
            )
            yield PairSeparation(
                pair, _position_log_odds(pair, shares[assumed.effect]), self.weights[assumed.effect, rival]
            )


def _position_log_odds(pair: ModelPair, explained: float) -> float:
    """Return the approximate log odds of a diagnosis for an effect with this held-out share."""
    rival_odds = POSITION_RIVAL_SLOPE * max(pair.remaining_share - CHANCE_SHARE, 0.0)
    own_odds = DECIDED_LOG_ODDS * (explained - MIN_POSITION_SHARE) / (CLEAR_SHARE - MIN_POSITION_SHARE)
    log_odds = min(rival_odds, own_odds)
    return log_odds if log_odds < DECIDED_LOG_ODDS else DECIDED_LOG_ODDS + log(max(pair.d_prime, 1.0))


def recommend_position_run(
    study: Study, position: PositionAnalysis, probabilities: Mapping[str, float], budget: ExperimentBudget
) -> NextExperiment | None:
    """Recommend the run that separates the leading effects on the position best per minute, or several.

    Where no effect is more likely than `unknown`, the run with the most novel motion is recommended.

    Parameters
    ----------
    position
        Position errors of the campaign.
    probabilities
        Probabilities of hypotheses; several effects joined with `+`.

    Returns
    -------
    None if the nominal model is not the friction model, or no run would help.
    """
    if not isinstance(study, CapsuleStudy):
        return None
    limits = budget.limits or limits_of_campaign(study)
    candidates = [
        candidate
        for candidate in motion_grid(campaign_specimen(study), whole=budget.runs > 1)
        if limits.allow(candidate)
    ]
    last = position.runs[-1]
    observations = position_errors(candidate_experiments(last.experiment, candidates))
    observed = list(zip(candidates, (replace(run, session_s=last.session_s) for run in observations), strict=True))
    probability_of = {
        model_class.effect: marginal_probability(model_class.effect, probabilities)
        for model_class in position.model_classes
    }
    if not observed:
        return None
    if max(probability_of.values(), default=0.0) <= probabilities.get(UNKNOWN, 0.0):
        return search_new_motions(position, observed, budget)
    leading = {
        model_class.effect: _assumed_position_effect(position, model_class)
        for model_class in position.model_classes[:LEADING_HYPOTHESES]
    }
    assumed_effects = tuple(assumed for assumed in leading.values() if assumed is not None)
    weight_of = {name: max(probability_of[name], MIN_PAIR_WEIGHT) for name in leading}
    pairs = [(assumed.effect, rival) for assumed in assumed_effects for rival in leading if rival != assumed.effect]
    motions = tuple(map(_thinned_blocks, _distinct_motions(position.runs)))
    model = PositionSeparation(
        motions, assumed_effects, {pair: weight_of[pair[0]] * weight_of[pair[1]] for pair in pairs}
    )
    thinned = [(candidate_run, (_thinned_blocks(run),) * candidate_run.step.repeats) for candidate_run, run in observed]
    limited_budget = replace(budget, runs=min(budget.runs, MAX_NEXT_RUNS))
    return next_experiment_of(greedy_search(model, thinned, limited_budget), len(observed))


def _assumed_position_effect(
    position: PositionAnalysis, model_class: PositionModelClass
) -> AssumedPositionEffect | None:
    """Return an effect as fitted; None if it explains too little of the errors."""
    effect = catalogue()[model_class.effect]
    in_catalogue = effect.channel is Channel.POSITION
    runs = _distinct_motions(position.runs)
    candidate = position.candidate
    if candidate is None or candidate.effect.id != model_class.effect:
        candidate = fit_position_effect(runs, effect, model_class)[0] if in_catalogue else None
    assumed = AssumedPositionEffect(model_class.effect, candidate, model_class.shape_value)
    remaining = [
        float(np.mean((run.error_mm - assumed.error_in(run)) ** 2)) / (run.rms_mm + run.encoder_count_mm) ** 2
        for run in runs
    ]
    total = [float(np.mean(run.error_mm**2)) / (run.rms_mm + run.encoder_count_mm) ** 2 for run in runs]
    return assumed if sum(remaining) < (1.0 - MIN_FITTED_SHARE) * sum(total) else None


def _thinned_blocks(run: PositionErrors) -> PositionErrors:
    """Return a run with a part of its blocks."""
    return replace(
        run,
        time_s=run.time_s[::BLOCK_STRIDE],
        command_mm=run.command_mm[::BLOCK_STRIDE],
        velocity_mm_s=run.velocity_mm_s[::BLOCK_STRIDE],
        error_mm=run.error_mm[::BLOCK_STRIDE],
        force_mN=run.force_mN[::BLOCK_STRIDE],
    )


def _distinct_motions(runs: Sequence[PositionErrors]) -> list[PositionErrors]:
    """Return runs with distinct motions; of many, some from the slowest to the fastest."""

    def motion(run: PositionErrors) -> tuple[float, ...]:
        duration_s = float(run.time_s[-1] - run.time_s[0])
        return tuple(
            round(value, 2) for value in (run.top_speed_mm_s, run.command_mm.min(), run.command_mm.max(), duration_s)
        )

    distinct = {motion(run): run for run in reversed(runs)}
    indices = np.unique(np.linspace(0, len(distinct) - 1, min(MAX_MOTIONS, len(distinct))).round().astype(int)).tolist()
    ordered = sorted(distinct)
    return [distinct[ordered[index]] for index in indices]


def recommend_next_run(
    study: Study,
    search: ForceSearchResult,
    position: PositionAnalysis,
    classification: Classification,
    force_classification: Classification,
    budget: ExperimentBudget,
) -> NextExperiment | None:
    """Recommend the next run; `force_classification` is the verdict without the position channel.

    With effects on both channels, the run is for the less certain one.
    """
    if position.has_position_error:
        force_effects = set(classification.effects) & set(force_classification.effects) - {hum_effect().id}
        if not force_effects or 1.0 - force_classification.probabilities[
            "+".join(force_classification.effects)
        ] <= _position_doubt(classification, position):
            return recommend_position_run(study, position, classification.probabilities, budget)
        classification = force_classification
    gap = classification.verdict is not Verdict.NO_GAP
    return recommend_force_run(study, search.nominal, search.ranked, classification.probabilities, budget, gap=gap)


def reasons_for_no_run(
    study: Study, position: PositionAnalysis, classification: Classification, next_experiment: NextExperiment | None
) -> Iterator[str]:
    """Yield why no run is recommended although the cause of position errors is uncertain."""
    if not position.has_position_error or next_experiment is not None or not isinstance(study, CapsuleStudy):
        return
    position_effects = {model_class.effect for model_class in position.model_classes}
    rivals = [name for name in classification.confusable_with if name in position_effects]
    if classification.verdict is Verdict.UNKNOWN:
        yield NO_NEW_MOTION
    elif rivals:
        names = [name for name in classification.effects if name in position_effects]
        apart = f"{display_name('+'.join(names))} from {display_name('+'.join(rivals))}"
        yield f"No candidate run would distinguish {apart} either."


def _position_doubt(classification: Classification, position: PositionAnalysis) -> float:
    """Return the probability that the named effect on the position is wrong."""
    position_effects = {model_class.effect for model_class in position.model_classes}
    names = {name for name in classification.effects if name in position_effects}
    return 1.0 - sum(value for name, value in classification.probabilities.items() if names & set(name.split("+")))
