"""Which effects of the position a campaign tells apart: each in turn beside the errors that its runs have anyway.

The position is not whitened: what it strays by is larger than an encoder's count or it does not matter. As a diagnosis
does, each error is explained by free forms of every effect, judged on runs that took no part.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from statistics import median

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.isolability.results import Pair, Visibility, pairs_of
from dragrig.analysis.gap.judging import LEAST_POSITION
from dragrig.analysis.gap.position.errors import PositionErrors, position_errors
from dragrig.analysis.gap.position.families import families
from dragrig.analysis.gap.position.finding import strayed
from dragrig.analysis.gap.seen import SEEN
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.sim_backend.effects.base import Effect, EncoderEffect, MotorEffect

MOST_SHAPES = 3
"""So many shapes of an effect are tried, evenly chosen from its grid."""
PHASE_RAD = 0.7


@dataclass(frozen=True, slots=True)
class _Tried:
    """One shape of an effect: the largest error over what is noticed, and the share that each free form leaves."""

    ratio: float
    left: Mapping[str, float]


def position_isolability(
    experiments: Sequence[Experiment], effects: Sequence[Effect]
) -> tuple[tuple[Visibility, ...], tuple[Pair, ...]]:
    """Return how clearly runs show each effect of the position, and how far apart these are."""
    runs = position_errors(experiments)
    acting = [one for one in effects if isinstance(one, MotorEffect | EncoderEffect)]
    tried = {one.id: [_try(candidate, runs) for candidate in _candidates(one)] if runs else [] for one in acting}
    visible = tuple(_visibility(one, tried[one.id]) for one in acting)
    shown = tuple(one.effect for one in visible if one.least is not None)
    return visible, tuple(_pair(pair, tried) for pair in pairs_of(shown))


def _candidates(effect: Effect) -> Iterator[Candidate]:
    grid = list(product(*(one.tried or (one.usual,) for one in effect.shapes)))
    chosen = np.unique(np.linspace(0, len(grid) - 1, min(MOST_SHAPES, len(grid))).round().astype(int)).tolist()
    phase = {} if effect.phase is None else {effect.phase.name: PHASE_RAD}
    for place in chosen:
        shapes = {one.name: value for one, value in zip(effect.shapes, grid[place], strict=True)}
        yield Candidate(effect, {**effect.usual, **shapes, **phase})


def _try(candidate: Candidate, runs: Sequence[PositionErrors]) -> _Tried:
    errors = [strayed(candidate, one) for one in runs]
    clearest = max(float(np.sqrt(np.mean(more**2))) / one.least_mm for one, more in zip(runs, errors, strict=True))
    strays = [replace(one, error_mm=one.error_mm + more) for one, more in zip(runs, errors, strict=True)]
    return _Tried(clearest, {one.effect: 1.0 - one.held_out for one in families(strays)})


def _visibility(effect: Effect, tried: Sequence[_Tried]) -> Visibility:
    size, unit = effect.size.usual, effect.size.unit
    ratios = [one.ratio for one in tried if one.ratio > 0]
    if not ratios:
        return Visibility(effect.id, "position", 0.0, size, None, unit)
    return Visibility(effect.id, "position", SEEN * median(ratios), size, median(size / one for one in ratios), unit)


def _pair(pair: tuple[str, str], tried: Mapping[str, Sequence[_Tried]]) -> Pair:
    one, other = pair
    left = [[min(max(each.left[rival], 0.0), 1.0) for each in tried[truth]] for truth, rival in (pair, (other, one))]
    shifts = [
        median(SEEN * each.ratio * float(np.sqrt(share)) for each, share in zip(tried[truth], shares, strict=True))
        for truth, shares in zip(pair, left, strict=True)
    ]
    sin2 = min(*left[0], *left[1])
    confused = sin2 < 1.0 - LEAST_POSITION or min(shifts) < SEEN
    return Pair(pair, "position", sin2, (median(left[0]), median(left[1])), (shifts[0], shifts[1]), confused)
