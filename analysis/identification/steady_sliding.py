"""The steady force of one sliding run, its rest and its speed, counted along the motion.

Forces that oppose the motion are positive in either direction.
"""

from dataclasses import dataclass
from math import hypot

import numpy as np

from dragrig.analysis.estimates import MIN_SAMPLES_FOR_MEAN, Estimate, missing
from dragrig.analysis.inference.noise import NoiseModel
from dragrig.analysis.measures import empty_stretch_reason, stretch_mean
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.savgol import default_filter_settings, smooth_channel
from dragrig.analysis.segments import Mask, at_rest, clipped_samples, steady_stretch
from dragrig.config.errors import AnalysisError


@dataclass(frozen=True, slots=True)
class SteadySliding:
    """Steady sliding of a run.

    Attributes
    ----------
    direction
        1 forward, −1 backward, 0 unknown.
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
        always that of the raw force: the filter removes white noise, which hardly matters to a mean.
    """
    run = experiment.run
    stretch, chosen_by = steady_stretch(run)
    direction, speed = _steady_speed(experiment, stretch)
    if not stretch.any():
        return SteadySliding(0, speed, missing(empty_stretch_reason(chosen_by)))
    if not direction:
        return SteadySliding(0, speed, missing("the capsule does not move in its steady phase"))
    finite = stretch & np.isfinite(run.trace.force)
    steady = stretch_mean(run, finite, clipped_samples(run), "the steady phase")
    if filtered and not steady.reason:
        steady = _filtered_mean(experiment, stretch, steady)
    return SteadySliding(direction, speed, along_motion(steady, direction))


def rest_mean(experiment: Experiment, direction: int, noise: NoiseModel) -> Estimate:
    """Mean force [mN] before the motion, counted along a direction.

    A rest of a second holds too few correlation times for an error of its own; that comes from the noise of all rests.
    """
    trace = experiment.run.trace
    rest = at_rest(trace)
    if not rest.any():
        return missing("the run has no rest phase, so that the sensor's zero is not known")
    if clipped := int(np.count_nonzero(rest & clipped_samples(experiment.run))):
        return missing(f"{clipped} samples in the rest are clipped at the end of the sensor's range")
    values = trace.force[rest & experiment.valid]
    if len(values) < MIN_SAMPLES_FOR_MEAN:
        return missing(f"the rest holds only {len(values)} samples")
    duration_s = np.array([len(values) / trace.sample_rate_hz])
    variance = noise.covariance(np.zeros(1), duration_s, np.array([float(len(values))]))[0, 0]
    return along_motion(Estimate(float(np.mean(values, dtype=np.float64)), float(variance) ** 0.5), direction)


def along_motion(estimate: Estimate, direction: int) -> Estimate:
    """Give a force the sign with which it counts along a motion."""
    if estimate.value is None or direction >= 0:
        return estimate
    return Estimate(-estimate.value, estimate.standard_error, estimate.effective_samples)


def subtract_estimates(left: Estimate, right: Estimate) -> Estimate:
    """Difference of independent estimates; missing where either is, with its reason."""
    if left.value is None or left.standard_error is None:
        return missing(left.reason)
    if right.value is None or right.standard_error is None:
        return missing(right.reason)
    return Estimate(left.value - right.value, hypot(left.standard_error, right.standard_error))


def _steady_speed(experiment: Experiment, stretch: Mask) -> tuple[int, float]:
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    known = np.flatnonzero(stretch & np.isfinite(position))
    if known.size < 2:
        return 0, float("nan")
    ends = known[[0, -1]]
    speed = float(np.diff(position[ends])[0] / np.diff(experiment.time_s[ends])[0])
    return int(np.sign(speed)), abs(speed)


def _filtered_mean(experiment: Experiment, stretch: Mask, raw: Estimate) -> Estimate:
    """Mean of the filtered trace, without half a window before the stop, which the filter blurs."""
    trace = experiment.run.trace
    settings = default_filter_settings(trace.sample_rate_hz)
    try:
        filtered = smooth_channel(trace, trace.force, settings).values
    except AnalysisError as error:
        return missing(str(error))
    inside = np.flatnonzero(stretch)
    values = filtered[inside[: len(inside) - settings.samples(trace.sample_rate_hz) // 2]]
    values = values[np.isfinite(values)]
    if not values.size:
        return missing("the steady phase is shorter than the filter's window")
    return Estimate(float(values.mean()), raw.standard_error, raw.effective_samples)
