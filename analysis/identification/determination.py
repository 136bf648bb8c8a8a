"""R² of the model by speed band, in the form that the paper prints and in the one that it names."""

from collections.abc import Iterator, Sequence

import numpy as np

from dragrig.analysis.identification.results import Boundary, Determination, SpeedPoint
from dragrig.rig.arrays import FloatArray

FEWEST_SPEEDS = 3
PAPERS_BOUNDARY_MM_S = 20.0
TOLERANCE = 0.01
"""A stage that is so much faster than the speed it was set to is still at that speed."""


def eq15(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the paper's Eq. 15, Σ(f₁ − f̄₁)² / Σ(f₂ − f̄₁)²; None where the measured forces all equal f̄₁.

    f₁ is the model, f₂ the measurement, and f̄₁ the model's mean in both sums: no share of anything, and above 1
    where the model varies more than the measurement.
    """
    mean = float(model.mean())
    about_mean = float(((measured - mean) ** 2).sum())
    return float(((model - mean) ** 2).sum()) / about_mean if about_mean else None


def squared_correlation(model: FloatArray, measured: FloatArray) -> float | None:
    """Return the square of the correlation, which the paper introduces Eq. 15 as; None where either is constant."""
    if np.ptp(model) == 0 or np.ptp(measured) == 0:
        return None
    return float(np.corrcoef(model, measured)[0, 1] ** 2)


def determinations(
    points: Sequence[SpeedPoint], boundary: Boundary | None, prefix: str = ""
) -> tuple[Determination, ...]:
    """Compare model and measurement over all speeds, and below and above the paper's and the estimated boundary."""
    return tuple(_of(prefix + name, band) for name, band in _bands(points, boundary))


def _bands(points: Sequence[SpeedPoint], boundary: Boundary | None) -> Iterator[tuple[str, list[SpeedPoint]]]:
    yield "all speeds", list(points)
    limits = [(PAPERS_BOUNDARY_MM_S, "")]
    if boundary is not None and boundary.speed_mm_s is not None:
        limits.append((boundary.speed_mm_s, " (estimated boundary)"))
    for limit, note in limits:
        highest = limit * (1 + TOLERANCE)
        yield f"up to {limit:.3g} mm/s{note}", [point for point in points if abs(point.speed_mm_s) <= highest]
        yield f"above {limit:.3g} mm/s{note}", [point for point in points if abs(point.speed_mm_s) > highest]


def _of(band: str, points: Sequence[SpeedPoint]) -> Determination:
    if len(points) < FEWEST_SPEEDS:
        return Determination(band, len(points), None, None)
    model = np.array([point.model_mN for point in points])
    measured = np.array([point.force.value for point in points], dtype=float)
    return Determination(band, len(points), eq15(model, measured), squared_correlation(model, measured))
