"""Fits within a linearised campaign: least squares with priors, Gauss-Newton steps, ranking of the dictionary."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import atan2, hypot

import numpy as np

from dragrig.analysis.gap.candidates import Candidate, EffectVariant
from dragrig.analysis.gap.design import ColumnKind, Design, Study, linearise
from dragrig.rig.arrays import FloatArray, IndexArray

RELATIVE_RIDGE = 1e-10
"""Relative ridge against columns that say the same."""
NUISANCES = (ColumnKind.NOMINAL, ColumnKind.DETAIL, ColumnKind.EFFECT, ColumnKind.FOREIGN)


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """The most probable coefficients of some columns.

    Attributes
    ----------
    columns
        Which.
    found, covariance
        Coefficients and their covariance, shapes `(c,)` and `(c, c)`.
    squares
        Whitened squares that remain, those of the priors included.
    """

    columns: IndexArray
    found: FloatArray
    covariance: FloatArray
    squares: float

    def of(self, columns: IndexArray) -> FloatArray:
        """Return the coefficients of some of the columns."""
        return self.found[np.searchsorted(self.columns, columns)]


def fit_columns(design: Design, total: FloatArray, *parts: ColumnKind) -> LeastSquaresFit:
    """Fit the columns of these kinds to runs whose Gram matrices sum to `total`."""
    columns = design.of(*parts)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    rows = 1 + columns
    gram = total[np.ix_(rows, rows)]
    whole = gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram))
    along = total[rows, 0] + precision * mean
    inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    found = inverse @ along
    squares = float(total[0, 0] + np.sum(precision * mean**2) - along @ found)
    return LeastSquaresFit(columns, found, inverse, squares)


def fit_bounded(
    design: Design, total: FloatArray, reach: tuple[FloatArray, FloatArray], *parts: ColumnKind
) -> FloatArray:
    """Return the most probable coefficients of the columns of these kinds that lie within bounds, shape `(c,)`."""
    from scipy.optimize import lsq_linear

    columns = design.of(*parts)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    gram = total[np.ix_(1 + columns, 1 + columns)]
    scale = 1.0 / np.sqrt(np.diag(gram) + precision + 1e-300)
    along = scale * (total[1 + columns, 0] + precision * mean)
    whole = scale[:, None] * (gram + np.diag(precision)) * scale + RELATIVE_RIDGE * np.eye(len(columns))
    root = np.linalg.cholesky(whole)
    low, high = (np.minimum(reach[0], -1e-9) / scale, np.maximum(reach[1], 1e-9) / scale)
    found = lsq_linear(root.T, np.linalg.solve(root, along), (low, high), method="bvls")
    return np.asarray(found.x * scale, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedDictionary:
    """The dictionary once nuisances have taken what they can.

    Attributes
    ----------
    squares
        What remains of the residual.
    along, gram
        Products of the shapes with it and with each other, shapes `(S,)` and `(S, S)`.
    """

    squares: float
    along: FloatArray
    gram: FloatArray

    def without(self, shapes: Sequence[int]) -> "ProjectedDictionary":
        """Take some of the shapes out too."""
        index = list(shapes)
        own = self.gram[np.ix_(index, index)]
        ridge = 1e-9 * (np.trace(own) + 1e-300) * np.eye(len(index))
        solved = np.linalg.solve(own + ridge, np.column_stack((self.along[index], self.gram[index])))
        return ProjectedDictionary(
            self.squares - float(self.along[index] @ solved[:, 0]),
            self.along - self.gram[:, index] @ solved[:, 0],
            self.gram - self.gram[:, index] @ solved[:, 1:],
        )


def project_dictionary(design: Design, total: FloatArray, *parts: ColumnKind) -> ProjectedDictionary:
    """Take the columns of these kinds out of residual and dictionary."""
    left = schur_complement(design, total, design.of(*parts), 1 + design.of(ColumnKind.SHAPE))
    return ProjectedDictionary(float(left[0, 0]), left[0, 1:], left[1:, 1:])


def schur_complement(
    design: Design, total: FloatArray, columns: IndexArray, kept: IndexArray, rows: IndexArray | None = None
) -> FloatArray:
    """Return what columns of a design leave of the products of residual and others, the residual first.

    Parameters
    ----------
    total
        Gram matrix of the residual, which comes first, those columns, and others.
    columns
        Those that take what they can, within their priors.
    kept
        The others' `k` rows in `total`; the result has shape `(1 + k, 1 + k)`.
    rows
        Those of the columns; as the design counts them unless given.
    """
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    own, others = 1 + columns if rows is None else rows, np.concatenate(([0], kept))
    gram, along = total[np.ix_(own, own)], total[np.ix_(own, others)]
    along[:, 0] += precision * mean
    solved = np.linalg.solve(gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram)), along)
    left = total[np.ix_(others, others)] - along.T @ solved
    left[0, 0] += np.sum(precision * mean**2)
    return np.asarray(left)


MAX_STEP_SD = 3.0
"""So far a nominal parameter may move in one step, in standard deviations of its prior."""
MAX_DEVIATION_SD = 4.5
"""So far it may be from what was known beforehand."""
CONVERGED_STEP_SD = 0.1
"""A step below this in all of them is the last."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterPoint:
    """Nominal parameters in units of their priors, and effects."""

    z: FloatArray
    candidates: tuple[Candidate, ...] = ()


