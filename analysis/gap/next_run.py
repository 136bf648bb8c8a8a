"""The next runs after a diagnosis: those that are expected to tell most per minute of the cause of the gap.

Of the force, the question is which causes act (`information`), or before any run which of two effects. Position errors
are explained by free-form model classes scored on held-out runs, as in a diagnosis; errors of further runs are
predicted with each leading effect as it was fitted, each in turn assumed to be true.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import log

import numpy as np

from dragrig.analysis import (
    CapsuleModel,
    RunSelection,
    join_names,
    single_blas_thread,
)
from dragrig.analysis.gap.candidate_runs import (
    CandidateRun,
    ExperimentBudget,
    RigLimits,
    campaign_specimen,
    candidate_experiments,
    full_grid,
    greedy_search,
    motion_grid,
    mounting,
    recommendation_reason,
    run_subject,
    short_grid,
    study_of_candidates,
)
from dragrig.analysis.gap.design import (
    NUISANCES,
    RELATIVE_RIDGE,
    Candidate,
    ColumnKind,
    Design,
    EffectVariant,
    Study,
    forms_of,
    gauss_newton_step,
    linearise,
)
from dragrig.analysis.gap.diagnosis import (
    UNKNOWN,
    Classification,
    NextExperiment,
    NextRun,
    OpenCauses,
    Verdict,
    display_name,
    marginal_probability,
)
from dragrig.analysis.gap.features import FORM_LOSS
from dragrig.analysis.gap.information import bits_to_change, entropy_bits, expected_bits, forecast
from dragrig.analysis.gap.isolability import CONFUSED_SIN2, SignatureAngles
from dragrig.analysis.gap.position_channel import (
    MIN_POSITION_SHARE,
    POSITION_RIVAL_SLOPE,
    PositionAnalysis,
    PositionErrors,
    PositionModelClass,
    fit_position_effect,
    position_errors,
    predicted_position_error,
    score_model_classes,
)
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.analysis.gap.weighing import WeighedCauses
from dragrig.config import AnalysisError
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Channel, catalogue

LOG_ODDS_PER_SHARE = 14.0
"""Log odds per share of an effect's squares that a rival leaves."""


DECIDED_LOG_ODDS = 12.0
"""Log odds from which a diagnosis is sure of an effect on the position."""
LOG_ODDS_PER_DISTANCE = 4.0
"""Expected log odds of two Gaussian predictions of one covariance, d'^2 / 2, over their Bhattacharyya distance."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedEffect:
    """An effect assumed to be present: columns of the dictionary with amplitudes, in default sizes."""

    effect: str
    columns: tuple[int, ...]
    amplitude: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PairQuestion:
    """Two effects of which one may be there, either in turn assumed."""

    first: AssumedEffect
    second: AssumedEffect

    @property
    def effects(self) -> tuple[str, str]:
        """Their ids."""
        return self.first.effect, self.second.effect


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information of runs on the variants of some effects."""

    gram: FloatArray
    """Gram matrix of nuisances and variants, whitened and summed over runs."""
    prior_precision: FloatArray
    """Prior precision of the nuisances."""
    variants: tuple[EffectVariant, ...]
    """Variants in the order of the last columns."""

    @classmethod
    def of(cls, design: Design, effects: Sequence[str]) -> "Information":
        """Extract the information on some effects from a design with its dictionary."""
        rows = information_rows(design, effects)
        nuisances = design.columns_of(*NUISANCES)
        variants = tuple(variant for variant in design.variants if variant.effect.id in effects)
        return cls(design.total_gram()[np.ix_(rows, rows)], design.prior_precision[nuisances], variants)

    def with_run(self, gram: FloatArray) -> "Information":
        """Add a run by its Gram matrix with the same columns."""
        return replace(self, gram=self.gram + gram)

    def projected_gram(self) -> FloatArray:
        """Return the products of the variants with nuisances projected out."""
        count = len(self.prior_precision)
        nuisances, cross = self.gram[:count, :count], self.gram[:count, count:]
        precision_matrix = nuisances + np.diag(self.prior_precision + RELATIVE_RIDGE * np.diag(nuisances))
        return np.asarray(self.gram[count:, count:] - cross.T @ np.linalg.solve(precision_matrix, cross))

    def columns_of(self, design: Design, effect: str, variants: Sequence[int]) -> tuple[int, ...]:
        """Return the columns here of an effect's variants, given by their indices in a design's dictionary."""
        in_design = [index for index, variant in enumerate(design.variants) if variant.effect.id == effect]
        columns = [index for index, variant in enumerate(self.variants) if variant.effect.id == effect]
        return tuple(columns[in_design.index(index)] for index in variants)

    def variants_of(self, effect: str) -> list[tuple[int, ...]]:
        """Return the columns of each variant of an effect; two for a periodic one."""
        return [form for form in forms_of(self.variants) if self.variants[form[0]].effect.id == effect]


