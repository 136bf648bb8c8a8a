"""The steady force of one sliding run, its rest and its speed, counted along the motion.

Forces that oppose the motion are positive in either direction.
"""

from dataclasses import dataclass
from math import hypot

import numpy as np

from dragrig.analysis.estimates import MIN_SAMPLES_FOR_MEAN, Estimate, correlated_mean, missing
from dragrig.analysis.inference.noise import NoiseModel
from dragrig.analysis.measures import MAX_NOISE_CORRELATION_S
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.savgol import default_filter_settings, smooth
from dragrig.analysis.segments import Mask, at_rest, clipped_samples, gap_starts, steady_stretch
from dragrig.config.errors import AnalysisError


@dataclass(frozen=True, slots=True)
class SteadySliding:
    """Steady sliding of a run.

    Attributes
    ----------
    direction
        1 forward, −1 backward, 0 where the run says nothing of it.
    speed_mm_s
        Measured over the steady stretch, positive; NaN where there is none.
    steady
        Mean force [mN] over it, the sensor's zero included.
    """

    direction: int
    speed_mm_s: float
    steady: Estimate


def measure_sliding(experiment: Experiment, *, filtered: bool = False) -> SteadySliding:
    """Measure the steady sliding of a run; what its data do not support is missing, with the reason.

    Parameters
    ----------
    filtered
        Whether the steady mean is that of the Savitzky–Golay filtered force, as in the paper. Its error is
        always that of the raw one: the filter takes away white noise, which hardly matters to a mean.
    """
    stretch, found_by = steady_stretch(experiment.run)
    direction, speed = _steady_speed(experiment, stretch)
    if not stretch.any():
        nothing = found_by if "phase after" not in found_by else f"nothing is left of {found_by}"
        return SteadySliding(0, speed, missing(nothing))
    if not direction:
        return SteadySliding(0, speed, missing("the capsule does not move in its steady phase"))
    steady = _steady_mean(experiment, stretch)
    if filtered and not steady.reason:
        steady = _filtered_mean(experiment, stretch, steady)
    return SteadySliding(direction, speed, along_motion(steady, direction))


def rest_mean(experiment: Experiment, direction: int, noise: NoiseModel) -> Estimate:
    """Return the mean force [mN] before the motion, with the sign of a direction.

    A rest of a second holds too few correlation times to tell its own error; that comes from the noise of all rests.
    """
    trace = experiment.run.trace
    rest = at_rest(trace)
    if not rest.any():
        return missing("the run has no rest phase, so that the sensor's zero is not known")
    lost = _clipped_count(experiment, rest)
    if lost:
        return missing(f"{lost} samples in the rest are clipped at the end of the sensor's range")
    values = trace.force[rest & experiment.valid]
    if len(values) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"the rest holds only {len(values)} samples")
    span = np.array([len(values) / trace.sample_rate_hz])
    variance = noise.covariance(np.zeros(1), span, np.array([float(len(values))]))[0, 0]
    return along_motion(Estimate(float(np.mean(values, dtype=np.float64)), float(variance) ** 0.5), direction)


def along_motion(estimate: Estimate, direction: int) -> Estimate:
    """Give a force the sign with which it counts along a motion."""
    if estimate.value is None or direction >= 0:
        return estimate
    return Estimate(-estimate.value, estimate.standard_error, estimate.effective_samples)


def subtract_estimates(left: Estimate, right: Estimate) -> Estimate:
    """Subtract independent estimates; missing with the reason of the one that is."""
    for one in (left, right):
        if one.value is None or one.standard_error is None:
            return missing(one.reason)
    assert left.value is not None  # noqa: S101  # the loop saw to it; this tells the type checker
    assert right.value is not None  # noqa: S101
    return Estimate(left.value - right.value, hypot(left.standard_error or 0.0, right.standard_error or 0.0))


def _steady_speed(experiment: Experiment, stretch: Mask) -> tuple[int, float]:
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    known = np.flatnonzero(stretch & np.isfinite(position))
    if known.size < 2:
        return 0, float("nan")
    first, last = known[0], known[-1]
    speed = float((position[last] - position[first]) / (experiment.time_s[last] - experiment.time_s[first]))
    return int(np.sign(speed)), abs(speed)


def _steady_mean(experiment: Experiment, stretch: Mask) -> Estimate:
    lost = _clipped_count(experiment, stretch)
    if lost:
        return missing(f"{lost} samples in the steady phase are clipped at the end of the sensor's range")
    trace = experiment.run.trace
    found = correlated_mean(trace.force[stretch & experiment.valid], MAX_NOISE_CORRELATION_S * trace.sample_rate_hz)
    return missing(f"the steady phase: {found.reason}") if found.reason else found


def _clipped_count(experiment: Experiment, stretch: Mask) -> int:
    return int(np.count_nonzero(stretch & clipped_samples(experiment.run)))


def _filtered_mean(experiment: Experiment, stretch: Mask, raw: Estimate) -> Estimate:
    """Take the mean of the filtered trace; half a window before the stop is left out, which the filter smears."""
    trace = experiment.run.trace
    settings = default_filter_settings(trace.sample_rate_hz)
    try:
        values = smooth(
            trace.force, trace.sample_rate_hz, settings, gap_starts(trace.time, trace.sample_rate_hz)
        ).values
    except AnalysisError as fault:
        return missing(str(fault))
    inside = np.flatnonzero(stretch)
    whole = values[inside[: len(inside) - settings.samples(trace.sample_rate_hz) // 2]]
    whole = whole[np.isfinite(whole)]
    if not whole.size:
        return missing("the steady phase is shorter than the filter's window")
    return Estimate(float(whole.mean()), raw.standard_error, raw.effective_samples)
