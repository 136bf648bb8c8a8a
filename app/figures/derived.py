"""What a picture shows beside the recorded traces: filtered force, measured speed, mean force of steady sliding."""

from dataclasses import dataclass
from math import floor, log10

import numpy as np

from dragrig.analysis.gaps import gap_starts
from dragrig.analysis.measures import measure
from dragrig.analysis.phases import steady_stretch
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.runfile.model import FilteredTrace, Run

WINDOW_S = 0.05
ORDER = 3
FEWEST_SAMPLES = 11
"""A slow sampler has fewer than this in a window; the window is then longer."""


@dataclass(frozen=True, slots=True)
class SteadyLevel:
    """Mean force of steady sliding [mN], and from when to when it was taken [s]."""

    begin_s: float
    end_s: float
    force_mN: float
    text: str


def filtered_of(run: Run) -> FilteredTrace | None:
    """Return what the filter stored in the run's file, or else a Savitzky–Golay filter's view of it.

    None for a run that is shorter than the filter's window.
    """
    if run.filtered is not None:
        return run.filtered
    settings = _settings(run, derivative=0)
    if run.trace.time.size < settings.samples(run.trace.sample_rate_hz):
        return None
    names = [name for name in ("force", "motor_force") if name in run.trace.channels]
    return FilteredTrace(
        time=run.trace.time,
        channels={name: _smoothed(run, run.trace.channels[name], settings) for name in names},
        parameters={"window_s": settings.samples(run.trace.sample_rate_hz) / run.trace.sample_rate_hz, "order": ORDER},
        units={name: run.trace.units[name] for name in names},
    )


def measured_speed(run: Run) -> FloatArray:
    """Speed [mm/s] from the encoder's position, shape `(N,)`; NaN where too few samples are unbroken."""
    settings = _settings(run, derivative=1)
    if run.trace.time.size < settings.samples(run.trace.sample_rate_hz):
        return np.full(run.trace.time.shape, np.nan)
    return _smoothed(run, run.trace.position, settings)


def steady_level(run: Run) -> SteadyLevel | None:
    """Return the mean force of steady sliding; None where the run does not support one."""
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
        return f"{value:.4g}"
    digits = max(0, 1 - floor(log10(standard_error)))
    return f"{value:.{digits}f} ± {standard_error:.{digits}f}"


def _settings(run: Run, derivative: int) -> SavgolSettings:
    samples = 2 * round((WINDOW_S * run.trace.sample_rate_hz - 1) / 2) + 1
    return SavgolSettings(window_samples=max(samples, FEWEST_SAMPLES), order=ORDER, derivative=derivative)


def _smoothed(run: Run, values: AnyFloatArray, settings: SavgolSettings) -> FloatArray:
    rate = run.trace.sample_rate_hz
    return smooth(values, rate, settings, gap_starts(run.trace.time, rate)).values