def information_rows(design: Design, effects: Sequence[str]) -> FloatArray:
    """Return the rows of a design's Gram matrices for nuisances and the variants of some effects."""
    indices = [index for index, variant in enumerate(design.variants) if variant.effect.id in effects]
    return np.asarray(
        1 + np.concatenate((design.columns_of(*NUISANCES), design.columns_of(ColumnKind.VARIANT)[indices]))
    )


def expected_log_odds(information: Information, gram: FloatArray, assumed: AssumedEffect, rival: str) -> float:
    """Return the approximate log odds of a diagnosis for an assumed effect against a rival, with form error and noise.

    `gram` is the projected Gram matrix.
    """
    index = list(assumed.columns)
    squares = float(assumed.amplitude @ gram[np.ix_(index, index)] @ assumed.amplitude)
    moment = gram[:, index] @ assumed.amplitude
    absorbed = max(
        (_absorbed_chi2(information, gram, moment, variant) for variant in information.variants_of(rival)),
        default=0.0,
    )
    remaining = max(squares - absorbed, 0.0)
    share = remaining / max(squares, 1e-12)
    assumed_chi2 = remaining / max(share, 1e-12)
    return LOG_ODDS_PER_SHARE * share + 0.5 * remaining / (1.0 + 0.5 * FORM_LOSS * assumed_chi2)


def _absorbed_chi2(information: Information, gram: FloatArray, moment: FloatArray, variant: tuple[int, ...]) -> float:
    index = list(variant)
    gram_of_variant = gram[np.ix_(index, index)]
    strength = float(np.trace(gram_of_variant))
    if strength <= 1e-9:
        return 0.0
    if information.variants[index[0]].one_signed and moment[index[0]] < 0:
        return 0.0
    return float(moment[index] @ np.linalg.solve(gram_of_variant + 1e-9 * strength * np.eye(len(index)), moment[index]))


@dataclass(frozen=True, eq=False)
class WhichOfTwo:
    """Which effect of each of some pairs is there, either as likely: answered by the information of runs."""

    information: Information
    questions: tuple[PairQuestion, ...]
    before: "WhichOfTwo | None" = None
    """With the runs alone that are taken as made; None for itself."""

    def with_run(self, observation: FloatArray) -> "WhichOfTwo":
        """Choose a further run by its Gram matrix."""
        return WhichOfTwo(self.information.with_run(observation), self.questions, self.before or self)

    @property
    def open_bits(self) -> float:
        """Mean entropy of a pair before the chosen runs."""
        return 1.0 - (self.before or self).mean_told

    @property
    def bits_to_change(self) -> float:
        """None: either effect is as likely."""
        return 0.0

    @property
    def bits(self) -> float:
        """Mean information of the chosen runs on a pair."""
        return self.mean_told - (self.before or self).mean_told

    def about(self, before: "WhichOfTwo") -> tuple[str, ...]:
        """Return the pair that is told apart most; nothing for the only one."""
        gains = [now - then for now, then in zip(self.told, before.told, strict=True)]
        return () if len(gains) == 1 else self.questions[gains.index(max(gains))].effects

    @property
    def mean_told(self) -> float:
        """Mean information on a pair by all runs."""
        return float(np.mean(self.told))

    @cached_property
    def told(self) -> tuple[float, ...]:
        """Information on each pair by all runs."""
        gram = self.information.projected_gram()
        return tuple(self._told_of(question, gram) for question in self.questions)

    def _told_of(self, question: PairQuestion, gram: FloatArray) -> float:
        first, second = question.first, question.second
        distances = np.zeros((2, 2))
        distances[0, 1], distances[1, 0] = (
            expected_log_odds(self.information, gram, assumed, rival.effect) / LOG_ODDS_PER_DISTANCE
            for assumed, rival in ((first, second), (second, first))
        )
        return expected_bits(np.full(2, 0.5), distances, question.effects)


