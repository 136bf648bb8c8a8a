"""The next run for effects on the force: the one that separates the leading hypotheses best per minute."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, permutations
from typing import Self

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.gap.candidate_runs import (
    UNBOUNDED,
    CandidateRun,
    ExperimentBudget,
    PairSeparation,
    RigLimits,
    campaign_specimen,
    full_grid,
    greedy_search,
    short_grid,
    study_of_candidates,
)
from dragrig.analysis.gap.candidates import EffectVariant
from dragrig.analysis.gap.classifier import NO_GAP, UNKNOWN
from dragrig.analysis.gap.design import ColumnKind, Design, Study, linearise
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun
from dragrig.analysis.gap.diagnosis_text import recommendation_reason
from dragrig.analysis.gap.isolability import CONFUSED_SIN2, DETECTABLE_D_PRIME, SignatureAngles
from dragrig.analysis.gap.linear_fit import NUISANCES, RELATIVE_RIDGE, RankedEffect, gauss_newton_step
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import catalogue

FORM_LOSS_OF_RIVAL = 0.12
"""Part of an effect's squares that its real form may cost it against a wrong one."""
LOG_ODDS_PER_SHARE = 14.0
"""Log odds for each share of an effect's squares that a rival leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedEffect:
    """An effect as it may be there: columns of the ground's shapes with amplitudes, in usual sizes."""

    effect: str
    columns: tuple[int, ...]
    amplitude: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PairQuestion:
    """A contest to be decided: an effect that may be there against a rival, with how much it matters."""

    assumed: AssumedEffect
    rival: str
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What runs say of the shapes of some effects.

    Attributes
    ----------
    gram
        Gram matrix of nuisances and shapes, whitened and summed over runs.
    prior_precision
        Of the nuisances' priors.
    variants
        The shapes, in the order of the last columns.
    """

    gram: FloatArray
    prior_precision: FloatArray
    variants: tuple[EffectVariant, ...]

    @classmethod
    def of(cls, design: Design, effects: Sequence[str]) -> "Information":
        """Take what belongs to some effects out of a design with its dictionary."""
        rows = information_rows(design, effects)
        nuisances = design.columns_of(*NUISANCES)
        variants = tuple(variant for variant in design.variants if variant.effect.id in effects)
        return cls(design.total_gram()[np.ix_(rows, rows)], design.prior_precision[nuisances], variants)

    def with_run(self, gram: FloatArray) -> "Information":
        """Add a run, whose Gram matrix has the same columns."""
        return replace(self, gram=self.gram + gram)

    def projected_gram(self) -> FloatArray:
        """Return the products of the shapes once nuisances have taken what they can."""
        count = len(self.prior_precision)
        own, across = self.gram[:count, :count], self.gram[:count, count:]
        whole = own + np.diag(self.prior_precision + RELATIVE_RIDGE * np.diag(own))
        return np.asarray(self.gram[count:, count:] - across.T @ np.linalg.solve(whole, across))

    def variants_of(self, effect: str) -> list[tuple[int, ...]]:
        """Return the columns of each form of an effect; two for what is periodic."""
        numbered = [(number, variant) for number, variant in enumerate(self.variants) if variant.effect.id == effect]
        return [
            tuple(number for number, _ in group)
            for _, group in groupby(numbered, key=lambda pair: pair[1].quadrature_key)
        ]


def information_rows(design: Design, effects: Sequence[str]) -> FloatArray:
    """Return the rows of a design's Gram matrices that hold nuisances and the shapes of some effects."""
    wanted = [place for place, variant in enumerate(design.variants) if variant.effect.id in effects]
    return np.asarray(
        1 + np.concatenate((design.columns_of(*NUISANCES), design.columns_of(ColumnKind.VARIANT)[wanted]))
    )


def separate_pair(information: Information, gram: FloatArray, question: PairQuestion) -> ModelPair:
    """Say how far a truth is from a rival, by the ground's projected products."""
    truth = question.assumed
    index = list(truth.columns)
    squares = float(truth.amplitude @ gram[np.ix_(index, index)] @ truth.amplitude)
    along = gram[:, index] @ truth.amplitude
    taken = max(
        (_absorbed_chi2(information, gram, along, form) for form in information.variants_of(question.rival)),
        default=0.0,
    )
    left = max(squares - taken, 0.0)
    return ModelPair(truth.effect, question.rival, float(np.sqrt(left)), left / max(squares, 1e-12))


def expected_log_odds(pair: ModelPair) -> float:
    """Return about how sure a diagnosis can be of the truth, forms being foreign and noise being there."""
    left = pair.d_prime**2
    if not pair.rival:
        return 0.5 * left
    squares = left / max(pair.remaining_share, 1e-12)
    return LOG_ODDS_PER_SHARE * pair.remaining_share + 0.5 * left / (1.0 + 0.5 * FORM_LOSS_OF_RIVAL * squares)


