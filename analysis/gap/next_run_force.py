"""The next run for effects on the force: the one that separates the leading hypotheses best per minute."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, permutations
from typing import Self

import numpy as np

from dragrig.analysis import CapsuleModel, RunSelection, capitalise, percent_text, single_blas_thread
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
from dragrig.analysis.gap.design import (
    NUISANCES,
    RELATIVE_RIDGE,
    ColumnKind,
    Design,
    RankedEffect,
    Study,
    gauss_newton_step,
    linearise,
)
from dragrig.analysis.gap.diagnosis import ModelPair, NextExperiment, NextRun, display_name
from dragrig.analysis.gap.features import FORM_LOSS
from dragrig.analysis.gap.isolability import CONFUSED_SIN2, DETECTABLE_D_PRIME, SignatureAngles
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.config import AnalysisError, PlanStep
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue

LOG_ODDS_PER_SHARE = 14.0
"""Log odds per share of an effect's squares that a rival leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class AssumedEffect:
    """An effect assumed to be present: columns of the dictionary with amplitudes, in default sizes."""

    effect: str
    columns: tuple[int, ...]
    amplitude: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PairQuestion:
    """A pair to separate: an assumed effect and a rival, with a weight."""

    assumed: AssumedEffect
    rival: str
    weight: float


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
        numbered = [(number, variant) for number, variant in enumerate(self.variants) if variant.effect.id == effect]
        return [
            tuple(number for number, _ in group)
            for _, group in groupby(numbered, key=lambda pair: pair[1].quadrature_key)
        ]


def information_rows(design: Design, effects: Sequence[str]) -> FloatArray:
    """Return the rows of a design's Gram matrices for nuisances and the variants of some effects."""
    indices = [index for index, variant in enumerate(design.variants) if variant.effect.id in effects]
    return np.asarray(
        1 + np.concatenate((design.columns_of(*NUISANCES), design.columns_of(ColumnKind.VARIANT)[indices]))
    )


def separate_pair(information: Information, gram: FloatArray, question: PairQuestion) -> ModelPair:
    """Return how far an assumed effect is from a rival, from the projected Gram matrix."""
    assumed = question.assumed
    index = list(assumed.columns)
    squares = float(assumed.amplitude @ gram[np.ix_(index, index)] @ assumed.amplitude)
    moment = gram[:, index] @ assumed.amplitude
    absorbed = max(
        (_absorbed_chi2(information, gram, moment, variant) for variant in information.variants_of(question.rival)),
        default=0.0,
    )
    remaining = max(squares - absorbed, 0.0)
    return ModelPair(assumed.effect, question.rival, float(np.sqrt(remaining)), remaining / max(squares, 1e-12))


def expected_log_odds(pair: ModelPair) -> float:
    """Return the approximate log odds of a diagnosis, with form error and noise."""
    remaining = pair.d_prime**2
    if not pair.rival:
        return 0.5 * remaining
    squares = remaining / max(pair.remaining_share, 1e-12)
    return LOG_ODDS_PER_SHARE * pair.remaining_share + 0.5 * remaining / (1.0 + 0.5 * FORM_LOSS * squares)


def _absorbed_chi2(information: Information, gram: FloatArray, moment: FloatArray, variant: tuple[int, ...]) -> float:
    index = list(variant)
    gram_of_variant = gram[np.ix_(index, index)]
    strength = float(np.trace(gram_of_variant))
    if strength <= 1e-9:
        return 0.0
    if information.variants[index[0]].one_signed and moment[index[0]] < 0:
        return 0.0
    return float(moment[index] @ np.linalg.solve(gram_of_variant + 1e-9 * strength * np.eye(len(index)), moment[index]))


@dataclass(frozen=True, slots=True, eq=False)
class ForceSeparation:
    """Separation of pairs of effects on the force by the information of runs."""

    information: Information
    questions: tuple[PairQuestion, ...]

    def with_run(self, observation: FloatArray) -> Self:
        """Add a run by its Gram matrix."""
        return replace(self, information=self.information.with_run(observation))

    def separations(self) -> tuple[PairSeparation, ...]:
        """Return the separation of each pair."""
        gram = self.information.projected_gram()
        pairs = [(separate_pair(self.information, gram, question), question.weight) for question in self.questions]
        return tuple(PairSeparation(pair, expected_log_odds(pair), weight) for pair, weight in pairs)


def search_force_runs(
    study: Study,
    design: Design,
    questions: Sequence[PairQuestion],
    candidates: Sequence[CandidateRun],
    budget: ExperimentBudget,
) -> tuple[NextRun, ...]:
    """Return the runs that separate the pairs best, each given those before.

    Parameters
    ----------
    study, design
        Campaign, and its design with the dictionary around the fitted nominal parameters.
    questions
        Pairs with their weights; at least one.
    """
    names = {question.assumed.effect for question in questions} | {question.rival for question in questions}
    effects = [effect.id for effect in study.effects if effect.id in names]
    grams = _candidate_grams(
        replace(study, effects=tuple(effect for effect in study.effects if effect.id in effects)), design, candidates
    )
    model = ForceSeparation(Information.of(design, effects), tuple(questions))
    return greedy_search(model, list(zip(candidates, grams, strict=True)), budget)


