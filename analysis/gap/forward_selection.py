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
    squares
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
    squares: float
    ranked: tuple[RankedEffect, ...]
    singles: tuple[HypothesisFit, ...]
    steps: tuple["SelectionStep", ...]

    @property
    def blocks(self) -> int:
        """Number of blocks: what the squares of noise come to."""
        return sum(self.nominal.blocks)

    @cached_property
    def excess(self) -> float:
        """Squares above noise that the nominal model leaves."""
        return self.squares - self.blocks

    def share(self, squares: float) -> float:
        """Return the share of the excess that is explained when so many squares remain."""
        return 1.0 - (squares - self.blocks) / max(self.excess, 1.0)

    def merit(self, one: HypothesisFit) -> float:
        """Return how well an explanation does: its share as it is, and with a foreign form.

        What is periodic in time may have lost its phase from run to run, and counts as the latter alone.
        """
        plain, flexible = self.share(one.plain), self.share(one.flexible)
        return (
            flexible
            if any(is_periodic_in_session(each.effect) for each in one.point.candidates)
            else 0.5 * (plain + flexible)
        )


@dataclass(frozen=True, slots=True, eq=False)
class SelectionStep:
    """A further effect beside those before, whose form is in doubt in all of these numbers.

    Attributes
    ----------
    effect
        Which.
    gain
        Half the squares that it takes away beside the others, which may have foreign forms.
    rival_gain
        What the next best takes away in its place.
    left
        Squares that remain without it.
    laws
        What laws without a name leave in its place, the best first.
    together
        The refit; None where the gain was not worth one.
    """

    effect: str
    gain: float
    rival_gain: float
    left: float
    laws: tuple[NonparametricLaw, ...]
    together: HypothesisFit | None


FORM_ERROR_SD = 0.25
"""So much of what effects add is doubted, one standard deviation: real ones leave 10 to 40 % of a catalogue's form."""


def inflate_by_form_error(design: Design) -> Design:
    """Return a design whose noise grows with what its candidates add.

    A foreign form leaves most where an effect is largest, and there a second one can hardly be told from it; where the
    first does little, the same force cannot be its own.
    """
    pairs = zip(design.parts, design.grams, strict=True)
    found = [_inflated_run(part) if part.added.any() else (part, gram) for part, gram in pairs]
    return replace(design, parts=tuple(one for one, _ in found), grams=tuple(gram for _, gram in found))


def _inflated_run(part: RunDesign) -> tuple[RunDesign, FloatArray]:
    sd = FORM_ERROR_SD * np.abs(part.added)
    whitening = part.whitening.with_form_error(sd)
    white = whitening.whiten(np.column_stack((part.residual, part.columns)))
    return replace(part, motion_sd=np.hypot(part.motion_sd, sd), whitening=whitening), white.T @ white


MAX_EFFECTS = 3
MIN_FURTHER_LLR = 11.0
"""Half squares below this are noise beside other effects."""
OTHER_DOMAIN_SHARE = 0.2
"""Beside the best further effect, one of another kind is tried that takes away this share of what it does."""


def forward_selection(found: ForceSearchResult) -> list[SelectionStep]:
    """Take up one effect after another beside the best single one."""
    steps: list[SelectionStep] = []
    before: HypothesisFit | None = found.singles[0]
    while before is not None and len(before.effects) < MAX_EFFECTS:
        tried = _selection_steps(found, before)
        steps += tried
        before = tried[0].together if tried else None
    return steps


def _selection_steps(found: ForceSearchResult, before: HypothesisFit) -> list[SelectionStep]:
    """Try the best further effect beside those before, and the best of those that act on something else."""
    point = before.point
    _, design, taken = fit_hypothesis(found.study, point, found.nominal, before.design, everything=True)
    doubted = inflate_by_form_error(design)
    projected = project_dictionary(doubted, doubted.total(), *NUISANCES)
    for number in range(len(taken)):
        projected = projected.without((taken[number],))
    own = {one.effect.id for one in point.candidates}
    everything = rank_with_free_phases(doubted, rank_effects(projected, doubted.shapes))
    ranked = [one for one in everything if one.effect not in own]
    steps = []
    for one in (*ranked[:1], *_best_of_other_domain(ranked, doubted, point)):
        rival = max((each.gain for each in ranked if each is not one), default=0.0)
        together = refit_with_effect(found.study, design, one, found.nominal) if one.gain > MIN_FURTHER_LLR else None
        steps.append(SelectionStep(one.effect, one.gain, rival, projected.squares, (), together))
    if all(one.together is None for one in steps):
        return steps
    beside = np.sort(np.concatenate((doubted.of(*NUISANCES), doubted.of(ColumnKind.SHAPE)[list(taken)])))
    laws = fit_nonparametric_laws(doubted, found.study.sights, beside=beside)
    return [replace(one, laws=laws) for one in steps]


