"""Fits within a design: least squares with priors, by its Gram matrices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.design import Design, IndexArray, Part
from dragrig.rig.arrays import FloatArray

TINY = 1e-10
"""Relative ridge against columns that say the same."""
NUISANCES = (Part.NOMINAL, Part.DETAIL, Part.EFFECT, Part.FOREIGN)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
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


def fit(design: Design, total: FloatArray, *parts: Part) -> Fit:
    """Fit the columns of these kinds to runs whose Gram matrices sum to `total`."""
    columns = design.of(*parts)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    rows = 1 + columns
    gram = total[np.ix_(rows, rows)]
    whole = gram + np.diag(precision + TINY * np.diag(gram))
    along = total[rows, 0] + precision * mean
    inverse = np.asarray(np.linalg.inv(whole), dtype=np.float64)
    found = inverse @ along
    squares = float(total[0, 0] + np.sum(precision * mean**2) - along @ found)
    return Fit(columns, found, inverse, squares)


def fit_within(design: Design, total: FloatArray, reach: tuple[FloatArray, FloatArray], *parts: Part) -> FloatArray:
    """Return the most probable coefficients of the columns of these kinds that lie within bounds, shape `(c,)`."""
    from scipy.optimize import lsq_linear

    columns = design.of(*parts)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    gram = total[np.ix_(1 + columns, 1 + columns)]
    scale = 1.0 / np.sqrt(np.diag(gram) + precision + 1e-300)
    along = scale * (total[1 + columns, 0] + precision * mean)
    whole = scale[:, None] * (gram + np.diag(precision)) * scale + TINY * np.eye(len(columns))
    root = np.linalg.cholesky(whole)
    low, high = (np.minimum(reach[0], -1e-9) / scale, np.maximum(reach[1], 1e-9) / scale)
    found = lsq_linear(root.T, np.linalg.solve(root, along), (low, high), method="bvls")
    return np.asarray(found.x * scale, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
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

    def without(self, shapes: Sequence[int]) -> "Projected":
        """Take some of the shapes out too."""
        index = list(shapes)
        own = self.gram[np.ix_(index, index)]
        ridge = 1e-9 * (np.trace(own) + 1e-300) * np.eye(len(index))
        solved = np.linalg.solve(own + ridge, np.column_stack((self.along[index], self.gram[index])))
        return Projected(
            self.squares - float(self.along[index] @ solved[:, 0]),
            self.along - self.gram[:, index] @ solved[:, 0],
            self.gram - self.gram[:, index] @ solved[:, 1:],
        )


def project(design: Design, total: FloatArray, *parts: Part) -> Projected:
    """Take the columns of these kinds out of residual and dictionary."""
    left = taken_out(design, total, design.of(*parts), 1 + design.of(Part.SHAPE))
    return Projected(float(left[0, 0]), left[0, 1:], left[1:, 1:])


def taken_out(
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
    solved = np.linalg.solve(gram + np.diag(precision + TINY * np.diag(gram)), along)
    left = total[np.ix_(others, others)] - along.T @ solved
    left[0, 0] += np.sum(precision * mean**2)
    return np.asarray(left)
