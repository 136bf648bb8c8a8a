"""Search for the effects that explain the force: each effect alone first, then forward selection of further ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Design, RunDesign, Study, linearise
from dragrig.analysis.gap.features import NonparametricLaw
from dragrig.analysis.gap.hypothesis_fit import (
    HypothesisFit,
    fit_hypothesis,
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
    """All hypotheses that were fitted to the force of a campaign.

    Attributes
    ----------
    nominal
        Fit of the nominal model, with the dictionary.
    chi2
        Chi-square of the nominal model.
    ranked
        Best variant of each effect beside the nominal model.
    singles
        Effects fitted alone, the best first; then effects of later steps fitted alone.
    steps
        Steps of the forward selection.
    """

    study: Study
    nominal: Design
    chi2: float
    ranked: tuple[RankedEffect, ...]
    singles: tuple[HypothesisFit, ...]
    steps: tuple["SelectionStep", ...]

    @property
    def block_count(self) -> int:
        """Number of blocks: the expected chi-square of noise."""
        return sum(self.nominal.block_counts)

    @property
    def fits(self) -> tuple[HypothesisFit, ...]:
        """Fits of all hypotheses, those of single effects first."""
        return (*self.singles, *(step.fit for step in self.steps if step.fit is not None))

    @cached_property
    def excess(self) -> float:
        """Chi-square of the nominal model above its expectation."""
        return self.chi2 - self.block_count

    def explained_share(self, chi2: float) -> float:
        """Return the share of the excess that a fit with this chi-square explains."""
        return 1.0 - (chi2 - self.block_count) / max(self.excess, 1.0)

    def merit(self, fit: HypothesisFit) -> float:
        """Return the explained share, averaged over the fits without and with form error.

        Effects periodic in session time may lose their phase between runs: for them the fit with form error counts
        alone.
        """
        exact, with_form_error = self.explained_share(fit.chi2), self.explained_share(fit.chi2_with_form_error)
        return with_form_error if fit.periodic else 0.5 * (exact + with_form_error)


@dataclass(frozen=True, slots=True, eq=False)
class SelectionStep:
    """A further effect that was tried; all numbers allow for form error of the effects before it.

    Attributes
    ----------
    effect
        Id of the effect.
    llr
        Its log likelihood ratio beside the effects before it.
    rival_llr
        Log likelihood ratio of the best other effect.
    chi2_without
        Chi-square without it.
    laws
        Nonparametric laws in its place, the best first.
    fit
        Fit with it; None where its log likelihood ratio is too small.
    """

    effect: str
    llr: float
    rival_llr: float
    chi2_without: float
    laws: tuple[NonparametricLaw, ...]
    fit: HypothesisFit | None


FORM_ERROR_SD = 0.25
"""Relative form error of an effect, one standard deviation: real effects leave 10 to 40 % of the catalogue's form."""


def inflate_by_form_error(design: Design) -> Design:
    """Return a design whose noise grows with the force of its candidates.

    Form error is largest where an effect is largest, and there a second effect is hardly separable from it. Where the
    first effect is small, a residual force cannot be its form error.
    """
    runs = zip(design.runs, design.grams, strict=True)
    inflated = [_inflated_run(run) if run.effect_force.any() else (run, gram) for run, gram in runs]
    return replace(
        design, runs=tuple(run_of_design for run_of_design, _ in inflated), grams=tuple(gram for _, gram in inflated)
    )


def _inflated_run(run: RunDesign) -> tuple[RunDesign, FloatArray]:
    sd = FORM_ERROR_SD * np.abs(run.effect_force)
    whitening = run.whitening.with_form_error(sd)
    white = whitening.whiten(np.column_stack((run.residual, run.columns)))
    return replace(run, motion_sd=np.hypot(run.motion_sd, sd), whitening=whitening), white.T @ white


MAX_EFFECTS = 3
MIN_FURTHER_LLR = 11.0
"""Smaller log likelihood ratios of a further effect are noise."""
OTHER_DOMAIN_SHARE = 0.2
"""An effect of another coordinate is also tried if it reaches this share of the best one's log likelihood ratio."""


def forward_selection(search: ForceSearchResult) -> list[SelectionStep]:
    """Add one effect after another to the best single one."""
    steps: list[SelectionStep] = []
    current: HypothesisFit | None = search.singles[0]
    while current is not None and len(current.effects) < MAX_EFFECTS:
        step_candidates = _selection_steps(search, current)
        steps += step_candidates
        current = step_candidates[0].fit if step_candidates else None
    return steps