def _candidate_grams(study: Study, design: Design, candidates: Sequence[CandidateRun]) -> list[FloatArray]:
    candidate_design = linearise(study_of_candidates(study, candidates), design.z, dictionary=True)
    rows = information_rows(candidate_design, [effect.id for effect in study.effects]).tolist()
    return [gram[rows][:, rows] for gram in candidate_design.grams]


LEADING_HYPOTHESES = 3
SURE_PROBABILITY = 0.9
"""Below this probability of the best hypothesis, remaining time is used even if all pairs seem decided: the expected
log odds only know the catalogue's forms."""
MIN_PAIR_WEIGHT = 0.05
"""Smallest weight of a leading effect, however improbable."""


def recommend_force_run(
    study: Study,
    design: Design,
    ranked: Sequence[RankedEffect],
    probabilities: Mapping[str, float],
    budget: ExperimentBudget,
    *,
    gap: bool,
) -> NextExperiment | None:
    """Recommend one run from the short grid, or several from the full grid.

    Parameters
    ----------
    design
        Design of the campaign around the nominal model, with the dictionary.
    ranked
        Best variant of each effect.
    probabilities
        Probabilities of hypotheses; several effects joined with `+`.
    budget
        Number of runs and rig time.
    gap
        Whether there is a gap; if not, the run is to lower the detection limit.

    Returns
    -------
    None if the nominal model is not the friction model, or no run would help.
    """
    if not isinstance(study, CapsuleStudy):
        return None
    questions = open_questions(study, design, ranked, probabilities, gap=gap)
    specimen = campaign_specimen(study)
    grid = short_grid(specimen) if budget.runs == 1 else full_grid(specimen)
    limits = budget.limits or limits_of_campaign(study)
    candidates = [candidate for candidate in grid if limits.allow(candidate)]
    if not questions or not candidates:
        return None
    sure = (
        max((value for name, value in probabilities.items() if name not in (NO_GAP, UNKNOWN)), default=0.0)
        > SURE_PROBABILITY
    )
    budget_for_search = replace(budget, use_all_time=not sure) if gap else replace(budget, decided_log_odds=UNBOUNDED)
    return next_experiment_of(
        search_force_runs(study, design, questions, candidates, budget_for_search), len(candidates)
    )


def next_experiment_of(runs: Sequence[NextRun], tried: int) -> NextExperiment | None:
    """Return recommended runs with the reason; None for no runs."""
    return NextExperiment(tuple(runs), tried, recommendation_reason(runs[0], tried)) if runs else None


def open_questions(
    study: Study, design: Design, ranked: Sequence[RankedEffect], probabilities: Mapping[str, float], *, gap: bool
) -> tuple[PairQuestion, ...]:
    """Return the pairs of leading hypotheses that a campaign leaves open."""
    probability_of = {
        entry.effect: marginal_probability(entry.effect, probabilities) for entry in ranked if entry.llr > 0 or not gap
    }
    if gap:
        order = sorted(probability_of, key=lambda name: -probability_of[name])[:LEADING_HYPOTHESES]
    else:
        periodic = {effect.id for effect in study.effects if effect.phase is not None}
        order = [name for name in probability_of if name not in periodic]
    ranked_by_effect = {entry.effect: entry for entry in ranked}
    information = Information.of(design, [effect.id for effect in study.effects if effect.id in order])
    assumed_effects = {name: _assumed_effect(information, design, ranked_by_effect[name], gap=gap) for name in order}
    return tuple(
        _pair_questions(assumed_effects, {name: max(probability_of[name], MIN_PAIR_WEIGHT) for name in order}, gap=gap)
    )


def limits_of_campaign(study: Study) -> RigLimits:
    """Return limits that cover a campaign's own runs, and at least the default ones."""
    default = RigLimits()
    travel = max(float(np.max(run.coordinates.position_mm)) for run in study.runs)
    speed = max(float(np.max(run.coordinates.top_speed_mm_s)) for run in study.runs)
    return RigLimits(max(default.travel_mm, travel), max(default.speed_mm_s, speed), default.accel_mm_s2)


def _pair_questions(
    assumed_effects: Mapping[str, AssumedEffect], weights: Mapping[str, float], *, gap: bool
) -> Iterator[PairQuestion]:
    if not gap:
        for name, assumed in assumed_effects.items():
            yield PairQuestion(assumed, "", weights[name])
        return
    for name_assumed, rival in permutations(assumed_effects, 2):
        yield PairQuestion(assumed_effects[name_assumed], rival, weights[name_assumed] * weights[rival])
    if len(assumed_effects) == 1:
        for name, assumed in assumed_effects.items():
            yield PairQuestion(assumed, "", weights[name])


def marginal_probability(effect: str, probabilities: Mapping[str, float]) -> float:
    """Return the probability of an effect, alone or with others."""
    return sum(value for name, value in probabilities.items() if effect in name.split("+"))


