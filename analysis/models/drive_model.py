"""The stage alone, from its motor force: moving mass, viscous and Coulomb friction, and an offset.

``motor_force = m·a + c·v + F·tanh(v / 0.05 mm/s) + offset + gain·load``, linear in every parameter. The load is the
reading of the force sensor in the same run, where something was attached to it. Where a position loop holds the stage
at rest, its force is anywhere within friction, and says nothing of any parameter.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from dragrig.analysis.models.experiment import Experiment, Kinematics, fit_kinematics
from dragrig.analysis.models.nominal_model import (
    TURNING_SPEED_MM_S,
    UNKNOWN_FORCE_MN,
    ForcePart,
    NominalModel,
    Parameter,
    Prediction,
    Predictor,
    Variation,
)
from dragrig.rig import Contact, FloatArray

MOTOR_FORCE_CHANNEL, LOAD_CHANNEL = "motor_force", "force"
MILLINEWTONS_PER_G_MM_S2 = 1e-3
"""Millinewtons that accelerate one gram by one mm/s²."""
LOAD_ZERO_SD_MN = 10.0
"""Prior of the force sensor's zero in each run with a load; a tared sensor's is a few mN."""
BLANK_KIND = "blank"
WINDOW_SHARE = 0.1
"""Window of the smoothing over the time since the motion last changed: forces change fast at first, then slowly."""
MAX_WINDOW_S = 0.25
SLOW_NOISE_SHARE = 0.45
"""Slow noise of the sensor over its white noise: a third, and more for it outlasts the windows."""
HELD_SPEED_SHARE = 0.01
"""A stage below this share of a run's highest speed stands still, and below that over which friction changes sign."""
NORMAL_MEDIAN = 0.6745
"""Median of the magnitude of a standard normal variable."""

