"""One explanation of the force: effects refitted together, as they are and with foreign forms."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.acting import rms_where_acting
from dragrig.analysis.gap.design import Design, Part, lay_out
from dragrig.analysis.gap.periodic import free_gain, tied
from dragrig.analysis.gap.ranking import Ranked, rank
from dragrig.analysis.gap.refit import Point, joined, settle
from dragrig.analysis.gap.signatures import Shape
from dragrig.analysis.gap.solving import NUISANCES, Fit, fit, project
from dragrig.analysis.gap.study import Study
from dragrig.analysis.gap.weighing import CHANCE, NOISE_SHARE
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Domain, Effect

CANDIDATE_STEPS = 2
MOST_OWN, LEAST_OWN = 3, 8.0
"""So many further shapes of its own effect a candidate may have, each of which must take away so much."""
REACHED = 1.0
"""Whitened squares that effects add to a run that they act in."""
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
    changed_mN
        By how much the prediction changes, the nominal parameters refitted: root mean square where it does.
    elsewhere
        What is left in runs where they add nothing, in standard deviations of chance.
    design
        The campaign around the point, without modulations and further shapes.
    """

    point: Point
    plain: float
    flexible: float
    changed_mN: float
    elsewhere: float
    design: Design

    @property
    def effects(self) -> tuple[str, ...]:
        """Their ids."""
        return tuple(one.effect.id for one in self.point.candidates)


def refitted(study: Study, design: Design, ranked: Ranked, nominal: Design) -> Explanation:
    """Refit an effect beside those of a design, from the shape that was ranked first."""
    z, amplitude = joined(design, ranked.shapes)
    shape = design.shapes[ranked.shapes[0]]
    if not in_time(shape.effect):
        candidate = ranked.candidate(design.shapes, amplitude)
        start = Point(z, (*design.candidates, candidate))
        found = explained(study, settle(study, start, CANDIDATE_STEPS, design), nominal, design)[0]
        before = (
            fit(design, design.total(), Part.NOMINAL, Part.DETAIL, Part.EFFECT).squares
            + design.log_det
            - nominal.log_det
        )
        if found.plain < before:
            return found
        # The steps went astray, as with a period that lost its phase; where they began is no worse than without it.
        calm = Point(design.z, start.candidates)
        others = [explained(study, one, nominal, design)[0] for one in (start, calm)]
        return min((found, *others), key=lambda one: one.plain)
    together = tied(study, design, shape)
    start = Point(design.z, (*design.candidates, together.candidate))
    tried = [start, settle(study, start, CANDIDATE_STEPS, design)]
    found = min((explained(study, one, nominal, design)[0] for one in tried), key=lambda one: one.plain)
    before = project(design, design.total(), *NUISANCES).squares + design.log_det - nominal.log_det
    return replace(found, flexible=min(found.flexible, before - 2 * max(together.gain - SEARCHED, ranked.gain)))


def explained(
    study: Study,
    point: Point,
    nominal: Design,
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
    more_det = design.log_det - nominal.log_det
    kept = design.kept(Part.NOMINAL, Part.DETAIL, Part.EFFECT)
    found = Explanation(
        point=point,
        plain=plain.squares + more_det,
        flexible=flexible + more_det,
        changed_mN=_changed(study, design, nominal),
        elsewhere=_elsewhere(design, plain),
        design=kept,
    )
    return found, design, taken


def _changed(study: Study, design: Design, nominal: Design) -> float:
    """Return by how much two designs predict another force, root mean square where they do [mN]."""
    more = np.concatenate(
        [one.predicted + one.added - two.predicted for one, two in zip(design.parts, nominal.parts, strict=True)]
    )
    weights = np.concatenate([one.coordinates.width_s for one in study.sights])
    return rms_where_acting(more, weights)


def _elsewhere(design: Design, plain: Fit) -> float:
    """Return the excess in runs that an explanation does not reach, where another effect must act."""
    fitted = np.append(1.0, -plain.found)
    rows = np.append(0, 1 + plain.columns)
    squares, blocks = 0.0, 0
    for part, gram, count in zip(design.parts, design.grams, design.blocks, strict=True):
        if float(np.sum(part.whitening.whole(part.added) ** 2)) < REACHED:
            squares += float(fitted @ gram[np.ix_(rows, rows)] @ fitted)
            blocks += count
    return (squares - blocks) / max(float(np.sqrt(2.0 * blocks)), NOISE_SHARE / CHANCE * blocks, 1.0)


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


def in_time_alone(one: Explanation) -> bool:
    """Whether all effects of an explanation are periodic on the session's clock."""
    return all(in_time(each.effect) for each in one.point.candidates)


def in_time(effect: Effect) -> bool:
    """Whether an effect is periodic on the session's clock."""
    return effect.domain is Domain.SESSION and effect.phase is not None


def with_free_phases(design: Design, ranked: tuple[Ranked, ...]) -> tuple[Ranked, ...]:
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


def _pairs(shapes: Sequence[Shape]) -> list[tuple[int, int]]:
    """Return the pairs of shapes that are periodic in the session's time."""
    return [
        (number, number + 1)
        for number, one in enumerate(shapes)
        if in_time(one.effect) and not one.quarter and one.effect.phase is not None
    ]
