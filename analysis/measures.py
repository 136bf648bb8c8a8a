"""Measures of one run, each with its standard error or the reason why it is missing."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from dragrig.analysis.estimates import MIN_SAMPLES_FOR_MEAN, Estimate, correlated_mean, missing
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.analysis.segments import Mask, clipped_samples, end_of_hold, gap_starts, in_phase, steady_stretch
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run

MAX_NOISE_CORRELATION_S = 2.0
"""Correlation time up to which slow noise of the sensor is thought possible, ten times the usual 0.2 s."""
PEAK_WINDOW_S = 0.01
"""Window of the smoothing under which the peak is looked for; at least five samples are taken.

A relaxation's peak is a cusp: over the 0.05 s of the filter's usual window it would come out 2 to 3 % low.
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
        When that was.
    hold_force
        Mean over the end of the hold.
    speed
        Slope of the position over the steady phase [mm/s], positive or negative.
    steady_from
        How the stretch of the steady force was chosen.
    """

    steady_force: Estimate
    rest_offset: Estimate
    peak_force: Estimate
    peak_time_s: float | None
    hold_force: Estimate
    speed: Estimate
    steady_from: str


def measure(run: Run) -> RunMeasures:
    """Measure a run; what its data do not support is missing, with the reason, and nothing is raised."""
    trace = run.trace
    bad = clipped_samples(run)
    stretch, found_by = steady_stretch(run)
    if run.info.kind in STICKING_KINDS:
        steady = missing(f"a {run.info.kind} run has no steady sliding")
    elif not stretch.any():
        steady = missing(found_by if "phase after" not in found_by else f"nothing is left of {found_by}")
    else:
        steady = _stretch_mean(run, stretch, bad, found_by)
    rest, hold = in_phase(trace, Phase.REST), end_of_hold(trace)
    peak, peak_time_s = _peak(run, bad)
    return RunMeasures(
        steady_force=steady,
        rest_offset=_stretch_mean(run, rest, bad, "the rest") if rest.any() else missing("the run has no rest phase"),
        peak_force=peak,
        peak_time_s=peak_time_s,
        hold_force=_stretch_mean(run, hold, bad, "the end of the hold")
        if hold.any()
        else missing("the run has no hold phase"),
        speed=_speed(run),
        steady_from=found_by,
    )


def _stretch_mean(run: Run, stretch: Mask, bad: Mask, name: str) -> Estimate:
    lost = int(np.count_nonzero(stretch & bad))
    if lost:
        return missing(f"{lost} samples in {name} are clipped at the end of the sensor's range")
    return _with_context(
        correlated_mean(run.trace.force[stretch], MAX_NOISE_CORRELATION_S * run.trace.sample_rate_hz), name
    )


def _with_context(estimate: Estimate, name: str) -> Estimate:
    return missing(f"{name}: {estimate.reason}") if estimate.reason else estimate


def _peak(run: Run, bad: Mask) -> tuple[Estimate, float | None]:
    trace = run.trace
    if bad.any():
        return missing(f"{int(bad.sum())} samples are clipped at the end of the sensor's range"), None
    setting = SavgolSettings(window_samples=max(5, 2 * int(PEAK_WINDOW_S * trace.sample_rate_hz / 2) + 1), order=2)
    force = np.asarray(trace.force, dtype=np.float64)
    try:
        smoothed = smooth(force, trace.sample_rate_hz, setting, gap_starts(trace.time, trace.sample_rate_hz)).values
    except AnalysisError:
        return missing(f"only {len(force)} samples"), None
    smoothed = np.where(np.isnan(smoothed), force, smoothed)
    if np.isnan(smoothed).any():
        return missing("samples are missing (NaN), and the peak may be among them"), None
    kernel = setting.kernel(trace.sample_rate_hz)
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
    return _slope(position, time)


def _slope(position: FloatArray, time: FloatArray) -> Estimate:
    """Slope of a straight line, its error scaled by how correlated the deviations from it are."""
    centred = time - time.mean()
    spread = float(centred @ centred)
    slope = float(centred @ (position - position.mean())) / spread
    deviation = position - position.mean() - slope * centred
    effective = correlated_mean(deviation).effective_samples or float(len(position))
    error = sqrt(float(deviation @ deviation) / spread / max(effective - 2, 1.0))
    return Estimate(slope, error, effective)