def _candidate_grams(study: Study, design: Design, candidates: Sequence[CandidateRun]) -> list[FloatArray]:
    candidate_design = linearise(study_of_candidates(study, candidates), design.z, dictionary=True)
    rows = information_rows(candidate_design, [effect.id for effect in study.effects]).tolist()
    return [gram[rows][:, rows] for gram in candidate_design.grams]


LEADING_HYPOTHESES = 3
MIN_WEIGHT = 0.05
"""Smallest weight of a leading effect, however improbable."""


@dataclass(frozen=True, slots=True)
class Recommendation:
    """Recommended runs, None where no run would help, and the open question about the causes in the force."""

    experiment: NextExperiment | None = None
    open_causes: OpenCauses | None = None
    limitations: tuple[str, ...] = ()
    """Why no run is recommended for a position error whose cause is uncertain, a sentence each."""


def recommend_force_run(weighed: WeighedCauses, budget: ExperimentBudget) -> Recommendation:
    """Recommend one run from the short grid, or several from the full grid, that tell of the causes in the force.

    Nothing if the nominal model is not the friction model.
    """
    study = weighed.study
    if not isinstance(study, CapsuleStudy):
        return Recommendation()
    specimen = campaign_specimen(study)
    grid = short_grid(specimen) if budget.runs == 1 else full_grid(specimen)
    candidates = _allowed(grid, study, budget)
    if not candidates:
        return Recommendation()
    further = study_of_candidates(study, candidates)
    question, grams = forecast(weighed.search, weighed.causes.competition, further)
    last = max(study.runs, key=lambda run: run.session_start_s)
    budget = replace(budget, mounted=budget.mounted or mounting(last.experiment.kind))
    runs = greedy_search(question, list(zip(candidates, grams, strict=True)), budget)
    experiment = next_experiment_of(runs, question.open_bits, len(candidates), "is open about which causes act")
    return Recommendation(experiment, question.open_causes)


def next_experiment_of(runs: Sequence[NextRun], open_bits: float, compared: int, subject: str) -> NextExperiment | None:
    """Return recommended runs with the reason; None for no runs."""
    if not runs:
        return None
    reason = recommendation_reason(runs[0], open_bits, compared, subject)
    return NextExperiment(tuple(runs), compared, reason, open_bits)


def _allowed(grid: Sequence[CandidateRun], study: Study, budget: ExperimentBudget) -> list[CandidateRun]:
    limits = budget.limits or limits_of_campaign(study)
    return [candidate for candidate in grid if limits.allow(candidate)]


def limits_of_campaign(study: Study) -> RigLimits:
    """Return limits that cover a campaign's own runs, and at least the default ones."""
    default = RigLimits()
    travel = max(float(np.max(run.coordinates.position_mm)) for run in study.runs)
    speed = max(float(np.max(run.coordinates.top_speed_mm_s)) for run in study.runs)
    return RigLimits(max(default.travel_mm, travel), max(default.speed_mm_s, speed), default.accel_mm_s2)


MAX_PAIRS = 3
"""Number of most similar pairs to separate where none is given."""


@single_blas_thread()
def recommend_for_pair(
    selection: RunSelection, nominal: CapsuleModel, pair: tuple[str, str] | None, budget: ExperimentBudget
) -> NextExperiment | None:
    """Recommend runs that separate effects at their default sizes.

    Parameters
    ----------
    pair
        Two effects on the force; default: the confused pairs, or the most similar one.

    Raises
    ------
    AnalysisError
        Where the runs do not show one of the two at all.
    """
    effects = [effect for effect in catalogue().values() if effect.has_force_signature]
    study = CapsuleStudy.of(selection, nominal, effects)
    point = gauss_newton_step(linearise(study, study.initial_z))

    def limited_to(names: Collection[str]) -> CapsuleStudy:
        return replace(study, effects=tuple(effect for effect in study.effects if effect.id in names))

    design = linearise(study if pair is None else limited_to(pair), point.z, dictionary=True)
    angles = SignatureAngles.of(design)
    pairs = [pair] if pair is not None else list(_closest_pairs(angles))
    missing = sorted({name for item in pairs for name in item} - set(angles.effects))
    if missing:
        raise AnalysisError(
            f"{missing[0]}: these runs do not show it at all; begin with a plan that does, such as paper."
        )
    candidates = _allowed(full_grid(campaign_specimen(study)), study, budget)
    study_of_names = limited_to({name for item in pairs for name in item})
    question = _which_of_two(study_of_names, design, angles, pairs)
    grams = _candidate_grams(study_of_names, design, candidates)
    runs = greedy_search(question, list(zip(candidates, grams, strict=True)), budget)
    between = (
        f"between {display_name('+'.join(pairs[0]))}" if len(pairs) == 1 else "between effects that are most alike"
    )
    return next_experiment_of(runs, question.open_bits, len(candidates), f"is open {between}")


