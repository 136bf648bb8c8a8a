"""What a picture shows beside the recorded traces: the filtered force and the measured speed."""

import numpy as np

from dragrig.analysis.gaps import gap_starts
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.runfile.model import FilteredTrace, Run

WINDOW_S = 0.05
ORDER = 3
FEWEST_SAMPLES = 11
"""A slow sampler has fewer than this in a window; the window is then longer."""


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


def _settings(run: Run, derivative: int) -> SavgolSettings:
    samples = 2 * round((WINDOW_S * run.trace.sample_rate_hz - 1) / 2) + 1
    return SavgolSettings(window_samples=max(samples, FEWEST_SAMPLES), order=ORDER, derivative=derivative)


def _smoothed(run: Run, values: AnyFloatArray, settings: SavgolSettings) -> FloatArray:
    rate = run.trace.sample_rate_hz
    return smooth(values, rate, settings, gap_starts(run.trace.time, rate)).values
