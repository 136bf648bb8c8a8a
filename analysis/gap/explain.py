"""What explains the force: every effect against the nominal model, the best of them refitted, one after another."""

from dataclasses import replace

from dragrig.analysis.gap.design import Design, lay_out
from dragrig.analysis.gap.explanation import Explanation, explained, in_time_alone, refitted, with_free_phases
from dragrig.analysis.gap.findings import Findings
from dragrig.analysis.gap.further import further_steps
from dragrig.analysis.gap.ranking import rank
from dragrig.analysis.gap.refit import settle, stepped
from dragrig.analysis.gap.solving import NUISANCES, project
from dragrig.analysis.gap.study import Study

MORE_STEPS = 2
"""Further ones of the nominal model alone, once derivatives have been taken twice."""
SHORTLIST = 3
NEAR_BEST = 0.2
"""A candidate is refitted if it takes away this share of what the best one does."""
LEAST_GAIN = 7.0
"""Half squares below this are noise for any candidate."""


def explain(study: Study, least_gain: float = LEAST_GAIN, least_share: float = 0.0) -> Findings:
    """Try every effect on the force of a campaign.

    Parameters
    ----------
    least_gain, least_share
        An effect is refitted only if it takes away so many half squares beforehand, and this share of the excess.
    """
    first = stepped(lay_out(study, study.start))
    second = lay_out(study, first.z)
    start = settle(study, stepped(second), MORE_STEPS, second)
    nominal = lay_out(study, start.z, dictionary=True, near=second)
    projected = project(nominal, nominal.total(), *NUISANCES)
    ranked = with_free_phases(nominal, rank(projected, nominal.shapes))
    found = Findings(study, nominal, projected.squares, ranked, (), ())
    least = max(least_gain, NEAR_BEST * ranked[0].gain, 0.5 * least_share * found.excess) if ranked else 0.0
    likely = [one for one in ranked[:SHORTLIST] if one.gain > least]
    singles = [refitted(study, nominal, one, nominal) for one in likely]
    singles.sort(key=found.merit, reverse=True)
    singles[:1] = [_polished(study, one, nominal) for one in singles[:1]]
    found = replace(found, singles=tuple(singles))
    if not singles:
        return found
    found = replace(found, steps=tuple(further_steps(found)))
    return replace(found, singles=(*singles, *_alone(found)))


def _alone(found: Findings) -> list[Explanation]:
    """Refit what was taken up second on its own: it may have made the first superfluous."""
    tried = {one.effects[0] for one in found.singles}
    seconds = {one.effect for one in found.steps if one.together is not None and len(one.together.effects) == 2}
    ranked = [one for one in found.ranked if one.effect in seconds - tried]
    return [refitted(found.study, found.nominal, one, found.nominal) for one in ranked]


def _polished(study: Study, one: Explanation, nominal: Design) -> Explanation:
    """Refit once more with derivatives taken where the fit came to, which may be far from where they were taken."""
    fresh = lay_out(study, one.point.z, one.point.candidates)
    tried = [explained(study, point, nominal, fresh)[0] for point in (stepped(fresh), one.point)]
    again = min(tried, key=lambda each: each.plain)
    return replace(again, flexible=min(again.flexible, one.flexible)) if in_time_alone(one) else again