def _closest_pairs(angles: SignatureAngles) -> Iterator[tuple[str, str]]:
    names = angles.effects
    sin2 = {
        (name, other_name): float(min(angles.sin2(name, other_name).min(), angles.sin2(other_name, name).min()))
        for index, name in enumerate(names)
        for other_name in names[index + 1 :]
    }
    ordered = sorted(sin2, key=lambda pair: sin2[pair])
    confused = [pair for pair in ordered if sin2[pair] < CONFUSED_SIN2]
    yield from (confused or ordered[:1])[:MAX_PAIRS]


def _which_of_two(
    study: Study, design: Design, angles: SignatureAngles, pairs: Sequence[tuple[str, str]]
) -> WhichOfTwo:
    """Return the question for some pairs, each effect by its variant that is nearest to the other one."""
    information = Information.of(design, [effect.id for effect in study.effects])

    def assumed(effect: str, rival: str) -> AssumedEffect:
        nearest = angles.variants_of_effect(effect)[int(np.argmin(angles.sin2(effect, rival)))]
        columns = information.columns_of(design, effect, angles.variants[nearest].variants)
        return AssumedEffect(effect, columns, np.eye(len(columns))[0])

    questions = [PairQuestion(assumed(*pair), assumed(*pair[::-1])) for pair in pairs]
    return WhichOfTwo(information, tuple(questions))


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
    selected: list[NextRun] = []
    reason = ""
    minutes = 0.0
    while len(selected) < budget.runs:
        # Of each the difference to the most similar motion so far, in each aspect.
        distances = [
            (
                min(np.abs(motion_features(run) - np.array(covered)), key=lambda apart: float(apart.max())),
                candidate,
                run,
            )
            for candidate, run in observed
        ]
        candidates = [
            item
            for item in distances
            if float(item[0].max()) >= MIN_LOG_DISTANCE and minutes + item[1].minutes <= budget.minutes
        ]
        if not candidates:
            break
        distance, candidate, observation = max(
            candidates, key=lambda item: float(item[0].max()) / (item[1].minutes + budget.hands_min)
        )
        reason = reason or _coverage_reason(candidate, distance, len(observed))
        selected.append(NextRun(candidate.step, candidate.minutes, None))
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


