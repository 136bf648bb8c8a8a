"""What explains the force: every effect against the nominal model, the best of them refitted, one after another."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dragrig.analysis.gap.design import Design, Part, lay_out
from dragrig.analysis.gap.periodic import free_gain, tied
from dragrig.analysis.gap.ranking import Ranked, rank
from dragrig.analysis.gap.refit import Point, joined, settle, stepped
from dragrig.analysis.gap.signatures import Shape
from dragrig.analysis.gap.solving import NUISANCES, fit, project
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Domain, Effect

CANDIDATE_STEPS = 2
MORE_STEPS = 2
"""Further ones of the nominal model alone, once derivatives have been taken twice."""
SHORTLIST = 3
NEAR_BEST = 0.2
"""A candidate is refitted if it takes away this share of what the best one does."""
LEAST_GAIN = 7.0
"""Half squares below this are noise for any candidate."""
MOST_OWN, LEAST_OWN = 3, 8.0
"""So many further shapes of its own effect a candidate may have, each of which must take away so much."""
MOST_EFFECTS = 3
ACTING = 0.1
"""An effect acts where it adds this share of the most that it adds."""
CLEAR_GAIN = 500.0
"""A further effect that takes away more than this is tried even where the first one is far larger."""
SEARCHED = 26.0
"""Half squares that the best of some hundred periods, in any form, takes away by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Effects refitted together, and what they leave.

    Attributes
    ----------
    point
        Nominal parameters and effects.
    plain
        Whitened squares that remain, and the logarithm of the covariance's determinant over the nominal model's.
    flexible
        Those that remain when each effect may have a foreign form: modulated, with further shapes of its own.
    added_mN
        Root mean square of what the effects add, where they act.
    amount
        d′: norm of what they add, whitened, once run-to-run differences are taken out.
    design
        The campaign around the point, without modulations and further shapes.
    """

    point: Point
    plain: float
    flexible: float
    added_mN: float
    amount: float
    design: Design

    @property
    def effects(self) -> tuple[str, ...]:
        """Their ids."""
        return tuple(one.effect.id for one in self.point.candidates)


@dataclass(frozen=True, eq=False)
class Findings:
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
        Those that were refitted, the best first.
    steps
        The best single, then each further effect joined to it that was tried, with what it took away beforehand.
    """

    study: Study
    nominal: Design
    squares: float
    ranked: tuple[Ranked, ...]
    singles: tuple[Explanation, ...]
    steps: tuple["Step", ...]

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

    def merit(self, one: Explanation) -> float:
        """Return how well an explanation does: its share as it is, and with a foreign form.

        What is periodic in time may have lost its phase from run to run, and counts as the latter alone.
        """
        plain, flexible = self.share(one.plain), self.share(one.flexible)
        return flexible if any(in_time(each.effect) for each in one.point.candidates) else 0.5 * (plain + flexible)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A further effect beside those before.

    Attributes
    ----------
    effect
        Which.
    gain
        Half the squares that it takes away beside the others, foreign forms of these allowed.
    runner_up, runner_up_gain
        The next best in its place.
    left
        Squares that remain without it, foreign forms allowed.
    together
        The refit; None where the gain was not worth one.
    """

    effect: str
    gain: float
    runner_up: str
    runner_up_gain: float
    left: float
    together: Explanation | None


def explain(study: Study, least_share: float = 0.0) -> Findings:
    """Try every effect on the force of a campaign.

    Parameters
    ----------
    least_share
        An effect is refitted only if the best takes away this share of the excess beforehand.
    """
    first = stepped(lay_out(study, study.start))
    second = lay_out(study, first.z)
    start = settle(study, stepped(second), MORE_STEPS, second)
    nominal = lay_out(study, start.z, dictionary=True, near=second)
    projected = project(nominal, nominal.total(), *NUISANCES)
    ranked = _with_free_phases(nominal, rank(projected, nominal.shapes))
    found = Findings(study, nominal, projected.squares, ranked, (), ())
    least = max(LEAST_GAIN, NEAR_BEST * ranked[0].gain, 0.5 * least_share * found.excess) if ranked else 0.0
    likely = [one for one in ranked[:SHORTLIST] if one.gain > least]
    singles = [_refitted(study, nominal, one, nominal.log_det) for one in likely]
    singles.sort(key=found.merit, reverse=True)
    singles[:1] = [_polished(study, one, nominal.log_det) for one in singles[:1]]
    found = replace(found, singles=tuple(singles))
    return replace(found, steps=tuple(_further(found))) if singles else found


def _polished(study: Study, one: Explanation, log_det: float) -> Explanation:
    """Refit once more with derivatives taken where the fit came to, which may be far from where they were taken."""
    fresh = lay_out(study, one.point.z, one.point.candidates)
    tried = [_explanation(study, point, log_det, fresh)[0] for point in (stepped(fresh), one.point)]
    again = min(tried, key=lambda each: each.plain)
    return replace(again, flexible=min(again.flexible, one.flexible)) if in_time_alone(one) else again


def _refitted(study: Study, design: Design, ranked: Ranked, log_det: float) -> Explanation:
    z, amplitude = joined(design, ranked.shapes)
    shape = design.shapes[ranked.shapes[0]]
    if not in_time(shape.effect):
        candidate = ranked.candidate(design.shapes, amplitude)
        point = settle(study, Point(z, (*design.candidates, candidate)), CANDIDATE_STEPS, design)
        return _explanation(study, point, log_det, design)[0]
    together = tied(study, design, shape)
    start = Point(design.z, (*design.candidates, together.candidate))
    tried = [start, settle(study, start, CANDIDATE_STEPS, design)]
    found = min((_explanation(study, one, log_det, design)[0] for one in tried), key=lambda one: one.plain)
    before = project(design, design.total(), *NUISANCES).squares + design.log_det - log_det
    return replace(found, flexible=min(found.flexible, before - 2 * max(together.gain - SEARCHED, ranked.gain)))


def _explanation(
    study: Study,
    point: Point,
    log_det: float,
    near: Design | None = None,
    *,
    everything: bool = False,
) -> tuple[Explanation, Design, tuple[int, ...]]:
    """Return what a point explains, its design, and the further shapes of its own effects that were taken."""
    own = {one.effect.id for one in point.candidates}
    shown = study if everything else replace(study, effects=tuple(one for one in study.effects if one.id in own))
    design = lay_out(shown, point.z, point.candidates, near=near, foreign=True, dictionary=True)
    total = design.total()
    plain = fit(design, total, Part.NOMINAL, Part.DETAIL, Part.EFFECT)
    flexible, taken = _with_own_shapes(design, total, own)
    weights = np.concatenate([one.coordinates.width_s for one in study.sights])
    more = np.concatenate([one.added for one in design.parts])
    weights = np.where(np.abs(more) > ACTING * np.abs(more).max(initial=1e-12), weights, 0.0)
    squares = sum(float(np.sum(part.whitening.whole(part.added) ** 2)) for part in design.parts)
    added = float(np.sqrt(weights @ more**2 / max(float(weights.sum()), 1e-12)))
    amount = float(np.sqrt(squares))
    more_det = design.log_det - log_det
    kept = design.kept(Part.NOMINAL, Part.DETAIL, Part.EFFECT)
    found = Explanation(point, plain.squares + more_det, flexible + more_det, added, amount, kept)
    return found, design, taken


def _with_own_shapes(design: Design, total: FloatArray, own: set[str]) -> tuple[float, tuple[int, ...]]:
    """Add further shapes of the same effects one by one; return the squares that remain and the shapes."""
    projected = project(design, total, *NUISANCES)
    squares = projected.squares
    taken: tuple[int, ...] = ()
    for _ in range(MOST_OWN):
        ranked = [one for one in rank(projected, design.shapes) if one.effect in own]
        if not ranked or ranked[0].gain < LEAST_OWN:
            break
        taken = (*taken, *ranked[0].shapes)
        squares -= 2 * ranked[0].gain
        projected = projected.without(ranked[0].shapes)
    return squares, taken


def _pairs(shapes: Sequence[Shape]) -> list[tuple[int, int]]:
    """Return the pairs of shapes that are periodic in the session's time."""
    return [
        (number, number + 1)
        for number, one in enumerate(shapes)
        if in_time(one.effect) and not one.quarter and one.effect.phase is not None
    ]