def _assumed_effect(information: Information, design: Design, ranked: RankedEffect, *, gap: bool) -> AssumedEffect:
    """Return an effect as fitted, or without a gap at its detection limit."""
    columns = information.columns_of(design, ranked.effect, ranked.variants)
    if gap:
        return AssumedEffect(ranked.effect, columns, ranked.amplitude)
    amplitude = np.zeros(len(columns))
    amplitude[0] = DETECTABLE_D_PRIME / max(ranked.d_prime_per_unit, 1e-9)
    return AssumedEffect(ranked.effect, columns, amplitude)


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
    study_of_pair = (
        study
        if pair is None
        else replace(study, effects=tuple(effect for effect in study.effects if effect.id in pair))
    )
    design = linearise(study_of_pair, point.z, dictionary=True)
    angles = SignatureAngles.of(design)
    pairs = [pair] if pair is not None else list(_closest_pairs(angles))
    missing = sorted({name for item in pairs for name in item} - set(angles.effects))
    if missing:
        raise AnalysisError(
            f"{missing[0]}: these runs do not show it at all; begin with a plan that does, such as paper."
        )
    limits = budget.limits or limits_of_campaign(study)
    candidates = [candidate for candidate in full_grid(campaign_specimen(study)) if limits.allow(candidate)]
    questions = _questions_of_pairs(study_of_pair, design, angles, pairs)
    return next_experiment_of(search_force_runs(study_of_pair, design, questions, candidates, budget), len(candidates))


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


def _questions_of_pairs(
    study: Study, design: Design, angles: SignatureAngles, pairs: Sequence[tuple[str, str]]
) -> tuple[PairQuestion, ...]:
    """Return both questions for each pair, with the variant of the assumed effect nearest to the rival."""
    names = {name for pair in pairs for name in pair}
    information = Information.of(design, [effect.id for effect in study.effects if effect.id in names])
    questions = []
    for pair in pairs:
        for assumed, rival in (pair, pair[::-1]):
            nearest = angles.variants_of_effect(assumed)[int(np.argmin(angles.sin2(assumed, rival)))]
            columns = information.columns_of(design, assumed, angles.variants[nearest].variants)
            amplitude = np.zeros(len(columns))
            amplitude[0] = 1.0
            questions.append(PairQuestion(AssumedEffect(assumed, columns, amplitude), rival, 1.0))
    return tuple(questions)


MAX_QUOTED_SHARE = 0.9
"""Shares above this are not quoted: the rival hardly resembles the assumed effect."""


def run_text(step: PlanStep) -> str:
    """Describe a run: a drag at 1 mm/s over 20 mm."""
    settings = step.parameters
    match step.kind:
        case "relaxation":
            strain, hold = settings["shear_strain"], settings["hold_s"]
            assert isinstance(strain, float)  # noqa: S101  # the grid's own
            text = f"a relaxation at {100 * strain:g} % strain with a hold of {hold:g} s"
        case "motion":
            strokes = settings["strokes"]
            assert isinstance(strokes, list | tuple)  # noqa: S101
            first = strokes[0]
            text = f"a drag of {first['travel_mm']:g} mm and back at {first['speed_mm_s']:g} mm/s in one record"
        case kind:
            noun = {"coulomb": "a Coulomb run", "blank": "a blank run"}.get(kind, f"a {kind}")
            text = f"{noun} at {settings['speed_mm_s']:g} mm/s over {settings['travel_mm']:g} mm"
            if settings.get("accel_mm_s2", 400.0) != 400.0:
                text += f", accelerated with {settings['accel_mm_s2']:g} mm/s²"
    if step.kind == "drag" and step.wait_s != 60.0:
        text += f" after {step.wait_s:g} s of rest"
    if step.repeats == 1:
        return text
    return f"{text}, twice" if step.repeats == 2 else f"{text}, {step.repeats} times"


def recommendation_reason(run: NextRun, tried: int) -> str:
    """Say why a run is recommended, with numbers, and whether it is optional."""
    text = f"{run_subject(run.step)} {separation_text(run.before, run.after)}"
    return (
        f"{'The leading hypotheses are already separated well enough. ' if run.optional else ''}{text} "
        f"in {run.minutes:.1f} min of rig time, the largest gain per minute of {tried} candidate runs."
    )


def run_subject(step: PlanStep) -> str:
    """Return a run as the begin of a sentence."""
    return capitalise(run_text(step)) + ("," if step.repeats > 1 else "")


def separation_text(before: ModelPair, after: ModelPair) -> str:
    """Say what a run separates, as the rest of a sentence."""
    change = f"d′ grows from {before.d_prime:.1f} to {after.d_prime:.1f}"
    if not after.rival:
        return f"lowers the detection limit of {display_name(after.truth)}: {change}"
    truth, rival = display_name(after.truth), display_name(after.rival)
    text = f"separates {truth} from {rival}: {change}"
    if before.remaining_share > MAX_QUOTED_SHARE:
        return text
    shares = f"from {percent_text(before.remaining_share)} to {percent_text(after.remaining_share)}"
    return f"{text}, and the share of {truth} that {rival} cannot explain {shares}"
