"""The filter of whole runs: forces smoothed, and the speed measured from the position.

The usual window of 0.05 s and order 3 is a compromise. At 500 Hz it brings white noise down 3.3 times
(at 1 kHz 4.8 times) and gives the speed to 0.01 mm/s from counts of 1 µm. The start-up of a drag test takes
0.1 to 0.3 s: between 50 and 90 % of its rise, the simulated one at 20 mm/s takes 0.182 s instead of 0.188 s. A window
of 0.1 s would take noise down only 1.4 times further and doubles the stretch in which a start-up is blurred.
A jump (Coulomb friction as the stage starts) is spread over the window, with an overshoot of a tenth of the
jump. The window matters where the motion itself is short: the peak after a relaxation's ramp of
0.04 to 0.13 s comes out 1 to 3 % low. The run's measures are taken from the raw trace for this reason.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dragrig.analysis.gaps import gap_starts
from dragrig.analysis.phases import in_phase
from dragrig.analysis.savgol import TOO_SHORT, SavgolSettings, Smoothed, smooth
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Event, FilteredTrace, Run, Trace

USUAL_WINDOW_S = 0.05
FEWEST_SAMPLES = 7
"""Of the usual window; at low rates it is that much longer than `USUAL_WINDOW_S`."""
SHORT_MOTION = 4.0
"""A motion shorter than so many windows is blurred, which an event says."""


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """What the filter made of a run, and what is to be said about it."""

    trace: FilteredTrace
    events: tuple[Event, ...]


def usual_settings(sample_rate_hz: float) -> SavgolSettings:
    """Return order 3 over 0.05 s, or over seven samples where these take longer."""
    if USUAL_WINDOW_S * sample_rate_hz < FEWEST_SAMPLES:
        return SavgolSettings(window_samples=FEWEST_SAMPLES)
    return SavgolSettings(window_s=USUAL_WINDOW_S)


def filter_run(run: Run, settings: SavgolSettings | None = None) -> Filtered:
    """Filter every force of a run, and derive `speed` [mm/s] from its position.

    Parameters
    ----------
    settings
        `usual_settings` for the run's rate when left out. A derivative applies to the forces
        (then in mN/s^k); the speed is always the first derivative of the position.

    Raises
    ------
    AnalysisError
        When the window is longer than the run, or does not suit the order or the rate.
    """
    trace = run.trace
    settings = settings or usual_settings(trace.sample_rate_hz)
    gaps = gap_starts(trace.time, trace.sample_rate_hz)

    def smoothed(values: AnyFloatArray, how: SavgolSettings) -> Smoothed:
        try:
            return smooth(values, trace.sample_rate_hz, how, gaps, trace.time)
        except AnalysisError as error:
            raise AnalysisError(f"{run.info.path}: {error}") from error

    forces = [name for name in trace.channels if trace.units.get(name) == "mN"]
    results = {name: smoothed(trace.channels[name], settings) for name in forces}
    speed = replace(settings, order=max(settings.order, 1), derivative=1)
    results["speed"] = smoothed(trace.position, speed)
    channels = {name: result.values for name, result in results.items()}
    force_unit = f"mN/s^{settings.derivative}" if settings.derivative else "mN"
    units = {name: "mm/s" if name == "speed" else force_unit for name in channels} | {"time": "s"}
    events = (*_blurred(trace, settings), *dict.fromkeys(event for one in results.values() for event in one.events))
    parameters = _parameters(settings, trace.sample_rate_hz, channels[trace.signal], events)
    return Filtered(FilteredTrace(trace.time, channels, parameters, units), events)


def filter_file(path: Path, settings: SavgolSettings | None = None) -> Filtered:
    """Filter a run file and store the result in it, beside the raw trace.

    Raises
    ------
    AnalysisError
        As `filter_run`.
    RunFileError, OutputError
        When the file cannot be read, or its changed copy cannot be put in its place.
    """
    from dragrig.rig.runfile import read_run, store_filtered

    filtered = filter_run(read_run(path), settings)
    store_filtered(path, filtered.trace, filtered.events)
    return filtered


def _parameters(
    settings: SavgolSettings, sample_rate_hz: float, signal: FloatArray, events: tuple[Event, ...]
) -> dict[str, Attribute]:
    window = settings.samples(sample_rate_hz)
    return {
        "filter": "Savitzky-Golay",
        "window_s": window / sample_rate_hz,
        "window_samples": window,
        "order": settings.order,
        "derivative": settings.derivative,
        "ends": "polynomial of the first and last window of each unbroken piece",
        "unfiltered_samples": int(np.count_nonzero(np.isnan(signal))),
        "remarks": "; ".join(f"{event.time_s:.3f} s: {event.message}" for event in events),
    }


def _blurred(trace: Trace, settings: SavgolSettings) -> tuple[Event, ...]:
    """Say so when the motion is short beside the window."""
    moving = ~(in_phase(trace, Phase.REST) | in_phase(trace, Phase.HOLD))
    if not moving.any():
        return ()
    begin, end = float(trace.time[moving][0]), float(trace.time[moving][-1])
    window_s = settings.samples(trace.sample_rate_hz) / trace.sample_rate_hz
    if end - begin >= SHORT_MOTION * window_s:
        return ()
    message = f"the motion of {end - begin:.3g} s is short beside the window of {window_s:.3g} s: its force is blurred"
    return (Event(begin, TOO_SHORT, message),)