@dataclass(frozen=True, eq=False)
class WhatMovesAstray:
    """Which of the leading effects on the position is there: answered by the motions of runs."""

    runs: tuple[PositionErrors, ...]
    """Runs with different motions; their errors are not used."""
    assumed_effects: tuple[AssumedPositionEffect, ...]
    """Effects that may be present."""
    weights: Mapping[str, float]
    """Probability of each leading effect, those included that explain too little to be assumed."""
    before: "WhatMovesAstray | None" = None
    """With the runs so far alone; None for itself."""

    def with_run(self, observation: Sequence[PositionErrors]) -> "WhatMovesAstray":
        """Choose a further run by its motion, repeats included."""
        runs = (*self.runs, *observation)
        return WhatMovesAstray(runs, self.assumed_effects, self.weights, self.before or self)

    @property
    def open_bits(self) -> float:
        """Entropy of which effect is there, before the chosen runs."""
        return entropy_bits(self._probabilities, list(self.weights))

    @property
    def bits_to_change(self) -> float:
        """Least information of an outcome that makes another effect the likeliest."""
        return bits_to_change(self._probabilities.tolist())

    @property
    def bits(self) -> float:
        """Information of the chosen runs on which effect is there."""
        further = np.maximum(self.distances - (self.before or self).distances, 0.0)
        return expected_bits(self._probabilities, further, list(self.weights))

    def about(self, before: "WhatMovesAstray") -> tuple[str, ...]:
        """Return the two effects that are told apart most."""
        further = self.distances - before.distances
        first, second = np.unravel_index(int(np.argmax(further + further.T)), further.shape)
        names = list(self.weights)
        return names[int(first)], names[int(second)]

    @property
    def _probabilities(self) -> FloatArray:
        values = np.array(list(self.weights.values()))
        return np.asarray(values / values.sum())

    @cached_property
    def distances(self) -> FloatArray:
        """Distances that all runs put between the leading effects, each in turn assumed, shape `(N, N)`."""
        names = list(self.weights)
        distances = np.zeros((len(names), len(names)))
        for assumed in self.assumed_effects:
            first = names.index(assumed.effect)
            for rival, log_odds in self._log_odds(assumed):
                distances[first, names.index(rival)] = min(max(log_odds, 0.0), DECIDED_LOG_ODDS) / LOG_ODDS_PER_DISTANCE
        assumable = [name in {assumed.effect for assumed in self.assumed_effects} for name in names]
        # What is not assumed itself is as far from an assumed effect as that is from it.
        return np.where(np.array(assumable)[:, None], distances, distances.T)

    def _log_odds(self, assumed: AssumedPositionEffect) -> Iterator[tuple[str, float]]:
        """Yield the approximate log odds of a diagnosis for an assumed effect against each rival."""
        rivals = [name for name in self.weights if name != assumed.effect]
        runs = [replace(run, error_mm=assumed.error_in(run)) for run in self.runs]
        shares = {
            model_class.effect: model_class.held_out_share
            for model_class in score_model_classes(runs, (assumed.effect, *rivals))
        }
        for rival in rivals:
            remaining = min(max(shares[assumed.effect] - shares[rival], 0.0), 1.0)
            rival_odds = POSITION_RIVAL_SLOPE * max(remaining - CHANCE_SHARE, 0.0)
            explained = (shares[assumed.effect] - MIN_POSITION_SHARE) / (CLEAR_SHARE - MIN_POSITION_SHARE)
            yield rival, min(rival_odds, DECIDED_LOG_ODDS * explained)


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
    candidates = _allowed(motion_grid(campaign_specimen(study), whole=budget.runs > 1), study, budget)
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
    if not assumed_effects or len(leading) == 1:
        return None
    weights = {name: max(probability_of[name], MIN_WEIGHT) for name in leading}
    motions = tuple(map(_thinned_blocks, _distinct_motions(position.runs)))
    question = WhatMovesAstray(motions, assumed_effects, weights)
    thinned = [(candidate_run, (_thinned_blocks(run),) * candidate_run.step.repeats) for candidate_run, run in observed]
    runs = greedy_search(question, thinned, replace(budget, runs=min(budget.runs, MAX_NEXT_RUNS)), MAX_NEXT_RUNS)
    return next_experiment_of(runs, question.open_bits, len(observed), "is open about what leads the stage astray")


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


def recommend_next_run(weighed: WeighedCauses, budget: ExperimentBudget) -> Recommendation:
    """Recommend the next runs, for the force or for the position: whichever tells more per minute.

    Where nothing explains a position error, motions that were not made yet come first.
    """
    study, position, classification = weighed.study, weighed.position, weighed.verdict
    of_force = recommend_force_run(weighed, budget)
    if not position.has_position_error:
        return of_force
    of_position = recommend_position_run(study, position, classification.probabilities, budget)
    recommended = [experiment for experiment in (of_position, of_force.experiment) if experiment is not None]
    limitations = () if of_position is not None else tuple(_no_run_for_position(study, position, classification))
    best = max(recommended, key=_bits_per_minute, default=None)
    return replace(of_force, experiment=best, limitations=limitations)


def _bits_per_minute(experiment: NextExperiment) -> float:
    first = experiment.runs[0]
    return float("inf") if first.gain_bits is None else first.gain_bits / first.minutes


def _no_run_for_position(study: Study, position: PositionAnalysis, classification: Classification) -> Iterator[str]:
    if not isinstance(study, CapsuleStudy):
        return
    position_effects = {model_class.effect for model_class in position.model_classes}
    rivals = [name for name in classification.confusable_with if name in position_effects]
    if classification.verdict is Verdict.UNKNOWN:
        yield NO_NEW_MOTION
    elif rivals:
        names = [name for name in classification.effects if name in position_effects]
        apart = f"{display_name('+'.join(names))} from {display_name('+'.join(rivals))}"
        yield f"No candidate run would distinguish {apart} either."
