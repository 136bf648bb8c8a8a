"""Measures of one run, each with its standard error or the reason why it is missing."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from dragrig.analysis.estimates import MIN_SAMPLES_FOR_MEAN, Estimate, correlated_mean, missing
from dragrig.analysis.savgol import SavgolSettings, smooth_channel
from dragrig.analysis.segments import Mask, clipped_samples, end_of_hold, in_phase, steady_stretch
from dragrig.config.errors import AnalysisError
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run

MAX_NOISE_CORRELATION_S = 2.0
"""Largest correlation time allowed for the sensor's slow noise, ten times the typical 0.2 s."""
PEAK_WINDOW_S = 0.01
"""Window of the smoothing before the peak is searched; at least five samples.

A relaxation's peak is a cusp: over the filter's default window of 0.05 s it would come out 2 to 3 % low.
"""
STICKING_KINDS = frozenset({"relaxation"})


@dataclass(frozen=True, slots=True)
class RunMeasures:
    """Measures of one run; forces in mN, those of the run's signal as recorded, never filtered or zeroed.

    Attributes
    ----------
    steady_force
        Mean over the steady sliding (see `phases.steady_stretch`), the rest offset included.
    rest_offset
        Mean while at rest before the motion. Zero offset of the sensor, and in a drag test also the
        force of the relaxed wall on the resting capsule.
    peak_force
        Signed extreme of the lightly smoothed force. The error covers white noise only; being the
        largest of many samples it lies, on average, about one to two such errors too far out.
    peak_time_s
        Time of the peak.
    hold_force
        Mean over the end of the hold.
    speed
        Slope of the position over the steady phase [mm/s], positive or negative.
    steady_from
        Stretch over which the steady force was averaged, in words.
    """

    steady_force: Estimate
    rest_offset: Estimate
    peak_force: Estimate
    peak_time_s: float | None
    hold_force: Estimate
    speed: Estimate
    steady_from: str


def measure(run: Run) -> RunMeasures:
    """Measure a run; a measure that its data do not support is missing, with the reason, and nothing is raised."""
    trace = run.trace
    clipped = clipped_samples(run)
    stretch, chosen_by = steady_stretch(run)
    if run.info.kind in STICKING_KINDS:
        steady = missing(f"a {run.info.kind} run has no steady sliding")
    elif not stretch.any():
        steady = missing(empty_stretch_reason(chosen_by))
    else:
        steady = stretch_mean(run, stretch, clipped, chosen_by)
    rest, hold = in_phase(trace, Phase.REST), end_of_hold(trace)
    rest_offset, hold_force = missing("the run has no rest phase"), missing("the run has no hold phase")
    if rest.any():
        rest_offset = stretch_mean(run, rest, clipped, "the rest")
    if hold.any():
        hold_force = stretch_mean(run, hold, clipped, "the end of the hold")
    peak, peak_time_s = _peak(run, clipped)
    return RunMeasures(
        steady_force=steady,
        rest_offset=rest_offset,
        peak_force=peak,
        peak_time_s=peak_time_s,
        hold_force=hold_force,
        speed=_speed(run),
        steady_from=chosen_by,
    )


def empty_stretch_reason(chosen_by: str) -> str:
    """Why no sample shows steady sliding, by the words of `steady_stretch`."""
    return f"no sample is left in {chosen_by}" if "phase after" in chosen_by else chosen_by


def stretch_mean(run: Run, stretch: Mask, clipped: Mask, name: str) -> Estimate:
    """Mean force [mN] over a stretch; missing where samples in it are clipped or NaN."""
    if lost := int(np.count_nonzero(stretch & clipped)):
        return missing(f"{lost} samples in {name} are clipped at the end of the sensor's range")
    mean = correlated_mean(run.trace.force[stretch], MAX_NOISE_CORRELATION_S * run.trace.sample_rate_hz)
    return missing(f"{name}: {mean.reason}") if mean.reason else mean


def _peak(run: Run, clipped: Mask) -> tuple[Estimate, float | None]:
    trace = run.trace
    if clipped.any():
        return missing(f"{int(clipped.sum())} samples are clipped at the end of the sensor's range"), None
    settings = SavgolSettings(window_samples=max(5, 2 * int(PEAK_WINDOW_S * trace.sample_rate_hz / 2) + 1), order=2)
    force = np.asarray(trace.force, dtype=np.float64)
    try:
        smoothed = smooth_channel(trace, force, settings).values
    except AnalysisError:
        return missing(f"only {len(force)} samples"), None
    smoothed = np.where(np.isnan(smoothed), force, smoothed)
    if np.isnan(smoothed).any():
        return missing("samples are missing (NaN), and the peak may be among them"), None
    kernel = settings.kernel(trace.sample_rate_hz)
    own_weight = float(kernel.weights[kernel.half])
    at = int(np.abs(smoothed).argmax())
    noise = 1.4826 * float(np.median(np.abs(force - smoothed))) / sqrt(1 - own_weight)
    return Estimate(float(smoothed[at]), noise * sqrt(own_weight)), float(trace.time[at])


def _speed(run: Run) -> Estimate:
    trace = run.trace
    steady = in_phase(trace, Phase.STEADY)
    if np.count_nonzero(steady) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"the steady phase holds fewer than {MIN_SAMPLES_FOR_MEAN} samples")
    position, time = np.asarray(trace.position[steady], dtype=np.float64), trace.time[steady]
    if not np.isfinite(position).all():
        return missing("positions are missing (NaN)")
    centred = time - time.mean()
    spread = float(centred @ centred)
    slope = float(centred @ (position - position.mean())) / spread
    deviation = position - position.mean() - slope * centred
    # The error of a least-squares slope, with as many independent deviations as their correlation leaves.
    effective = correlated_mean(deviation).effective_samples or float(len(position))
    error = sqrt(float(deviation @ deviation) / spread / max(effective - 2, 1.0))
    return Estimate(slope, error, effective)