def _absorbed_chi2(ground: Information, gram: FloatArray, along: FloatArray, form: tuple[int, ...]) -> float:
    index = list(form)
    own = gram[np.ix_(index, index)]
    strength = float(np.trace(own))
    if strength <= 1e-9:
        return 0.0
    if ground.variants[index[0]].one_signed and along[index[0]] < 0:
        return 0.0
    return float(along[index] @ np.linalg.solve(own + 1e-9 * strength * np.eye(len(index)), along[index]))


@dataclass(frozen=True, slots=True, eq=False)
class ForceSeparation:
    """What runs say of the shapes of effects, and what is asked."""

    information: Information
    questions: tuple[PairQuestion, ...]

    def with_run(self, observation: FloatArray) -> Self:
        """Add a run by its Gram matrix."""
        return replace(self, information=self.information.with_run(observation))

    def separations(self) -> tuple[PairSeparation, ...]:
        """Return how far each question is answered."""
        gram = self.information.projected_gram()
        decided = [separate_pair(self.information, gram, question) for question in self.questions]
        return tuple(
            PairSeparation(pair, expected_log_odds(pair), asked.weight)
            for pair, asked in zip(decided, self.questions, strict=True)
        )


def search_force_runs(
    study: Study,
    design: Design,
    questions: Sequence[PairQuestion],
    trials: Sequence[CandidateRun],
    budget: ExperimentBudget,
) -> tuple[NextRun, ...]:
    """Return the runs that answer most of what is asked of the force, each the best after those before.

    Parameters
    ----------
    study, design
        The campaign, and its design with the dictionary around the point that nominal parameters came to.
    questions
        Contests with their weights; at least one.
    """
    effects = _asked_effects(study, questions)
    grams = _candidate_grams(
        replace(study, effects=tuple(effect for effect in study.effects if effect.id in effects)), design, trials
    )
    field = ForceSeparation(Information.of(design, effects), tuple(questions))
    return greedy_search(field, list(zip(trials, grams, strict=True)), budget)


def _asked_effects(study: Study, questions: Sequence[PairQuestion]) -> list[str]:
    named = {question.assumed.effect for question in questions} | {question.rival for question in questions}
    return [effect.id for effect in study.effects if effect.id in named]


def _candidate_grams(study: Study, design: Design, trials: Sequence[CandidateRun]) -> list[FloatArray]:
    laid_out = linearise(study_of_candidates(study, trials), design.z, dictionary=True)
    rows = information_rows(laid_out, [effect.id for effect in study.effects]).tolist()
    return [values[rows][:, rows] for values in laid_out.grams]


LEADING_HYPOTHESES = 3
SURE_PROBABILITY = 0.9
"""Below this probability of what is named, runs go on where the contests alone seem decided: these know the catalogue's
forms only."""
MIN_PAIR_WEIGHT = 0.05
"""A leading effect counts for so much however improbable it is."""


