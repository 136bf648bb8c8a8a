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
"""Relative ridge against collinear columns."""
NUISANCES = (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT, ColumnKind.MODULATION)


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """Posterior mode of the coefficients of some columns.

    Attributes
    ----------
    columns
        Indices of the columns.
    coefficients, covariance
        Coefficients and their posterior covariance, shapes `(c,)` and `(c, c)`.
    chi2
        Remaining chi-square, priors included.
    """

    columns: IndexArray
    coefficients: FloatArray
    covariance: FloatArray
    chi2: float

    def coefficients_of(self, columns: IndexArray) -> FloatArray:
        """Return the coefficients of some of the columns."""
        return self.coefficients[np.searchsorted(self.columns, columns)]


def fit_columns(design: Design, total: FloatArray, *kinds: ColumnKind) -> LeastSquaresFit:
    """Fit the columns of these kinds to runs whose Gram matrices sum to `total`."""
    columns = design.columns_of(*kinds)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    rows = 1 + columns
    gram = total[np.ix_(rows, rows)]
    precision_matrix = gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram))
    moment = total[rows, 0] + precision * mean
    covariance = np.asarray(np.linalg.inv(precision_matrix), dtype=np.float64)
    coefficients = covariance @ moment
    chi2 = float(total[0, 0] + np.sum(precision * mean**2) - moment @ coefficients)
    return LeastSquaresFit(columns, coefficients, covariance, chi2)


def fit_bounded(
    design: Design, total: FloatArray, bounds: tuple[FloatArray, FloatArray], *kinds: ColumnKind
) -> FloatArray:
    """Return the posterior mode of the columns of these kinds within bounds, shape `(c,)`."""
    from scipy.optimize import lsq_linear

    columns = design.columns_of(*kinds)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    gram = total[np.ix_(1 + columns, 1 + columns)]
    scale = 1.0 / np.sqrt(np.diag(gram) + precision + 1e-300)
    moment = scale * (total[1 + columns, 0] + precision * mean)
    precision_matrix = scale[:, None] * (gram + np.diag(precision)) * scale + RELATIVE_RIDGE * np.eye(len(columns))
    root = np.linalg.cholesky(precision_matrix)
    low, high = (np.minimum(bounds[0], -1e-9) / scale, np.maximum(bounds[1], 1e-9) / scale)
    solution = lsq_linear(root.T, np.linalg.solve(root, moment), (low, high), method="bvls")
    return np.asarray(solution.x * scale, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedDictionary:
    """The dictionary with nuisances projected out.

    Attributes
    ----------
    chi2
        Chi-square that the nuisances leave.
    moment, gram
        Products of the variants with the residual and with each other, shapes `(S,)` and `(S, S)`.
    """

    chi2: float
    moment: FloatArray
    gram: FloatArray

    def without(self, variants: Sequence[int]) -> "ProjectedDictionary":
        """Project out some of the variants, too."""
        index = list(variants)
        own = self.gram[np.ix_(index, index)]
        ridge = 1e-9 * (np.trace(own) + 1e-300) * np.eye(len(index))
        solved = np.linalg.solve(own + ridge, np.column_stack((self.moment[index], self.gram[index])))
        return ProjectedDictionary(
            self.chi2 - float(self.moment[index] @ solved[:, 0]),
            self.moment - self.gram[:, index] @ solved[:, 0],
            self.gram - self.gram[:, index] @ solved[:, 1:],
        )


def project_dictionary(design: Design, total: FloatArray, *kinds: ColumnKind) -> ProjectedDictionary:
    """Project the columns of these kinds out of residual and dictionary."""
    complement = schur_complement(design, total, design.columns_of(*kinds), 1 + design.columns_of(ColumnKind.VARIANT))
    return ProjectedDictionary(float(complement[0, 0]), complement[0, 1:], complement[1:, 1:])


def schur_complement(
    design: Design,
    total: FloatArray,
    columns: IndexArray,
    retained_rows: IndexArray,
    column_rows: IndexArray | None = None,
) -> FloatArray:
    """Return the products of residual (first) and other rows after columns of a design are projected out.

    Parameters
    ----------
    total
        Gram matrix of the residual (first), the columns, and other rows.
    columns
        Indices of the columns to project out, within their priors.
    retained_rows
        Other `k` rows of `total` to retain; the result has shape `(1 + k, 1 + k)`.
    column_rows
        Rows of the columns in `total`; default: as in the design.
    """
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    projected, retained = 1 + columns if column_rows is None else column_rows, np.concatenate(([0], retained_rows))
    gram, cross = total[np.ix_(projected, projected)], total[np.ix_(projected, retained)]
    cross[:, 0] += precision * mean
    solved = np.linalg.solve(gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram)), cross)
    complement = total[np.ix_(retained, retained)] - cross.T @ solved
    complement[0, 0] += np.sum(precision * mean**2)
    return np.asarray(complement)


