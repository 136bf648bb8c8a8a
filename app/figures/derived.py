"""What a picture shows beside the recorded traces: filtered force, measured speed, mean force of steady sliding."""

from dataclasses import dataclass
from math import floor, log10

import numpy as np

from dragrig.analysis.filtering import filter_run
from dragrig.analysis.measures import measure
from dragrig.analysis.phases import steady_stretch
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import FilteredTrace, Run

SLIDING_KINDS = frozenset({"drag", "coulomb", "blank", "return"})
"""Kinds of run whose steady phase is one stretch of steady sliding."""


@dataclass(frozen=True, slots=True)
class SteadyLevel:
    """Mean force of steady sliding [mN], and from when to when it was taken [s]."""

    begin_s: float
    end_s: float
    force_mN: float
    text: str


def filtered_of(run: Run) -> FilteredTrace | None:
    """Return what the filter stored in the run's file, or else what it makes of the run by itself.

    A stored derivative of the force is passed over. None for a run that is shorter than the filter's window.
    """
    if run.filtered is not None and run.filtered.units.get(run.trace.signal) == "mN":
        return run.filtered
    try:
        return filter_run(run).trace
    except AnalysisError:
        return None


def measured_speed(run: Run, filtered: FilteredTrace | None) -> FloatArray:
    """Speed [mm/s] from the encoder's position, shape `(N,)`; NaN for a run that is too short for one."""
    if filtered is not None and "speed" in filtered.channels and filtered.time.shape == run.trace.time.shape:
        return filtered.channels["speed"]
    return np.full(run.trace.time.shape, np.nan)


def steady_level(run: Run) -> SteadyLevel | None:
    """Return the mean force of steady sliding; None where the run is of another kind, or does not support one."""
    if run.info.kind not in SLIDING_KINDS:
        return None
    estimate = measure(run).steady_force
    stretch, _ = steady_stretch(run)
    if estimate.value is None or not stretch.any():
        return None
    inside = run.trace.time[stretch]
    text = f"steady {with_error(estimate.value, estimate.standard_error)} mN"
    return SteadyLevel(float(inside[0]), float(inside[-1]), estimate.value, text)


def with_error(value: float, standard_error: float | None) -> str:
    """Spell a value with its error, both to the error's second digit: 113.24 ± 0.21."""
    if standard_error is None or not standard_error > 0:
        return f"{value:.4g}".replace("-", "−")
    digits = max(0, 1 - floor(log10(standard_error)))
    return f"{value:.{digits}f} ± {standard_error:.{digits}f}".replace("-", "−")
