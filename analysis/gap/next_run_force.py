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
from dragrig.sim_backend.effects.base import ForceEffect, SensorEffect, catalogue

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

    truth: AssumedEffect
    rival: str
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What runs say of the shapes of some effects.

    Attributes
    ----------
    total
        Gram matrix of nuisances and shapes, whitened and summed over runs.
    precision
        Of the nuisances' priors.
    shapes
        The shapes, in the order of the last columns.
    """

    total: FloatArray
    precision: FloatArray
    shapes: tuple[EffectVariant, ...]

    @classmethod
    def of(cls, design: Design, effects: Sequence[str]) -> "Information":
        """Take what belongs to some effects out of a design with its dictionary."""
        rows = information_rows(design, effects)
        nuisances = design.of(*NUISANCES)
        kept = tuple(one for one in design.shapes if one.effect.id in effects)
        return cls(design.total()[np.ix_(rows, rows)], design.prior_precision[nuisances], kept)

    def with_run(self, gram: FloatArray) -> "Information":
        """Add a run, whose Gram matrix has the same columns."""
        return replace(self, total=self.total + gram)

    def projected(self) -> FloatArray:
        """Return the products of the shapes once nuisances have taken what they can."""
        count = len(self.precision)
        own, across = self.total[:count, :count], self.total[:count, count:]
        whole = own + np.diag(self.precision + RELATIVE_RIDGE * np.diag(own))
        return np.asarray(self.total[count:, count:] - across.T @ np.linalg.solve(whole, across))

    def forms(self, effect: str) -> list[tuple[int, ...]]:
        """Return the columns of each form of an effect; two for what is periodic."""
        numbered = [(number, one) for number, one in enumerate(self.shapes) if one.effect.id == effect]
        return [tuple(number for number, _ in group) for _, group in groupby(numbered, key=lambda pair: pair[1].twin)]


def information_rows(design: Design, effects: Sequence[str]) -> FloatArray:
    """Return the rows of a design's Gram matrices that hold nuisances and the shapes of some effects."""
    wanted = [place for place, one in enumerate(design.shapes) if one.effect.id in effects]
    return np.asarray(1 + np.concatenate((design.of(*NUISANCES), design.of(ColumnKind.SHAPE)[wanted])))


def separate_pair(ground: Information, gram: FloatArray, question: PairQuestion) -> ModelPair:
    """Say how far a truth is from a rival, by the ground's projected products."""
    truth = question.truth
    index = list(truth.columns)
    squares = float(truth.amplitude @ gram[np.ix_(index, index)] @ truth.amplitude)
    along = gram[:, index] @ truth.amplitude
    taken = max((_absorbed_chi2(ground, gram, along, form) for form in ground.forms(question.rival)), default=0.0)
    left = max(squares - taken, 0.0)
    return ModelPair(truth.effect, question.rival, float(np.sqrt(left)), left / max(squares, 1e-12))


def expected_log_odds(one: ModelPair) -> float:
    """Return about how sure a diagnosis can be of the truth, forms being foreign and noise being there."""
    left = one.d_prime**2
    if not one.rival:
        return 0.5 * left
    squares = left / max(one.left, 1e-12)
    return LOG_ODDS_PER_SHARE * one.left + 0.5 * left / (1.0 + 0.5 * FORM_LOSS_OF_RIVAL * squares)


def _absorbed_chi2(ground: Information, gram: FloatArray, along: FloatArray, form: tuple[int, ...]) -> float:
    index = list(form)
    own = gram[np.ix_(index, index)]
    strength = float(np.trace(own))
    if strength <= 1e-9:
        return 0.0
    if ground.shapes[index[0]].signed and along[index[0]] < 0:
        return 0.0
    return float(along[index] @ np.linalg.solve(own + 1e-9 * strength * np.eye(len(index)), along[index]))