def recommend_force_run(
    study: Study,
    design: Design,
    ranked: Sequence[RankedEffect],
    probabilities: Mapping[str, float],
    budget: ExperimentBudget,
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
    questions = open_questions(study, design, ranked, probabilities, gap=gap)
    specimen = campaign_specimen(study)
    grid = short_grid(specimen) if budget.runs == 1 else full_grid(specimen)
    limits = budget.limits or limits_of_campaign(study)
    trials = [candidate for candidate in grid if limits.allow(candidate)]
    if not questions or not trials:
        return None
    sure = (
        max((value for name, value in probabilities.items() if name not in (NO_GAP, UNKNOWN)), default=0.0)
        > SURE_PROBABILITY
    )
    wanted = replace(budget, use_all_time=not sure) if gap else replace(budget, decided_log_odds=UNBOUNDED)
    return next_experiment_of(search_force_runs(study, design, questions, trials, wanted), len(trials))


def next_experiment_of(runs: Sequence[NextRun], tried: int) -> NextExperiment | None:
    """Return what was found with its reason; None where nothing was."""
    return NextExperiment(tuple(runs), tried, recommendation_reason(runs[0], tried)) if runs else None


def open_questions(
    study: Study, design: Design, ranked: Sequence[RankedEffect], probabilities: Mapping[str, float], *, gap: bool
) -> tuple[PairQuestion, ...]:
    """Return what a campaign leaves open between its leading hypotheses."""
    chances = {
        best.effect: marginal_probability(best.effect, probabilities) for best in ranked if best.llr > 0 or not gap
    }
    if gap:
        order = sorted(chances, key=lambda name: -chances[name])[:LEADING_HYPOTHESES]
    else:
        periodic = {effect.id for effect in study.effects if effect.phase is not None}
        order = [name for name in chances if name not in periodic]
    known = {best.effect: best for best in ranked}
    ground = Information.of(design, [effect.id for effect in study.effects if effect.id in order])
    truths = {name: _assumed_effect(ground, design, known[name], gap=gap) for name in order}
    return tuple(_pair_questions(truths, {name: max(chances[name], MIN_PAIR_WEIGHT) for name in order}, gap=gap))


def limits_of_campaign(study: Study) -> RigLimits:
    """Return what a campaign's own runs say that the rig can do, the shipped plans' at least."""
    usual = RigLimits()
    travel = max(float(np.max(run.coordinates.position_mm)) for run in study.runs)
    speed = max(float(np.max(run.coordinates.top_speed_mm_s)) for run in study.runs)
    return RigLimits(max(usual.travel_mm, travel), max(usual.speed_mm_s, speed), usual.accel_mm_s2)


def _pair_questions(
    truths: Mapping[str, AssumedEffect], weights: Mapping[str, float], *, gap: bool
) -> Iterator[PairQuestion]:
    if not gap:
        for name, truth in truths.items():
            yield PairQuestion(truth, "", weights[name])
        return
    for label, other in permutations(truths, 2):
        yield PairQuestion(truths[label], other, weights[label] * weights[other])
    if len(truths) == 1:
        for name, truth in truths.items():
            yield PairQuestion(truth, "", weights[name])


def marginal_probability(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return how probable an effect is, alone or with others."""
    return sum(value for name, value in probabilities.items() if effect in name.split("+"))


def _assumed_effect(ground: Information, design: Design, ranked: RankedEffect, *, gap: bool) -> AssumedEffect:
    """Return an effect as it was fitted; without a gap, as large as it would just be seen."""
    own = [place for place, shape in enumerate(design.variants) if shape.effect.id == ranked.effect]
    before = [place for place, shape in enumerate(ground.variants) if shape.effect.id == ranked.effect]
    columns = tuple(before[own.index(place)] for place in ranked.variants)
    if gap:
        return AssumedEffect(ranked.effect, columns, ranked.amplitude)
    amplitude = np.zeros(len(columns))
    amplitude[0] = DETECTABLE_D_PRIME / max(ranked.d_prime_per_unit, 1e-9)
    return AssumedEffect(ranked.effect, columns, amplitude)


MAX_PAIRS = 3
"""So many of the closest pairs are looked at where none is named."""


@single_blas_thread()
def recommend_for_pair(
    selection: RunSelection, nominal: CapsuleModel, pair: tuple[str, str] | None, budget: ExperimentBudget
) -> NextExperiment | None:
    """Recommend runs that set effects apart.

    Parameters
    ----------
    pair
        Two effects of the force; those that the runs hardly tell apart unless given, the closest if there are none.

    Raises
    ------
    AnalysisError
        Where the runs show one of the two not at all and no run could be compared with.
    """
    effects = [effect for effect in catalogue().values() if effect.has_force_signature]
    study = CapsuleStudy.of(selection, nominal, effects)
    point = gauss_newton_step(linearise(study, study.initial_z))
    wanted = (
        study
        if pair is None
        else replace(study, effects=tuple(effect for effect in study.effects if effect.id in pair))
    )
    design = linearise(wanted, point.z, dictionary=True)
    angles = SignatureAngles.of(design)
    pairs = [pair] if pair is not None else list(_closest_pairs(angles))
    lacking = sorted({name for item in pairs for name in item} - set(angles.effects))
    if lacking:
        raise AnalysisError(f"{lacking[0]}: these runs do not show it at all; begin with a plan that does, as paper.")
    limits = budget.limits or limits_of_campaign(study)
    trials = [candidate for candidate in full_grid(campaign_specimen(study)) if limits.allow(candidate)]
    questions = _questions_of_pairs(wanted, design, angles, pairs)
    return next_experiment_of(search_force_runs(wanted, design, questions, trials, budget), len(trials))


def _closest_pairs(angles: SignatureAngles) -> Iterator[tuple[str, str]]:
    names = angles.effects
    apart = {
        (name, label): float(min(angles.sin2(name, label).min(), angles.sin2(label, name).min()))
        for place, name in enumerate(names)
        for label in names[place + 1 :]
    }
    ordered = sorted(apart, key=lambda pair: apart[pair])
    close = [pair for pair in ordered if apart[pair] < CONFUSED_SIN2]
    yield from (close or ordered[:1])[:MAX_PAIRS]


def _questions_of_pairs(
    study: Study, design: Design, angles: SignatureAngles, pairs: Sequence[tuple[str, str]]
) -> tuple[PairQuestion, ...]:
    """Ask of each pair both ways, with the form of the first that the second comes nearest to."""
    named = {name for pair in pairs for name in pair}
    ground = Information.of(design, [effect.id for effect in study.effects if effect.id in named])
    questions = []
    for pair in pairs:
        for truth, rival in (pair, pair[::-1]):
            nearest = angles.variants_of_effect(truth)[int(np.argmin(angles.sin2(truth, rival)))]
            own = [place for place, shape in enumerate(design.variants) if shape.effect.id == truth]
            before = [place for place, shape in enumerate(ground.variants) if shape.effect.id == truth]
            columns = tuple(before[own.index(place)] for place in angles.variants[nearest].variants)
            amplitude = np.zeros(len(columns))
            amplitude[0] = 1.0
            questions.append(PairQuestion(AssumedEffect(truth, columns, amplitude), rival, 1.0))
    return tuple(questions)