MAX_STEP_SD = 3.0
"""Largest step of a nominal parameter, in prior standard deviations."""
MAX_DEVIATION_SD = 4.5
"""Largest deviation of a nominal parameter from its prior mean, in prior standard deviations."""
CONVERGED_STEP_SD = 0.1
"""Converged when every nominal parameter moves by less than this."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterPoint:
    """Nominal parameters in prior standard deviations, and candidate effects."""

    z: FloatArray
    candidates: tuple[Candidate, ...] = ()


def gauss_newton(study: Study, start: ParameterPoint, steps: int, reference: Design | None = None) -> ParameterPoint:
    """Return the point that Gauss-Newton steps lead to.

    Parameters
    ----------
    steps
        Maximum number of steps.
    reference
        Design around a nearby point whose derivatives are kept; default: new ones in each step.
    """
    point = start
    for _ in range(steps):
        design = linearise(study, point.z, point.candidates, reference=reference)
        after = gauss_newton_step(design)
        moved = float(np.abs(after.z - point.z).max())
        point = after
        if moved < CONVERGED_STEP_SD and not point.candidates:
            break
    return point


def gauss_newton_step(design: Design) -> ParameterPoint:
    """Return the point that one bounded step from a design's point leads to."""
    kinds = (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    nominal = (
        np.maximum(-MAX_STEP_SD, -MAX_DEVIATION_SD - design.z),
        np.minimum(MAX_STEP_SD, MAX_DEVIATION_SD - design.z),
    )
    free = np.full(len(design.columns_of(ColumnKind.MODEL_ERROR)), np.inf)
    bounds = [nominal, (-free, free), *(candidate.step_bounds() for candidate in design.candidates)]
    low, high = (np.concatenate(side) for side in zip(*bounds, strict=True))
    steps_of_all = fit_bounded(design, design.total_gram(), (low, high), *kinds)
    z = np.clip(design.z + steps_of_all[: len(design.z)], -MAX_DEVIATION_SD, MAX_DEVIATION_SD)
    steps = steps_of_all[len(design.z) + len(free) :]
    candidates = []
    for candidate in design.candidates:
        own_steps, steps = steps[: len(candidate.fitted_parameters)], steps[len(candidate.fitted_parameters) :]
        candidates.append(candidate.moved(own_steps))
    return ParameterPoint(z, tuple(candidates))


def joint_fit(design: Design, variants: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Fit nuisances and some variants together; return nominal parameters and the variants' amplitudes."""
    columns = np.concatenate((design.columns_of(*NUISANCES), design.columns_of(ColumnKind.VARIANT)[list(variants)]))
    rows = 1 + columns
    total = design.total_gram()
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    precision_matrix = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    coefficients = np.linalg.solve(precision_matrix, total[rows, 0] + precision * mean)
    count = len(design.columns_of(ColumnKind.NOMINAL))
    z = np.clip(
        design.z + np.clip(coefficients[:count], -MAX_STEP_SD - 1, MAX_STEP_SD + 1), -MAX_DEVIATION_SD, MAX_DEVIATION_SD
    )
    return z, coefficients[len(coefficients) - len(variants) :]


@dataclass(frozen=True, slots=True, eq=False)
class RankedEffect:
    """The best variant of an effect.

    Attributes
    ----------
    llr
        Log likelihood ratio: half the chi-square difference.
    d_prime_per_unit
        d′ of the effect at its default size: the norm of its signature with nuisances projected out.
    variants
        Indices in the dictionary; two for a periodic effect.
    amplitude
        Their coefficients, in default sizes.
    """

    effect: str
    llr: float
    d_prime_per_unit: float
    variants: tuple[int, ...]
    amplitude: FloatArray

    def candidate(self, dictionary: Sequence[EffectVariant], amplitude: FloatArray | None = None) -> Candidate:
        """Return the effect with the parameters of this variant and a size from the amplitude."""
        variant = dictionary[self.variants[0]]
        effect, fitted = variant.effect, self.amplitude if amplitude is None else amplitude
        values = dict(variant.values)
        phase = effect.phase
        if phase is None:
            values[effect.size.name] *= float(fitted[0])
        else:
            values[effect.size.name] *= hypot(*fitted.tolist())
            values[phase.name] = atan2(float(fitted[1]), float(fitted[0]))
        size = values[effect.size.name]
        values[effect.size.name] = float(np.clip(size, effect.size.low, effect.size.high))
        return Candidate(effect, values)


def rank_effects(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> tuple[RankedEffect, ...]:
    """Return the best variant of every effect, by decreasing log likelihood ratio."""
    best: dict[str, RankedEffect] = {}
    for ranked in _scored_variants(projected, dictionary):
        if ranked.effect not in best or ranked.llr > best[ranked.effect].llr:
            best[ranked.effect] = ranked
    return tuple(sorted(best.values(), key=lambda ranked: -ranked.llr))


def _scored_variants(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> Iterator[RankedEffect]:
    numbered = list(enumerate(dictionary))
    for _, group in groupby(numbered, key=lambda pair: (pair[1].effect.id, pair[1].quadrature_key)):
        index = [number for number, _ in group]
        variant = dictionary[index[0]]
        gram, moment = projected.gram[np.ix_(index, index)], projected.moment[index]
        strength = float(np.trace(gram)) / len(index)
        if strength <= 1e-9:
            continue
        amplitude = np.asarray(np.linalg.solve(gram + 1e-9 * strength * np.eye(len(index)), moment), dtype=np.float64)
        llr = 0.5 * float(moment @ amplitude)
        if variant.one_signed and amplitude[0] < 0:
            llr, amplitude = 0.0, 0.0 * amplitude
        yield RankedEffect(variant.effect.id, llr, float(np.sqrt(strength)), tuple(index), amplitude)