def gauss_newton(study: Study, start: ParameterPoint, steps: int, near: Design | None = None) -> ParameterPoint:
    """Return where Gauss–Newton steps lead from a point.

    Parameters
    ----------
    steps
        At most so many.
    near
        The campaign around a point nearby, whose derivatives are kept for all steps; taken anew in each unless given.
    """
    point = start
    for _ in range(steps):
        design = linearise(study, point.z, point.candidates, near=near)
        after = gauss_newton_step(design)
        moved = float(np.abs(after.z - point.z).max())
        point = after
        if moved < CONVERGED_STEP_SD and not point.candidates:
            break
    return point


def gauss_newton_step(design: Design) -> ParameterPoint:
    """Return the point that a design leads to, nothing in it moved further than may be."""
    parts = (ColumnKind.NOMINAL, ColumnKind.DETAIL, ColumnKind.EFFECT)
    nominal = (
        np.maximum(-MAX_STEP_SD, -MAX_DEVIATION_SD - design.z),
        np.minimum(MAX_STEP_SD, MAX_DEVIATION_SD - design.z),
    )
    free = np.full(len(design.of(ColumnKind.DETAIL)), np.inf)
    reaches = [nominal, (-free, free), *(one.reach() for one in design.candidates)]
    low, high = (np.concatenate(side) for side in zip(*reaches, strict=True))
    found = fit_bounded(design, design.total(), (low, high), *parts)
    z = np.clip(design.z + found[: len(design.z)], -MAX_DEVIATION_SD, MAX_DEVIATION_SD)
    steps = found[len(design.z) + len(free) :]
    candidates = []
    for one in design.candidates:
        own, steps = steps[: len(one.fitted)], steps[len(one.fitted) :]
        candidates.append(one.moved(own))
    return ParameterPoint(z, tuple(candidates))


def joint_fit(design: Design, shapes: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Fit nuisances and some shapes at once; return the nominal parameters and the shapes' amplitudes."""
    columns = np.concatenate((design.of(*NUISANCES), design.of(ColumnKind.SHAPE)[list(shapes)]))
    rows = 1 + columns
    total = design.total()
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    whole = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    found = np.linalg.solve(whole, total[rows, 0] + precision * mean)
    nominal = len(design.of(ColumnKind.NOMINAL))
    z = np.clip(
        design.z + np.clip(found[:nominal], -MAX_STEP_SD - 1, MAX_STEP_SD + 1), -MAX_DEVIATION_SD, MAX_DEVIATION_SD
    )
    return z, found[len(found) - len(shapes) :]


@dataclass(frozen=True, slots=True, eq=False)
class RankedEffect:
    """The best shape of an effect.

    Attributes
    ----------
    gain
        Half the whitened squares that it takes away.
    per_unit
        d′ of the effect at its usual size: the norm of its signature once nuisances are taken out.
    shapes
        Columns of the dictionary, two for a periodic shape.
    amplitude
        Their coefficients, in usual sizes.
    """

    effect: str
    gain: float
    per_unit: float
    shapes: tuple[int, ...]
    amplitude: FloatArray

    def candidate(self, dictionary: Sequence[EffectVariant], amplitude: FloatArray | None = None) -> Candidate:
        """Return the effect with the values of this shape, its size as fitted here or as given."""
        shape = dictionary[self.shapes[0]]
        effect, found = shape.effect, self.amplitude if amplitude is None else amplitude
        values = dict(shape.values)
        phase = effect.phase
        if phase is None:
            values[effect.size.name] *= float(found[0])
        else:
            values[effect.size.name] *= hypot(*found.tolist())
            values[phase.name] = atan2(float(found[1]), float(found[0]))
        size = values[effect.size.name]
        values[effect.size.name] = float(np.clip(size, effect.size.low, effect.size.high))
        return Candidate(effect, values)


def rank_effects(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> tuple[RankedEffect, ...]:
    """Return the best shape of every effect, the best effect first."""
    found: dict[str, RankedEffect] = {}
    for one in _scored_variants(projected, dictionary):
        if one.effect not in found or one.gain > found[one.effect].gain:
            found[one.effect] = one
    return tuple(sorted(found.values(), key=lambda one: -one.gain))


def _scored_variants(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> Iterator[RankedEffect]:
    numbered = list(enumerate(dictionary))
    for _, group in groupby(numbered, key=lambda pair: (pair[1].effect.id, pair[1].twin)):
        index = [number for number, _ in group]
        shape = dictionary[index[0]]
        gram, along = projected.gram[np.ix_(index, index)], projected.along[index]
        strength = float(np.trace(gram)) / len(index)
        if strength <= 1e-9:
            continue
        amplitude = np.asarray(np.linalg.solve(gram + 1e-9 * strength * np.eye(len(index)), along), dtype=np.float64)
        gain = 0.5 * float(along @ amplitude)
        if shape.signed and amplitude[0] < 0:
            gain, amplitude = 0.0, 0.0 * amplitude
        yield RankedEffect(shape.effect.id, gain, float(np.sqrt(strength)), tuple(index), amplitude)