def _selection_steps(search: ForceSearchResult, current: HypothesisFit) -> list[SelectionStep]:
    """Try the best further effect, and the best of those with another coordinate."""
    point = current.parameters
    _, design, own_variants = fit_hypothesis(search.study, point, search.nominal, current.design, all_variants=True)
    inflated = inflate_by_form_error(design)
    projected = project_dictionary(inflated, inflated.total_gram(), *NUISANCES)
    for number in range(len(own_variants)):
        projected = projected.without((own_variants[number],))
    present = {candidate.effect.id for candidate in point.candidates}
    all_ranked = rank_with_free_phases(inflated, rank_effects(projected, inflated.variants))
    ranked = [best for best in all_ranked if best.effect not in present]
    steps = []
    for best in (*ranked[:1], *_best_of_other_domain(ranked, inflated, point)):
        rival_llr = max((entry.llr for entry in ranked if entry is not best), default=0.0)
        fit = refit_with_effect(search.study, design, best, search.nominal) if best.llr > MIN_FURTHER_LLR else None
        steps.append(SelectionStep(best.effect, best.llr, rival_llr, projected.chi2, (), fit))
    if all(step.fit is None for step in steps):
        return steps
    nuisance_columns = np.sort(
        np.concatenate((inflated.columns_of(*NUISANCES), inflated.columns_of(ColumnKind.VARIANT)[list(own_variants)]))
    )
    laws = fit_nonparametric_laws(inflated, search.study.runs, nuisance_columns=nuisance_columns)
    return [replace(step, laws=laws) for step in steps]


def _best_of_other_domain(
    ranked: Sequence[RankedEffect], design: Design, point: ParameterPoint
) -> tuple[RankedEffect, ...]:
    """Return the best effect whose coordinate differs from the best one's and from those present."""
    coordinates = {variant.effect.id: variant.effect.coordinate for variant in design.variants}
    excluded = {candidate.effect.coordinate for candidate in point.candidates} | {
        coordinates[best.effect] for best in ranked[:1]
    }
    others = [best for best in ranked[1:] if coordinates[best.effect] not in excluded]
    return tuple(best for best in others[:1] if best.llr > OTHER_DOMAIN_SHARE * ranked[0].llr)


NOMINAL_STEPS = 2
"""Further steps of the nominal model alone, after derivatives were computed twice."""
SHORTLIST = 3
MIN_SHARE_OF_BEST = 0.2
"""A candidate is fitted if it reaches this share of the best one's log likelihood ratio."""
MIN_SINGLE_LLR = 7.0
"""Smaller log likelihood ratios of a single effect are noise."""


def search_effects(study: Study, min_llr: float = MIN_SINGLE_LLR, min_share: float = 0.0) -> ForceSearchResult:
    """Fit the most likely effects on the force of a campaign, alone and together.

    Parameters
    ----------
    min_llr, min_share
        Thresholds below which an effect is not fitted: log likelihood ratio, and share of the excess.
    """
    first = gauss_newton_step(linearise(study, study.initial_z))
    second = linearise(study, first.z)
    start = gauss_newton(study, gauss_newton_step(second), NOMINAL_STEPS, second)
    nominal = linearise(study, start.z, dictionary=True, reference=second)
    projected = project_dictionary(nominal, nominal.total_gram(), *NUISANCES)
    ranked = rank_with_free_phases(nominal, rank_effects(projected, nominal.variants))
    search = ForceSearchResult(study, nominal, projected.chi2, ranked, (), ())
    threshold = max(min_llr, MIN_SHARE_OF_BEST * ranked[0].llr, 0.5 * min_share * search.excess) if ranked else 0.0
    likely = [best for best in ranked[:SHORTLIST] if best.llr > threshold]
    singles = [refit_with_effect(study, nominal, best, nominal) for best in likely]
    singles.sort(key=search.merit, reverse=True)
    singles[:1] = [_relinearised(study, fit, nominal) for fit in singles[:1]]
    search = replace(search, singles=tuple(singles))
    if not singles:
        return search
    search = replace(search, steps=tuple(forward_selection(search)))
    return replace(search, singles=(*singles, *_refit_second_alone(search)))


def _refit_second_alone(search: ForceSearchResult) -> list[HypothesisFit]:
    """Fit alone what was added second: it may make the first superfluous."""
    tried = {fit.effects[0] for fit in search.singles}
    seconds = {step.effect for step in search.steps if step.fit is not None and len(step.fit.effects) == 2}
    ranked = [best for best in search.ranked if best.effect in seconds - tried]
    return [refit_with_effect(search.study, search.nominal, best, search.nominal) for best in ranked]


def _relinearised(study: Study, fit: HypothesisFit, nominal: Design) -> HypothesisFit:
    """Fit again with derivatives at the fitted point, which may be far from where they were computed."""
    design = linearise(study, fit.parameters.z, fit.parameters.candidates)
    fits = [fit_hypothesis(study, point, nominal, design)[0] for point in (gauss_newton_step(design), fit.parameters)]
    best = min(fits, key=lambda hypothesis: hypothesis.chi2)
    return (
        replace(best, chi2_with_form_error=min(best.chi2_with_form_error, fit.chi2_with_form_error))
        if fit.periodic
        else best
    )
