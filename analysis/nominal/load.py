"""What hangs on the stage, from what the force sensor measured in the same run."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact

CHANNEL = "force"
BLANK, EXTERNAL = "blank", "external"
SHARE = 0.1
"""Window of the smoothing over the time since the motion last changed: forces change fast at first, then slowly."""
LONGEST_S = 0.25
SLOW_SHARE = 0.45
"""Slow noise of the sensor over its white noise: a third, and more for it outlasts the windows."""
GAUSSIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """A measured force, the sensor's zero included, averaged over windows that end where the motion changes.

    Attributes
    ----------
    time_s, impulse_mNs
        Running integral of the force, shape `(N,)`; empty where nothing hangs on the sensor.
    changes_s
        When the motion changes, from the first sample to the last.
    step_s, noise_mN
        Of the samples.
    lost_mN, lost_s
        Where samples are missing, the load is no better known than this.
    """

    time_s: FloatArray
    impulse_mNs: FloatArray
    changes_s: FloatArray
    step_s: float
    noise_mN: float
    lost_mN: float
    lost_s: FloatArray

    @classmethod
    def of(cls, experiment: Experiment, changes_s: FloatArray) -> "Load":
        """Take the force of a run; none where nothing hung on the sensor, or there was no sensor."""
        trace, nothing = experiment.run.trace, np.zeros(0)
        step = 1.0 / trace.sample_rate_hz
        if CHANNEL not in trace.channels or _nothing_hangs(experiment):
            return cls(nothing, nothing, changes_s, step, 0.0, 0.0, nothing)
        raw = np.asarray(trace.channels[CHANNEL], dtype=np.float64)
        seen = np.isfinite(raw) & (experiment.valid | (trace.signal != CHANNEL))
        if not seen.any():
            return cls(nothing, nothing, changes_s, step, 0.0, 0.0, nothing)
        time = experiment.time_s
        force = np.interp(time, time[seen], raw[seen])
        means = 0.5 * (force[1:] + force[:-1]) * np.diff(time)
        noise = float(np.median(np.abs(np.diff(raw[seen])))) / GAUSSIAN / np.sqrt(2) if seen.sum() > 1 else 0.0
        impulse = np.concatenate(([0.0], np.cumsum(means)))
        return cls(time, impulse, changes_s, step, noise, float(np.ptp(raw[seen])), time[~seen])

    def hangs(self, time_s: FloatArray) -> FloatArray:
        """Return 1 while something hangs on the sensor, else 0, shape `(n,)`."""
        return np.full(len(time_s), 1.0 if self.time_s.size else 0.0)

    def force(self, time_s: FloatArray) -> FloatArray:
        """Smoothed force [mN] at times of shape `(n,)`."""
        if not self.time_s.size:
            return np.zeros(len(time_s))
        width = self._width(time_s)
        begin = np.clip(time_s - 0.5 * width, self.time_s[0], self.time_s[-1] - width)
        first, last = (np.interp(one, self.time_s, self.impulse_mNs) for one in (begin, begin + width))
        return np.asarray((last - first) / width)

    def uncertainty(self, time_s: FloatArray) -> FloatArray:
        """Return the standard deviation [mN] of the smoothed force, shape `(n,)`."""
        if not self.time_s.size:
            return np.zeros(len(time_s))
        width = self._width(time_s)
        found = self.noise_mN * np.sqrt(self.step_s / width + SLOW_SHARE**2)
        if self.lost_s.size:
            after = np.searchsorted(self.lost_s, time_s).clip(1, max(len(self.lost_s) - 1, 1))
            nearest = np.abs(self.lost_s[np.stack((after - 1, after.clip(max=len(self.lost_s) - 1)))] - time_s).min(0)
            found = np.where(nearest <= 0.5 * width + self.step_s, self.lost_mN, found)
        return np.asarray(found)

    def _width(self, time_s: FloatArray) -> FloatArray:
        piece = np.searchsorted(self.changes_s, time_s, side="right").clip(1, len(self.changes_s) - 1)
        since, left = time_s - self.changes_s[piece - 1], self.changes_s[piece] - time_s
        return np.asarray(np.clip(np.minimum(SHARE * since, 2 * left), self.step_s, LONGEST_S))


def _nothing_hangs(experiment: Experiment) -> bool:
    # A measurement from elsewhere does not say what it was fixed to; only its kind tells.
    imported = experiment.run.info.header.backend == EXTERNAL
    return experiment.kind == BLANK or (experiment.contact is Contact.NONE and not imported)
