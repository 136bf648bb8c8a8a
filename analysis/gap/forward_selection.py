"""Search for the effects that explain the force: each effect alone first, then forward selection of further ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Design, RunDesign, Study, linearise
from dragrig.analysis.gap.features import NonparametricLaw
from dragrig.analysis.gap.hypothesis_fit import (
    HypothesisFit,
    all_periodic_in_session,
    fit_hypothesis,
    is_periodic_in_session,
    rank_with_free_phases,
    refit_with_effect,
)
from dragrig.analysis.gap.linear_fit import (
    NUISANCES,
    ParameterPoint,
    RankedEffect,
    gauss_newton,
    gauss_newton_step,
    project_dictionary,
    rank_effects,
)
from dragrig.analysis.gap.nonparametric import fit_nonparametric_laws
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class ForceSearchResult:
    """Everything that was tried on the force of a campaign.

    Attributes
    ----------
    nominal
        The nominal model refitted, with the dictionary.
    chi2
        Whitened squares that it leaves.
    ranked
        The best shape of each effect against it.
    singles
        Those that were refitted, the best first; then further effects that were refitted on their own.
    steps
        Each further effect beside those before that was tried, with what it took away beforehand.
    """

    study: Study
    nominal: Design
    chi2: float
    ranked: tuple[RankedEffect, ...]
    singles: tuple[HypothesisFit, ...]
    steps: tuple["SelectionStep", ...]

    @property
    def block_count(self) -> int:
        """Number of blocks: what the squares of noise come to."""
        return sum(self.nominal.block_counts)

    @cached_property
    def excess(self) -> float:
        """Squares above noise that the nominal model leaves."""
        return self.chi2 - self.block_count

    def explained_share(self, chi2: float) -> float:
        """Return the share of the excess that is explained when so many squares remain."""
        return 1.0 - (chi2 - self.block_count) / max(self.excess, 1.0)

    def merit(self, fit: HypothesisFit) -> float:
        """Return how well an explanation does: its share as it is, and with a foreign form.

        What is periodic in time may have lost its phase from run to run, and counts as the latter alone.
        """
        plain, flexible = self.explained_share(fit.chi2), self.explained_share(fit.chi2_with_form_error)
        return (
            flexible
            if any(is_periodic_in_session(candidate.effect) for candidate in fit.parameters.candidates)
            else 0.5 * (plain + flexible)
        )


@dataclass(frozen=True, slots=True, eq=False)
class SelectionStep:
    """A further effect beside those before, whose form is in doubt in all of these numbers.

    Attributes
    ----------
    effect
        Which.
    llr
        Half the squares that it takes away beside the others, which may have foreign forms.
    rival_llr
        What the next best takes away in its place.
    chi2_without
        Squares that remain without it.
    laws
        What laws without a name leave in its place, the best first.
    fit
        The refit; None where the gain was not worth one.
    """

    effect: str
    llr: float
    rival_llr: float
    chi2_without: float
    laws: tuple[NonparametricLaw, ...]
    fit: HypothesisFit | None


FORM_ERROR_SD = 0.25
"""So much of what effects add is doubted, one standard deviation: real ones leave 10 to 40 % of a catalogue's form."""


def inflate_by_form_error(design: Design) -> Design:
    """Return a design whose noise grows with what its candidates add.

    A foreign form leaves most where an effect is largest, and there a second one can hardly be told from it; where the
    first does little, the same force cannot be its own.
    """
    pairs = zip(design.runs, design.grams, strict=True)
    items = [_inflated_run(run) if run.effect_force.any() else (run, gram) for run, gram in pairs]
    return replace(design, runs=tuple(run_design for run_design, _ in items), grams=tuple(gram for _, gram in items))


def _inflated_run(run: RunDesign) -> tuple[RunDesign, FloatArray]:
    sd = FORM_ERROR_SD * np.abs(run.effect_force)
    whitening = run.whitening.with_form_error(sd)
    white = whitening.whiten(np.column_stack((run.residual, run.columns)))
    return replace(run, motion_sd=np.hypot(run.motion_sd, sd), whitening=whitening), white.T @ white


MAX_EFFECTS = 3
MIN_FURTHER_LLR = 11.0
"""Half squares below this are noise beside other effects."""
OTHER_DOMAIN_SHARE = 0.2
"""Beside the best further effect, one of another kind is tried that takes away this share of what it does."""


def forward_selection(search: ForceSearchResult) -> list[SelectionStep]:
    """Take up one effect after another beside the best single one."""
    steps: list[SelectionStep] = []
    before: HypothesisFit | None = search.singles[0]
    while before is not None and len(before.effects) < MAX_EFFECTS:
        tried = _selection_steps(search, before)
        steps += tried
        before = tried[0].fit if tried else None
    return steps