DRIVE_PARAMETERS = (
    Parameter("moving_mass_g", "g", 1000.0, 3.0, meaning="mass that the motor accelerates", of_rig=True),
    Parameter("viscous_mN_s_mm", "mN·s/mm", 0.0, 1e3, positive=False, meaning="friction per speed", of_rig=True),
    Parameter("coulomb_mN", "mN", 0.0, 1e4, positive=False, meaning="friction at any speed", of_rig=True),
    Parameter("offset_mN", "mN", 0.0, 1e4, positive=False, meaning="force at rest without load", of_rig=True),
    Parameter("load_gain", "1", 1.0, 0.02, meaning="motor force per force at the sensor", of_rig=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredLoad:
    """A measured force, the sensor's zero included, averaged over windows that end where the motion changes."""

    changes_s: FloatArray
    """Times at which the motion changes, from the first sample to the last."""
    step_s: float
    """Between samples."""
    time_s: FloatArray
    impulse_mNs: FloatArray
    """Running integral of the force, shape `(N,)`; empty without a load."""
    noise_mN: float = 0.0
    range_mN: float = 0.0
    """Range of the force: the uncertainty around missing samples."""
    lost_s: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, experiment: Experiment, changes_s: FloatArray) -> "MeasuredLoad":
        """Take the force of a run; no load where nothing was attached to the sensor, or there was no sensor."""
        trace = experiment.run.trace
        step = 1.0 / trace.sample_rate_hz
        unloaded = cls(changes_s, step, np.zeros(0), np.zeros(0))
        # A foreign measurement does not state its fixture; only its kind says that nothing is attached.
        is_unloaded = experiment.kind == BLANK_KIND or (experiment.contact is Contact.NONE and not experiment.imported)
        if LOAD_CHANNEL not in trace.channels or is_unloaded:
            return unloaded
        raw = np.asarray(trace.channels[LOAD_CHANNEL], dtype=np.float64)
        valid = np.isfinite(raw) & (experiment.valid | (trace.signal != LOAD_CHANNEL))
        if not valid.any():
            return unloaded
        time = experiment.time_s
        force = np.interp(time, time[valid], raw[valid])
        noise = float(np.median(np.abs(np.diff(raw[valid])))) / NORMAL_MEDIAN / np.sqrt(2) if valid.sum() > 1 else 0.0
        impulse = np.concatenate(([0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(time))))
        return cls(changes_s, step, time, impulse, noise, float(np.ptp(raw[valid])), time[~valid])

    def force(self, time_s: FloatArray) -> FloatArray:
        """Smoothed force [mN] at times of shape `(n,)`."""
        if not self.time_s.size:
            return np.zeros(len(time_s))
        width = self._width(time_s)
        begin = np.clip(time_s - 0.5 * width, self.time_s[0], self.time_s[-1] - width)
        first, last = (np.interp(time, self.time_s, self.impulse_mNs) for time in (begin, begin + width))
        return np.asarray((last - first) / width)

    def uncertainty(self, time_s: FloatArray) -> FloatArray:
        """Return the standard deviation [mN] of the smoothed force, shape `(n,)`."""
        if not self.time_s.size:
            return np.zeros(len(time_s))
        width = self._width(time_s)
        uncertainty = self.noise_mN * np.sqrt(self.step_s / width + SLOW_NOISE_SHARE**2)
        if self.lost_s.size:
            after = np.searchsorted(self.lost_s, time_s).clip(1, max(len(self.lost_s) - 1, 1))
            nearest = np.abs(self.lost_s[np.stack((after - 1, after.clip(max=len(self.lost_s) - 1)))] - time_s).min(0)
            uncertainty = np.where(nearest <= 0.5 * width + self.step_s, self.range_mN, uncertainty)
        return np.asarray(uncertainty)

    def _width(self, time_s: FloatArray) -> FloatArray:
        piece = np.searchsorted(self.changes_s, time_s, side="right").clip(1, len(self.changes_s) - 1)
        since, until = time_s - self.changes_s[piece - 1], self.changes_s[piece] - time_s
        return np.asarray(np.clip(np.minimum(WINDOW_SHARE * since, 2 * until), self.step_s, MAX_WINDOW_S))


class DriveModel(NominalModel):
    """Mass, friction and offset of a stage; a run's unknown sensor zero is its variation `load_zero_mN`."""

    @property
    def name(self) -> str:
        """Name in settings and reports."""
        return "drive"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Named as in the rig settings, with priors wide enough for any stage."""
        return DRIVE_PARAMETERS

    @property
    def variations(self) -> tuple[Variation, ...]:
        """The sensor's zero, which the load includes."""
        return (Variation("load_zero_mN", LOAD_ZERO_SD_MN, "mN"),)

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the motor force of a run; nothing where none was recorded.

        Raises
        ------
        AnalysisError
            Where the motion cannot be used, or the run does not state its fixture.
        """
        if MOTOR_FORCE_CHANNEL not in experiment.run.trace.channels:
            return {}
        motion = fit_kinematics(experiment)
        load = MeasuredLoad.of(experiment, motion.events_s)
        return {MOTOR_FORCE_CHANNEL: DrivePredictor(motion, load, experiment.drive_holds)}

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return rig settings with which the simulated stage equals this one; negative friction becomes 0."""
        motor = {name: float(values[name]) for name in ("moving_mass_g", "offset_mN")}
        motor |= {name: max(0.0, float(values[name])) for name in ("viscous_mN_s_mm", "coulomb_mN")}
        return {"simulated": {"motor": motor}}


@dataclass(frozen=True, eq=False)
class DrivePredictor(Predictor):
    """The motor force of one run."""

    motion: Kinematics
    load: MeasuredLoad
    holds: bool = False
    """Whether the force at rest is that of a loop that holds."""

    @property
    def events_s(self) -> FloatArray:
        """Times at which the acceleration changes."""
        return self.motion.events_s

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the motor force."""
        return Prediction(
            values @ self.sensitivities(values, time_s),
            np.full((1, len(time_s)), 1.0 if self.load.time_s.size else 0.0),
        )

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the factor of each parameter, shape `(5, n)`."""
        del values
        return np.vstack((self._moving(time_s), np.ones_like(time_s), self.load.force(time_s)))

    def parts(self, values: FloatArray, time_s: FloatArray) -> Mapping[ForcePart, FloatArray]:
        """Return inertia and friction [mN], shapes `(n,)`."""
        places = (ForcePart.INERTIA, ForcePart.VISCOUS_FRICTION, ForcePart.DRY_FRICTION)
        return dict(zip(places, values[:3, None] * self._moving(time_s), strict=True))

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return the uncertainty by the times at which the motion changes, the acceleration, the load and rests."""
        by_joints = self.motion.joint_uncertainty(lambda times: values[:3] @ self._moving(times), time_s)
        by_inertia = values[0] * MILLINEWTONS_PER_G_MM_S2 * self.motion.acceleration_error(time_s)
        in_motion: FloatArray = np.hypot(np.hypot(by_joints, by_inertia), self.load.uncertainty(time_s))
        if not self.holds:
            return np.asarray(in_motion)
        slow_mm_s = min(HELD_SPEED_SHARE * float(np.abs(self.motion.velocity_mm_s).max()), TURNING_SPEED_MM_S)
        return np.where(np.abs(self.motion.velocity(time_s)) <= slow_mm_s, UNKNOWN_FORCE_MN, in_motion)

    def _moving(self, time_s: FloatArray) -> FloatArray:
        velocity = self.motion.velocity(time_s)
        acceleration = MILLINEWTONS_PER_G_MM_S2 * self.motion.acceleration(time_s)
        return np.vstack((acceleration, velocity, np.tanh(velocity / TURNING_SPEED_MM_S)))


MODEL = DriveModel()