def _best_of_other_domain(
    ranked: Sequence[RankedEffect], design: Design, point: ParameterPoint
) -> tuple[RankedEffect, ...]:
    """Return the best of what is neither a function of the same as the best one nor as those before."""
    domains = {one.effect.id: one.effect.coordinate for one in design.shapes}
    seen = {one.effect.coordinate for one in point.candidates} | {domains[one.effect] for one in ranked[:1]}
    others = [one for one in ranked[1:] if domains[one.effect] not in seen]
    return tuple(one for one in others[:1] if one.gain > OTHER_DOMAIN_SHARE * ranked[0].gain)


NOMINAL_STEPS = 2
"""Further ones of the nominal model alone, once derivatives have been taken twice."""
SHORTLIST = 3
MIN_SHARE_OF_BEST = 0.2
"""A candidate is refitted if it takes away this share of what the best one does."""
MIN_SINGLE_LLR = 7.0
"""Half squares below this are noise for any candidate."""


def search_effects(study: Study, least_gain: float = MIN_SINGLE_LLR, least_share: float = 0.0) -> ForceSearchResult:
    """Try every effect on the force of a campaign.

    Parameters
    ----------
    least_gain, least_share
        An effect is refitted only if it takes away so many half squares beforehand, and this share of the excess.
    """
    first = gauss_newton_step(linearise(study, study.start))
    second = linearise(study, first.z)
    start = gauss_newton(study, gauss_newton_step(second), NOMINAL_STEPS, second)
    nominal = linearise(study, start.z, dictionary=True, near=second)
    projected = project_dictionary(nominal, nominal.total(), *NUISANCES)
    ranked = rank_with_free_phases(nominal, rank_effects(projected, nominal.shapes))
    found = ForceSearchResult(study, nominal, projected.squares, ranked, (), ())
    least = max(least_gain, MIN_SHARE_OF_BEST * ranked[0].gain, 0.5 * least_share * found.excess) if ranked else 0.0
    likely = [one for one in ranked[:SHORTLIST] if one.gain > least]
    singles = [refit_with_effect(study, nominal, one, nominal) for one in likely]
    singles.sort(key=found.merit, reverse=True)
    singles[:1] = [_relinearised(study, one, nominal) for one in singles[:1]]
    found = replace(found, singles=tuple(singles))
    if not singles:
        return found
    found = replace(found, steps=tuple(forward_selection(found)))
    return replace(found, singles=(*singles, *_refit_second_alone(found)))


def _refit_second_alone(found: ForceSearchResult) -> list[HypothesisFit]:
    """Refit what was taken up second on its own: it may have made the first superfluous."""
    tried = {one.effects[0] for one in found.singles}
    seconds = {one.effect for one in found.steps if one.together is not None and len(one.together.effects) == 2}
    ranked = [one for one in found.ranked if one.effect in seconds - tried]
    return [refit_with_effect(found.study, found.nominal, one, found.nominal) for one in ranked]


def _relinearised(study: Study, one: HypothesisFit, nominal: Design) -> HypothesisFit:
    """Refit once more with derivatives taken where the fit came to, which may be far from where they were taken."""
    fresh = linearise(study, one.point.z, one.point.candidates)
    tried = [fit_hypothesis(study, point, nominal, fresh)[0] for point in (gauss_newton_step(fresh), one.point)]
    again = min(tried, key=lambda each: each.plain)
    return replace(again, flexible=min(again.flexible, one.flexible)) if all_periodic_in_session(one) else again