@dataclass(frozen=True, slots=True, eq=False)
class ForceSeparation:
    """What runs say of the shapes of effects, and what is asked."""

    ground: Information
    questions: tuple[PairQuestion, ...]

    def with_run(self, seen: FloatArray) -> Self:
        """Add a run by its Gram matrix."""
        return replace(self, ground=self.ground.with_run(seen))

    def answers(self) -> tuple[PairSeparation, ...]:
        """Return how far each question is answered."""
        gram = self.ground.projected()
        decided = [separate_pair(self.ground, gram, one) for one in self.questions]
        return tuple(
            PairSeparation(one, expected_log_odds(one), asked.weight)
            for one, asked in zip(decided, self.questions, strict=True)
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
        replace(study, effects=tuple(one for one in study.effects if one.id in effects)), design, trials
    )
    field = ForceSeparation(Information.of(design, effects), tuple(questions))
    return greedy_search(field, list(zip(trials, grams, strict=True)), budget)


def _asked_effects(study: Study, questions: Sequence[PairQuestion]) -> list[str]:
    named = {one.truth.effect for one in questions} | {one.rival for one in questions}
    return [one.id for one in study.effects if one.id in named]


def _candidate_grams(study: Study, design: Design, trials: Sequence[CandidateRun]) -> list[FloatArray]:
    laid_out = linearise(study_of_candidates(study, trials), design.z, dictionary=True)
    rows = information_rows(laid_out, [one.id for one in study.effects]).tolist()
    return [one[rows][:, rows] for one in laid_out.grams]


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
    asked = open_questions(study, design, ranked, probabilities, gap=gap)
    specimen = campaign_specimen(study)
    grid = short_grid(specimen) if budget.runs == 1 else full_grid(specimen)
    limits = budget.limits or limits_of_campaign(study)
    trials = [one for one in grid if limits.allow(one)]
    if not asked or not trials:
        return None
    sure = (
        max((value for name, value in probabilities.items() if name not in (NO_GAP, UNKNOWN)), default=0.0)
        > SURE_PROBABILITY
    )
    wanted = replace(budget, spent_whole=not sure) if gap else replace(budget, enough=UNBOUNDED)
    return next_experiment_of(search_force_runs(study, design, asked, trials, wanted), len(trials))


def next_experiment_of(found: Sequence[NextRun], tried: int) -> NextExperiment | None:
    """Return what was found with its reason; None where nothing was."""
    return NextExperiment(tuple(found), tried, recommendation_reason(found[0], tried)) if found else None


def open_questions(
    study: Study, design: Design, ranked: Sequence[RankedEffect], probabilities: Mapping[str, float], *, gap: bool
) -> tuple[PairQuestion, ...]:
    """Return what a campaign leaves open between its leading hypotheses."""
    chances = {one.effect: marginal_probability(one.effect, probabilities) for one in ranked if one.gain > 0 or not gap}
    if gap:
        order = sorted(chances, key=lambda name: -chances[name])[:LEADING_HYPOTHESES]
    else:
        periodic = {one.id for one in study.effects if one.phase is not None}
        order = [name for name in chances if name not in periodic]
    known = {one.effect: one for one in ranked}
    ground = Information.of(design, [one.id for one in study.effects if one.id in order])
    truths = {name: _assumed_effect(ground, design, known[name], gap=gap) for name in order}
    return tuple(_pair_questions(truths, {name: max(chances[name], MIN_PAIR_WEIGHT) for name in order}, gap=gap))


def limits_of_campaign(study: Study) -> RigLimits:
    """Return what a campaign's own runs say that the rig can do, the shipped plans' at least."""
    usual = RigLimits()
    travel = max(float(np.max(one.coordinates.position_mm)) for one in study.sights)
    speed = max(float(np.max(one.coordinates.top_speed_mm_s)) for one in study.sights)
    return RigLimits(max(usual.travel_mm, travel), max(usual.speed_mm_s, speed), usual.accel_mm_s2)