def _selection_steps(search: ForceSearchResult, before: HypothesisFit) -> list[SelectionStep]:
    """Try the best further effect beside those before, and the best of those that act on something else."""
    point = before.parameters
    _, design, taken = fit_hypothesis(search.study, point, search.nominal, before.design, all_variants=True)
    doubted = inflate_by_form_error(design)
    projected = project_dictionary(doubted, doubted.total_gram(), *NUISANCES)
    for number in range(len(taken)):
        projected = projected.without((taken[number],))
    own = {candidate.effect.id for candidate in point.candidates}
    everything = rank_with_free_phases(doubted, rank_effects(projected, doubted.variants))
    ranked = [best for best in everything if best.effect not in own]
    steps = []
    for best in (*ranked[:1], *_best_of_other_domain(ranked, doubted, point)):
        rival = max((entry.llr for entry in ranked if entry is not best), default=0.0)
        together = refit_with_effect(search.study, design, best, search.nominal) if best.llr > MIN_FURTHER_LLR else None
        steps.append(SelectionStep(best.effect, best.llr, rival, projected.chi2, (), together))
    if all(step.fit is None for step in steps):
        return steps
    beside = np.sort(
        np.concatenate((doubted.columns_of(*NUISANCES), doubted.columns_of(ColumnKind.VARIANT)[list(taken)]))
    )
    laws = fit_nonparametric_laws(doubted, search.study.runs, nuisance_columns=beside)
    return [replace(step, laws=laws) for step in steps]


def _best_of_other_domain(
    ranked: Sequence[RankedEffect], design: Design, point: ParameterPoint
) -> tuple[RankedEffect, ...]:
    """Return the best of what is neither a function of the same as the best one nor as those before."""
    domains = {variant.effect.id: variant.effect.coordinate for variant in design.variants}
    seen = {candidate.effect.coordinate for candidate in point.candidates} | {
        domains[best.effect] for best in ranked[:1]
    }
    others = [best for best in ranked[1:] if domains[best.effect] not in seen]
    return tuple(best for best in others[:1] if best.llr > OTHER_DOMAIN_SHARE * ranked[0].llr)


NOMINAL_STEPS = 2
"""Further ones of the nominal model alone, once derivatives have been taken twice."""
SHORTLIST = 3
MIN_SHARE_OF_BEST = 0.2
"""A candidate is refitted if it takes away this share of what the best one does."""
MIN_SINGLE_LLR = 7.0
"""Half squares below this are noise for any candidate."""


def search_effects(study: Study, min_llr: float = MIN_SINGLE_LLR, min_share: float = 0.0) -> ForceSearchResult:
    """Try every effect on the force of a campaign.

    Parameters
    ----------
    min_llr, min_share
        An effect is refitted only if it takes away so many half squares beforehand, and this share of the excess.
    """
    first = gauss_newton_step(linearise(study, study.initial_z))
    second = linearise(study, first.z)
    start = gauss_newton(study, gauss_newton_step(second), NOMINAL_STEPS, second)
    nominal = linearise(study, start.z, dictionary=True, reference=second)
    projected = project_dictionary(nominal, nominal.total_gram(), *NUISANCES)
    ranked = rank_with_free_phases(nominal, rank_effects(projected, nominal.variants))
    search = ForceSearchResult(study, nominal, projected.chi2, ranked, (), ())
    least = max(min_llr, MIN_SHARE_OF_BEST * ranked[0].llr, 0.5 * min_share * search.excess) if ranked else 0.0
    likely = [best for best in ranked[:SHORTLIST] if best.llr > least]
    singles = [refit_with_effect(study, nominal, best, nominal) for best in likely]
    singles.sort(key=search.merit, reverse=True)
    singles[:1] = [_relinearised(study, fit, nominal) for fit in singles[:1]]
    search = replace(search, singles=tuple(singles))
    if not singles:
        return search
    search = replace(search, steps=tuple(forward_selection(search)))
    return replace(search, singles=(*singles, *_refit_second_alone(search)))


def _refit_second_alone(search: ForceSearchResult) -> list[HypothesisFit]:
    """Refit what was taken up second on its own: it may have made the first superfluous."""
    tried = {fit.effects[0] for fit in search.singles}
    seconds = {step.effect for step in search.steps if step.fit is not None and len(step.fit.effects) == 2}
    ranked = [best for best in search.ranked if best.effect in seconds - tried]
    return [refit_with_effect(search.study, search.nominal, best, search.nominal) for best in ranked]


def _relinearised(study: Study, fit: HypothesisFit, nominal: Design) -> HypothesisFit:
    """Refit once more with derivatives taken where the fit came to, which may be far from where they were taken."""
    fresh = linearise(study, fit.parameters.z, fit.parameters.candidates)
    tried = [fit_hypothesis(study, point, nominal, fresh)[0] for point in (gauss_newton_step(fresh), fit.parameters)]
    again = min(tried, key=lambda hypothesis: hypothesis.chi2)
    return (
        replace(again, chi2_with_form_error=min(again.chi2_with_form_error, fit.chi2_with_form_error))
        if all_periodic_in_session(fit)
        else again
    )
