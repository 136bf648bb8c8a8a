"""Velocity and acceleration of a stage from its measured position.

Twice differentiated, a position in counts is noise; smoothed first, ramps lose their edges, and the identified mass
a part of itself. So the velocity is a chain of straight lines, fitted to the position (`velocity_chain`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gaps import IndexArray
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.velocity_chain import fit_velocity
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.recorded import JITTER_MM

STRETCHED = 4 / 3
"""A ramp may seem longer or shorter by so much of the wander: a count at either end."""
LONGEST_TIMING_S = 0.01
"""A joint of the slowest motion is known to this."""


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """A motion whose velocity is a chain of straight lines.

    Attributes
    ----------
    joints_s
        Where the lines meet, from the first sample's time to the last's, shape `(K,)`.
    velocity_mm_s
        Velocity at the joints, shape `(K,)`.
    step_s
        Time between samples.
    wander_mm
        How far the recorded position wanders at rest.
    """

    joints_s: FloatArray
    velocity_mm_s: FloatArray
    step_s: float
    wander_mm: float = JITTER_MM

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Velocity [mm/s] at times of shape `(n,)`."""
        return np.interp(time_s, self.joints_s, self.velocity_mm_s)

    def acceleration(self, time_s: FloatArray) -> FloatArray:
        """Acceleration [mm/s²] at times of shape `(n,)`; at a joint, that of the piece that begins there."""
        slope = np.diff(self.velocity_mm_s) / np.diff(self.joints_s)
        return np.asarray(slope[self._piece(time_s)])

    def acceleration_error(self, time_s: FloatArray) -> FloatArray:
        """Error [mm/s²] of the acceleration, one standard deviation, shape `(n,)`.

        A count more or less moves the ends of a ramp, and all of its samples are wrong together; the error is
        widened so that samples which are taken for independent weigh no more than the ramp as a whole.
        """
        length, change = np.diff(self.joints_s), np.abs(np.diff(self.velocity_mm_s))
        fastest = np.maximum(np.abs(self.velocity_mm_s[1:]), np.abs(self.velocity_mm_s[:-1]))
        stretched = STRETCHED * self.wander_mm / np.maximum(fastest, 1e-9) / length
        error = change / length * np.minimum(stretched, 1.0) * np.sqrt(np.maximum(length / self.step_s, 1.0))
        return np.asarray(error[self._piece(time_s)])

    def doubt(self, of: Callable[[FloatArray], FloatArray], time_s: FloatArray) -> FloatArray:
        """Return by how much what follows from this motion may be wrong near its joints, 0 elsewhere, shape `(n,)`.

        A sample is told to lie on the right side of a joint only up to the time in which the stage moves by the
        encoder's wander, and up to one sample, for position and force need not be of the same instant.

        Parameters
        ----------
        of
            What follows, at rising times.
        time_s
            Rising times.
        """
        speed = np.abs(self.velocity_mm_s)
        fastest = np.maximum(speed, np.maximum(np.append(speed[1:], 0.0), np.append(0.0, speed[:-1])))
        timing = self.step_s + np.minimum(self.wander_mm / np.maximum(fastest, 1e-9), LONGEST_TIMING_S)
        nearest = np.searchsorted(0.5 * (self.joints_s[1:] + self.joints_s[:-1]), time_s)
        shift = timing[nearest]
        found = np.zeros(len(time_s))
        now = of(time_s)
        for moved in (np.maximum.accumulate(time_s - shift), np.maximum.accumulate(time_s + shift)):
            other = of(np.clip(moved, self.joints_s[0], self.joints_s[-1]))
            found = np.maximum(found, np.abs(other - now))
        return np.where(np.abs(time_s - self.joints_s[nearest]) <= shift, found, 0.0)

    def _piece(self, time_s: FloatArray) -> IndexArray:
        piece = np.searchsorted(self.joints_s, time_s, side="right") - 1
        return np.clip(piece, 0, len(self.joints_s) - 2)


def kinematics(experiment: Experiment) -> Kinematics:
    """Fit the measured position of a run; raises `AnalysisError` where its motion cannot be used."""
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    seen = np.isfinite(position)
    wander_mm = experiment.wander_mm
    fitted = fit_velocity(experiment.motion, experiment.time_s[seen], position[seen], wander_mm)
    return Kinematics(*with_turns(*fitted), 1.0 / experiment.run.trace.sample_rate_hz, wander_mm)


def with_turns(joints_s: FloatArray, velocity_mm_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add a joint wherever a straight line of velocity goes through 0, for there friction turns."""
    before, after = velocity_mm_s[:-1], velocity_mm_s[1:]
    turning = np.flatnonzero(before * after < 0)
    share = before[turning] / (before[turning] - after[turning])
    turns_s = joints_s[turning] + share * np.diff(joints_s)[turning]
    return np.insert(joints_s, turning + 1, turns_s), np.insert(velocity_mm_s, turning + 1, 0.0)
