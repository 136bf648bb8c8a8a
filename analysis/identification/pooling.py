"""One number from several runs that differ by more than their own errors."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.estimates import Estimate
from dragrig.rig.arrays import FloatArray

LARGEST = 1e3
"""Scatter beyond so many times the largest deviation is not looked for."""


@dataclass(frozen=True, slots=True)
class Pooled:
    """A weighted mean.

    Attributes
    ----------
    mean
        Its error holds the scatter between runs.
    scatter
        Standard deviation between runs that was reckoned with, in the unit of the values.
    p_value
        Chance that runs differ so much by errors and the usual scatter; None for one run.
    """

    mean: Estimate
    scatter: float
    p_value: float | None


def pooled(values: FloatArray, covariance: FloatArray, usual_scatter: float) -> Pooled:
    """Return the weighted mean of values of shape `(n,)` with a covariance of their errors, `(n, n)`.

    The scatter between runs is the usual one, or the observed one where that is larger: the one that brings
    the weighted squares down to their expectation (Paule and Mandel, J. Res. NBS 87, 1982).
    """
    from scipy.optimize import brentq
    from scipy.special import chdtrc

    degrees = len(values) - 1
    if degrees == 0:
        error = float(np.sqrt(covariance[0, 0] + usual_scatter**2))
        return Pooled(Estimate(float(values[0]), error), usual_scatter, None)

    def surplus(scatter: float) -> float:
        return _weighted(values, covariance, scatter)[2] - degrees

    scatter, squares = usual_scatter, surplus(usual_scatter) + degrees
    if squares > degrees:
        scatter = float(brentq(surplus, usual_scatter, usual_scatter + LARGEST * float(np.ptp(values))))
    mean, error, _ = _weighted(values, covariance, scatter)
    return Pooled(Estimate(mean, error), scatter, float(chdtrc(degrees, squares)))


def trend(values: FloatArray, covariance: FloatArray, along: FloatArray) -> tuple[float, float]:
    """Return slope and standard error of a straight line through values by generalised least squares."""
    design = np.column_stack((np.ones_like(along), along))
    weight = np.linalg.inv(covariance)
    spread = np.linalg.inv(design.T @ weight @ design)
    slope = float((spread @ design.T @ weight @ values)[1])
    return slope, float(np.sqrt(spread[1, 1]))


def _weighted(values: FloatArray, covariance: FloatArray, scatter: float) -> tuple[float, float, float]:
    """Mean, its error, and the weighted squares about it."""
    weight = np.linalg.inv(covariance + scatter**2 * np.eye(len(values)))
    total = float(weight.sum())
    mean = float(weight.sum(axis=0) @ values) / total
    rest = values - mean
    return mean, total**-0.5, float(rest @ weight @ rest)
