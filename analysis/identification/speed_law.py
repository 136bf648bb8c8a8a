"""Steady drag as a straight line in ln v, which is how the paper sums its model up."""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.estimates import NORMAL_95
from dragrig.analysis.identification.results import LogLaw, Quantity, SpeedPoint

FEWEST_SPEEDS = 3


def log_law(points: Sequence[SpeedPoint]) -> LogLaw | None:
    """Fit intercept + slope · ln(v / 1 mm/s) by weighted least squares; None for fewer than three speeds.

    The intervals are those of the line through the points at these speeds, by the points' errors. Where
    `lack_of_fit_p` is small, no straight line describes them, and other speeds would give another one.
    """
    from scipy.special import chdtrc

    if len(points) < FEWEST_SPEEDS:
        return None
    force = np.array([point.force.value for point in points], dtype=float)
    error = np.array([point.force.standard_error for point in points], dtype=float)
    if not (error > 0).all():
        return None
    design = np.column_stack((np.ones(len(points)), np.log([abs(point.speed_mm_s) for point in points])))
    weighted = design / error[:, None]
    covariance = np.linalg.inv(weighted.T @ weighted)
    found = covariance @ weighted.T @ (force / error)
    stray = (force - design @ found) / error
    degrees, squares = len(points) - 2, float(stray @ stray)
    errors = np.sqrt(np.diag(covariance))
    weight = error**-2
    about_mean = force - float(weight @ force) / float(weight.sum())
    spread = float(weight @ about_mean**2)
    intercept, slope = (
        Quantity(name, "mN", float(value), float(one), (float(value - NORMAL_95 * one), float(value + NORMAL_95 * one)))
        for name, value, one in zip(("intercept", "slope"), found, errors, strict=True)
    )
    return LogLaw(
        intercept=intercept,
        slope=slope,
        correlation=float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])),
        r2=1 - squares / spread if spread else float("nan"),
        lack_of_fit_p=float(chdtrc(degrees, squares)),
    )