def _pair_questions(
    truths: Mapping[str, AssumedEffect], weights: Mapping[str, float], *, gap: bool
) -> Iterator[PairQuestion]:
    if not gap:
        for name, truth in truths.items():
            yield PairQuestion(truth, "", weights[name])
        return
    for one, other in permutations(truths, 2):
        yield PairQuestion(truths[one], other, weights[one] * weights[other])
    if len(truths) == 1:
        for name, truth in truths.items():
            yield PairQuestion(truth, "", weights[name])


def marginal_probability(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return how probable an effect is, alone or with others."""
    return sum(value for name, value in probabilities.items() if effect in name.split("+"))


def _assumed_effect(ground: Information, design: Design, one: RankedEffect, *, gap: bool) -> AssumedEffect:
    """Return an effect as it was fitted; without a gap, as large as it would just be seen."""
    own = [place for place, shape in enumerate(design.shapes) if shape.effect.id == one.effect]
    before = [place for place, shape in enumerate(ground.shapes) if shape.effect.id == one.effect]
    columns = tuple(before[own.index(place)] for place in one.shapes)
    if gap:
        return AssumedEffect(one.effect, columns, one.amplitude)
    amplitude = np.zeros(len(columns))
    amplitude[0] = DETECTABLE_D_PRIME / max(one.per_unit, 1e-9)
    return AssumedEffect(one.effect, columns, amplitude)


HUM_EFFECT = "mains_hum"
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
    effects = [
        one for one in catalogue().values() if isinstance(one, ForceEffect | SensorEffect) and one.id != HUM_EFFECT
    ]
    study = CapsuleStudy.of(selection, nominal, effects)
    point = gauss_newton_step(linearise(study, study.start))
    wanted = study if pair is None else replace(study, effects=tuple(one for one in study.effects if one.id in pair))
    design = linearise(wanted, point.z, dictionary=True)
    angles = SignatureAngles.of(design)
    pairs = [pair] if pair is not None else list(_closest_pairs(angles))
    lacking = sorted({name for one in pairs for name in one} - set(angles.effects))
    if lacking:
        raise AnalysisError(f"{lacking[0]}: these runs do not show it at all; begin with a plan that does, as paper.")
    limits = budget.limits or limits_of_campaign(study)
    trials = [one for one in full_grid(campaign_specimen(study)) if limits.allow(one)]
    asked = _questions_of_pairs(wanted, design, angles, pairs)
    return next_experiment_of(search_force_runs(wanted, design, asked, trials, budget), len(trials))


def _closest_pairs(angles: SignatureAngles) -> Iterator[tuple[str, str]]:
    names = angles.effects
    apart = {
        (one, other): float(min(angles.sin2(one, other).min(), angles.sin2(other, one).min()))
        for place, one in enumerate(names)
        for other in names[place + 1 :]
    }
    ordered = sorted(apart, key=lambda pair: apart[pair])
    close = [pair for pair in ordered if apart[pair] < CONFUSED_SIN2]
    yield from (close or ordered[:1])[:MAX_PAIRS]


def _questions_of_pairs(
    study: Study, design: Design, angles: SignatureAngles, pairs: Sequence[tuple[str, str]]
) -> tuple[PairQuestion, ...]:
    """Ask of each pair both ways, with the form of the first that the second comes nearest to."""
    named = {name for pair in pairs for name in pair}
    ground = Information.of(design, [one.id for one in study.effects if one.id in named])
    asked = []
    for pair in pairs:
        for truth, rival in (pair, pair[::-1]):
            nearest = angles.of_effect(truth)[int(np.argmin(angles.sin2(truth, rival)))]
            own = [place for place, shape in enumerate(design.shapes) if shape.effect.id == truth]
            before = [place for place, shape in enumerate(ground.shapes) if shape.effect.id == truth]
            columns = tuple(before[own.index(place)] for place in angles.forms[nearest].shapes)
            amplitude = np.zeros(len(columns))
            amplitude[0] = 1.0
            asked.append(PairQuestion(AssumedEffect(truth, columns, amplitude), rival, 1.0))
    return tuple(asked)
