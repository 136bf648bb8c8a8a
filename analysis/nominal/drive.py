"""The stage alone, as its motor force shows it: moving mass, viscous and Coulomb friction, and an offset.

``motor_force = m·a + c·v + F·tanh(v / 0.05 mm/s) + offset + gain·load``, linear in every parameter. The load is what
the force sensor measured in the same run, where something hung on it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.kinematics import Kinematics, kinematics
from dragrig.analysis.nominal.load import Load
from dragrig.analysis.nominal.protocol import NominalModel, Parameter, Prediction, Predictor, Variation
from dragrig.rig.arrays import FloatArray

CHANNEL = "motor_force"
NEWTONS_PER_G_MM_S2 = 1e-3
"""Millinewtons that accelerate one gram by one mm/s²."""
TURNING_SPEED_MM_S = 0.05
"""Speed over which Coulomb friction turns its sign, the friction model's own for the capsule.

A sign would have no derivative, and no encoder tells a slower creep from rest: at 1 µm per count and 500 Hz one count
more or less already is 0.25 mm/s.
"""
LOAD_ZERO_SD_MN = 10.0
"""Unknown zero of the force sensor in each run with a load; a tared sensor's is a few mN."""

PARAMETERS = (
    Parameter("moving_mass_g", "g", 1000.0, 3.0, meaning="mass that the motor accelerates"),
    Parameter("viscous_mN_s_mm", "mN·s/mm", 0.0, 1e3, positive=False, meaning="friction per speed"),
    Parameter("coulomb_mN", "mN", 0.0, 1e4, positive=False, meaning="friction at any speed"),
    Parameter("offset_mN", "mN", 0.0, 1e4, positive=False, meaning="force at rest without load"),
    Parameter("load_gain", "1", 1.0, 0.02, meaning="motor force per force at the sensor"),
)


class DriveModel(NominalModel):
    """Mass, friction and offset of a stage; a run's unknown sensor zero is its variation `load_zero_mN`."""

    @property
    def name(self) -> str:
        """What the model is called."""
        return "drive"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """As the rig settings name them, so wide beforehand that any stage is found."""
        return PARAMETERS

    @property
    def variations(self) -> tuple[Variation, ...]:
        """The sensor's zero, which the load holds."""
        return (Variation("load_zero_mN", LOAD_ZERO_SD_MN, "mN"),)

    def prepare(self, experiment: Experiment) -> Mapping[str, Predictor]:
        """Prepare the motor force of a run; nothing where none was recorded.

        Raises
        ------
        AnalysisError
            Where the motion cannot be used, or the run does not say what held the gut.
        """
        if CHANNEL not in experiment.run.trace.channels:
            return {}
        motion = kinematics(experiment)
        return {CHANNEL: DrivePredictor(motion, Load.of(experiment, motion.joints_s))}

    def document(self, values: Mapping[str, float]) -> Mapping[str, object]:
        """Return rig settings that make the simulated stage this one; friction that came out below zero is none."""
        found = {name: float(values[name]) for name in ("moving_mass_g", "offset_mN")}
        found |= {name: max(0.0, float(values[name])) for name in ("viscous_mN_s_mm", "coulomb_mN")}
        return {"simulated": {"motor": found}}


@dataclass(frozen=True, eq=False)
class DrivePredictor(Predictor):
    """The motor force of one run."""

    motion: Kinematics
    load: Load

    @property
    def events_s(self) -> FloatArray:
        """Where the acceleration changes."""
        return self.motion.joints_s

    def predict(self, values: FloatArray, time_s: FloatArray) -> Prediction:
        """Predict the motor force."""
        return Prediction(values @ self.sensitivities(values, time_s), self.load.hangs(time_s)[None])

    def sensitivities(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return what each parameter multiplies, shape `(5, n)`."""
        del values
        return np.vstack((self._moving(time_s), np.ones_like(time_s), self.load.force(time_s)))

    def friction(self, values: FloatArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return viscous and Coulomb friction [mN], shapes `(n,)`."""
        _, viscous, coulomb = values[:3, None] * self._moving(time_s)
        return viscous, coulomb

    def uncertainty(self, values: FloatArray, time_s: FloatArray) -> FloatArray:
        """Return what the moments at which the motion changes, and the load, leave uncertain."""
        doubt = self.motion.doubt(lambda times: values[:3] @ self._moving(times), time_s)
        inertia = values[0] * NEWTONS_PER_G_MM_S2 * self.motion.acceleration_error(time_s)
        return np.asarray(np.hypot(np.hypot(doubt, inertia), self.load.uncertainty(time_s)))

    def _moving(self, time_s: FloatArray) -> FloatArray:
        velocity = self.motion.velocity(time_s)
        acceleration = NEWTONS_PER_G_MM_S2 * self.motion.acceleration(time_s)
        return np.vstack((acceleration, velocity, np.tanh(velocity / TURNING_SPEED_MM_S)))


MODEL = DriveModel()