def in_time_alone(one: Explanation) -> bool:
    """Whether all effects of an explanation are periodic on the session's clock."""
    return all(in_time(each.effect) for each in one.point.candidates)


def in_time(effect: Effect) -> bool:
    """Whether an effect is periodic on the session's clock."""
    return effect.domain is Domain.SESSION and effect.phase is not None


def _with_free_phases(design: Design, ranked: tuple[Ranked, ...]) -> tuple[Ranked, ...]:
    """Let what is periodic in time have a phase of its own in every run, then look for a period that ties them."""
    pairs = _pairs(design.shapes)
    if not pairs:
        return ranked
    nuisances = fit(design, design.total(), *NUISANCES)
    tried = [(*free_gain(design, nuisances, pair), pair) for pair in pairs]
    gain, runs, pair = max(tried, key=lambda one: one[0] - one[1])
    effect = design.shapes[pair[0]].effect.id
    tied = next((one for one in ranked if one.effect == effect), None)
    # The largest of so many periods is above what one of them has by chance.
    beyond = gain - runs - 2 * np.sqrt(2 * runs * np.log(len(pairs)))
    if tied is None or beyond <= tied.gain:
        return ranked
    free = Ranked(effect, beyond, tied.per_unit, pair, np.array([0.5, 0.5]))
    return tuple(sorted((free if one.effect == effect else one for one in ranked), key=lambda one: -one.gain))


def _further(found: Findings) -> list[Step]:
    steps: list[Step] = []
    point = found.singles[0].point
    while len(point.candidates) < MOST_EFFECTS:
        step = _step(found, point)
        if step is None:
            break
        steps.append(step)
        if step.together is None:
            break
        point = step.together.point
    return steps


def _step(found: Findings, point: Point) -> Step | None:
    """Try the best further effect beside those of a point; None where there is none to try."""
    _, design, taken = _explanation(found.study, point, found.nominal.log_det, everything=True)
    total = design.total()
    projected = project(design, total, *NUISANCES)
    for number in range(len(taken)):
        projected = projected.without((taken[number],))
    own = {one.effect.id for one in point.candidates}
    everything = _with_free_phases(design, rank(projected, design.shapes))
    ranked = [one for one in everything if one.effect not in own]
    if len(ranked) < 2:
        return None
    first, second = ranked[:2]
    least = 0.01 if first.gain < CLEAR_GAIN else 0.004
    worth = first.gain > LEAST_GAIN * 2 and 2 * first.gain > least * found.excess
    together = _refitted(found.study, design, first, found.nominal.log_det) if worth else None
    left = projected.squares + design.log_det - found.nominal.log_det
    return Step(first.effect, first.gain, second.effect, second.gain, left, together)
