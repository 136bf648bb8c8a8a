"""Scores on whole runs that took no part: folds by condition, fits and choices made on the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.design import Design, IndexArray, Part
from dragrig.analysis.gap.explanation import Explanation
from dragrig.analysis.gap.findings import Findings
from dragrig.analysis.gap.ranking import Ranked, rank
from dragrig.analysis.gap.solving import NUISANCES, fit, project
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray

FOLDS = 4
FEWEST_RUNS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Left:
    """What each run shows when it took no part: residuals before and after, and whitened squares.

    Attributes
    ----------
    before, after
        Residual block means of each run [mN].
    squares_before, squares_after
        Their whitened squares.
    agreed
        Share of the folds whose own choice was the same effect.
    """

    before: tuple[FloatArray, ...]
    after: tuple[FloatArray, ...]
    squares_before: FloatArray
    squares_after: FloatArray
    agreed: float


def folds_of(study: Study) -> tuple[tuple[int, ...], ...]:
    """Return the runs of each fold: whole conditions, those of a kind dealt out in the order of speed or strain."""
    conditions = sorted({one.condition for one in study.sights})
    dealt: dict[tuple[str, float], int] = {}
    counts: dict[str, int] = {}
    for kind, value in conditions:
        counts[kind] = counts.get(kind, -1) + 1
        dealt[kind, value] = counts[kind] % FOLDS
    members: list[list[int]] = [[] for _ in range(FOLDS)]
    for number, one in enumerate(study.sights):
        members[dealt[one.condition]].append(number)
    return tuple(tuple(one) for one in members if one)


def leave_out(found: Findings, chosen: Explanation | None) -> Left | None:
    """Predict every run from fits to the others; None where there are too few runs.

    In each fold the choice of the effect is made anew from its own runs. Where it is another one than `chosen` has,
    the fold is predicted with that.
    """
    study, nominal = found.study, found.nominal
    folds = folds_of(study)
    if len(study.sights) < FEWEST_RUNS or len(folds) < 2:
        return None
    runs = range(len(study.sights))
    before: dict[int, FloatArray] = {}
    after: dict[int, FloatArray] = {}
    agreed = 0
    for fold in folds:
        others = [one for one in runs if one not in fold]
        coefficients = _fitted(nominal, others, (Part.NOMINAL, Part.DETAIL))
        before |= {one: _residual(nominal, one, *coefficients) for one in fold}
        own = _choice(nominal, others)
        same = chosen is not None and (own is None or own.effect in chosen.effects or len(chosen.effects) > 1)
        agreed += same
        if chosen is not None and same:
            coefficients = _fitted(chosen.design, others, (Part.NOMINAL, Part.DETAIL, Part.EFFECT))
            after |= {one: _residual(chosen.design, one, *coefficients) for one in fold}
        elif chosen is not None and own is not None:
            coefficients = _with_shapes(nominal, others, own)
            after |= {one: _residual(nominal, one, *coefficients) for one in fold}
    if not after:
        after = before
    design = nominal if chosen is None else chosen.design
    return Left(
        tuple(before[one] for one in runs),
        tuple(after[one] for one in runs),
        _squares(nominal, before),
        _squares(design, after),
        agreed / len(folds),
    )


def improvement(found: Findings, one: Explanation) -> float | None:
    """Return the share of the excess that an explanation takes away on runs that took no part in its fit.

    None where there are too few runs, or no excess beyond chance.
    """
    folds = folds_of(found.study)
    if len(found.study.sights) < FEWEST_RUNS or len(folds) < 2:
        return None
    without = with_it = 0.0
    for fold in folds:
        others = [number for number in range(len(found.study.sights)) if number not in fold]
        without += _predicted(found.nominal, fold, *_fitted(found.nominal, others, (Part.NOMINAL, Part.DETAIL)))
        with_it += _predicted(one.design, fold, *_fitted(one.design, others, (Part.NOMINAL, Part.DETAIL, Part.EFFECT)))
    excess = without - found.blocks
    return 1.0 - (with_it - found.blocks) / excess if excess > np.sqrt(2 * found.blocks) else None


def _fitted(design: Design, runs: Sequence[int], parts: tuple[Part, ...]) -> tuple[IndexArray, FloatArray]:
    solution = fit(design, design.total(runs), *parts)
    return solution.columns, solution.found


def _residual(design: Design, run: int, columns: IndexArray, found: FloatArray) -> FloatArray:
    part = design.parts[run]
    return np.asarray(part.residual - part.columns[:, columns] @ found)


def _predicted(design: Design, runs: Sequence[int], columns: IndexArray, found: FloatArray) -> float:
    total, rows = design.total(runs), 1 + columns
    return float(total[0, 0] - 2 * total[0, rows] @ found + found @ total[np.ix_(rows, rows)] @ found)


def _squares(design: Design, residuals: Mapping[int, FloatArray]) -> FloatArray:
    parts = enumerate(design.parts)
    return np.array([float(np.sum(part.whitening.whole(residuals[number]) ** 2)) for number, part in parts])


def _choice(design: Design, runs: Sequence[int]) -> Ranked | None:
    ranked = rank(project(design, design.total(runs), *NUISANCES), design.shapes)
    return ranked[0] if ranked else None


def _with_shapes(design: Design, runs: Sequence[int], own: Ranked) -> tuple[IndexArray, FloatArray]:
    shapes = design.of(Part.SHAPE)[list(own.shapes)]
    columns = np.concatenate((design.of(Part.NOMINAL, Part.DETAIL), shapes))
    total, rows = design.total(runs), 1 + columns
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    whole = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    return columns, np.linalg.solve(whole, total[rows, 0] + precision * mean)
